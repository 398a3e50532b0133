"""Calls of controllers' kernels by address, for compiled code that runs any controller."""

# Intrinsics are called without their first argument, and numba does not list what it exports.
# pyright: reportCallIssue=false, reportPrivateImportUsage=false

from __future__ import annotations

from functools import cache
from typing import Any

import numba
from numba import types
from numba.extending import intrinsic

from armctl.core.errors import InputError
from armctl.core.jit import Kernel
from armctl.core.validation import shown

_VECTOR = types.Array(types.float64, 1, "C")
_MATRIX = types.Array(types.float64, 2, "C")
_SIGNATURE = (_VECTOR, _VECTOR, _VECTOR, _MATRIX, _VECTOR, _VECTOR)


@cache
def entry_point(controller_kernel: Any) -> int:
    """The address of the compiled code of a controller's kernel, which numba keeps as long as the kernel.

    Raises:
        InputError: The kernel cannot be compiled.
    """
    try:
        controller_kernel.compile(_SIGNATURE)
    except (AttributeError, numba.NumbaError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"kernel: {shown(controller_kernel)} is not compiled by numba.njit: {reason:.150}") from error
    compiled = controller_kernel.overloads[_SIGNATURE]
    return compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)


def has_code(controller_kernel: Any) -> bool:
    """Whether a controller's kernel is compiled; True for a kernel that cannot run in Python."""
    return not isinstance(controller_kernel, Kernel) or controller_kernel.has_code(_SIGNATURE)


@intrinsic
def call_kernel(typingctx, function, parameters, q, v, reference, memory, tau):
    """Calls a compiled kernel by its address; True if it raised an exception."""

    def codegen(context, builder, signature, arguments):
        kinds = signature.args[1:]
        kind = context.call_conv.get_function_type(types.none, kinds)
        pointer = builder.inttoptr(arguments[0], kind.as_pointer())
        status, _ = context.call_conv.call_function(builder, pointer, types.none, kinds, arguments[1:])
        return status.is_error

    return types.boolean(types.intp, *_SIGNATURE), codegen
