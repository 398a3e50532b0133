"""Arrays and functions by their addresses, for compiled code that one address is passed to."""

# Intrinsics are called without their first argument, and numba does not list what it exports.
# pyright: reportCallIssue=false, reportPrivateImportUsage=false

from __future__ import annotations

import numba
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from armctl.core.jit import njit


@intrinsic
def floats(typingctx, address):
    """A pointer to float64 from an address."""

    def codegen(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.CPointer(types.float64)))

    return types.CPointer(types.float64)(types.intp), codegen


@intrinsic
def integers(typingctx, address):
    """A pointer to int64 from an address."""

    def codegen(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.CPointer(types.int64)))

    return types.CPointer(types.int64)(types.intp), codegen


@intrinsic
def short_integers(typingctx, address):
    """A pointer to int32 from an address."""

    def codegen(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.CPointer(types.int32)))

    return types.CPointer(types.int32)(types.intp), codegen


@intrinsic
def as_integer(typingctx, number):
    """The int64 whose bits are those of a float64."""

    def codegen(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.intp))

    return types.intp(types.float64), codegen


@intrinsic
def call_step(typingctx, function, model, data):
    """Calls `void function(model, data)`, such as mj_step, by its address."""

    def codegen(context, builder, signature, arguments):
        word = cgutils.intp_t
        kind = cgutils.ir.FunctionType(cgutils.ir.VoidType(), [word, word])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.none(types.intp, types.intp, types.intp), codegen


@intrinsic
def call_with_table(typingctx, function, table):
    """Calls `intptr_t function(table)` by its address."""

    def codegen(context, builder, signature, arguments):
        kind = cgutils.ir.FunctionType(cgutils.intp_t, [cgutils.intp_t])
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])

    return types.intp(types.intp, types.intp), codegen


@njit
def vector(address, size):
    """An array (size,) of float64."""
    return numba.carray(floats(address), (size,))


@njit
def matrix(address, rows, columns):
    """An array (rows, columns) of float64."""
    return numba.carray(floats(address), (rows, columns))
