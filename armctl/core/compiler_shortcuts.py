"""Shortcuts in numba's compiler: the same code in two thirds of the time. Import this only together with numba.

numba 0.68 types each call again, which tries about ten templates for every addition, compares its options by building two
dictionaries, and walks through its intermediate representation by building lists of lists. The replacements give the same
answers. They are in place only while armctl compiles, under numba's own lock.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import ir, types
from numba.core.compiler_lock import global_compiler_lock
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.types.functions import BaseFunction

_GC_THRESHOLD = 20_000  # objects: a compiler makes millions that live until it ends, and Python would look at them every 700
_PLAIN_TYPES = (types.Number, types.Boolean, types.Literal, types.Array, types.BaseTuple, types.SliceType, types.NoneType)

_get_call_type = BaseFunction.get_call_type
_signatures: dict[tuple, Any] = {}


def _have_same_options(self: TargetConfig, other: object) -> bool:
    if self is other:
        return True
    if not isinstance(other, TargetConfig):
        return NotImplemented
    if type(self) is type(other) and self._values == other._values:
        return True
    return self.values() == other.values()


def _hash_of_options(self: TargetConfig) -> int:
    return hash(tuple(self.options))  # numba's hash, too, is that of the names only


def _variables(self: ir.Inst, value: object) -> list[ir.Var]:
    found: list[ir.Var] = []
    _add_variables(value, found)
    return found


def _add_variables(value: Any, found: list[ir.Var]) -> None:
    kind = type(value)
    if kind is ir.Var:
        found.append(value)
    elif kind is list or kind is tuple:
        for each in value:
            _add_variables(each, found)
    elif kind is dict:
        for each in value.values():
            _add_variables(each, found)
    elif isinstance(value, ir.Inst):
        found.extend(value.list_vars())


def _remembered_call_type(self: BaseFunction, context: Any, args: Any, kws: Any) -> Any:
    """The signature of a call of one of numba's functions, found once for the same types and options."""
    flags: Any = ConfigStack.top_or_none()
    if kws or flags is None:
        return _get_call_type(self, context, args, kws)
    key = (self, context, tuple(args), flags.nrt, flags.error_model, flags.boundscheck)
    if key not in _signatures:
        signature = _get_call_type(self, context, args, kws)
        if signature is None or not all(isinstance(each, _PLAIN_TYPES) for each in args):
            return signature
        _signatures[key] = signature
    return _signatures[key]


_REPLACEMENTS: list[tuple[type, str, Any]] = [
    (TargetConfig, "__eq__", _have_same_options),
    (TargetConfig, "__hash__", _hash_of_options),
    (ir.Inst, "_rec_list_vars", _variables),
    (BaseFunction, "get_call_type", _remembered_call_type),
]


@contextmanager
def compiler_shortcuts() -> Iterator[None]:
    """While it is open, numba compiles with the shortcuts; other threads wait until they can compile."""
    with global_compiler_lock:
        if BaseFunction.get_call_type is _remembered_call_type:  # a function is compiled while another one is
            yield
            return
        originals = [(owner, name, getattr(owner, name)) for owner, name, _ in _REPLACEMENTS]
        threshold = gc.get_threshold()
        for owner, name, replacement in _REPLACEMENTS:
            setattr(owner, name, replacement)
        if threshold[0] > 0:
            gc.set_threshold(max(_GC_THRESHOLD, threshold[0]), *threshold[1:])
        try:
            yield
        finally:
            gc.set_threshold(*threshold)
            for owner, name, original in originals:
                setattr(owner, name, original)
