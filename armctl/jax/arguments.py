"""Checks of the arguments of functions of JAX: once, when they are traced."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar, get_type_hints

import jax
import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import instance, shown

_P = ParamSpec("_P")
_R = TypeVar("_R")


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that raises InputError for arguments of other types than its annotations, and for arrays not as long as q."""
    kinds = get_type_hints(function)
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = signature.bind(*args, **kwargs).arguments
        arrays = {}
        for name, value in given.items():
            if kinds[name] is jax.Array:
                arrays[name] = value
                continue
            instance(name, value, kinds[name], f"armctl.jax has a function or {kinds[name].__name__}.of that makes one")
            if isinstance(value, tuple):  # gains, or a reference
                arrays |= {f"{name}.{field}": each for field, each in zip(kinds[name]._fields, value, strict=True)}
        for name, value in arrays.items():
            is_text = isinstance(value, np.ndarray) and value.dtype.kind not in "fiu"
            if is_text or not isinstance(value, jax.Array | np.ndarray | np.number | float | int):
                raise InputError(f"{name}: {shown(value)} is not an array of numbers; jax.numpy.asarray makes one")
        shape = given["model"].armature.shape if "model" in given else np.shape(given["q"])
        for name, value in arrays.items():
            is_one_gain = name.startswith("gains.") and np.shape(value) == ()
            if np.shape(value) != shape and not is_one_gain:
                raise InputError(f"{name}: expected an array of shape {shape}, got one of shape {np.shape(value)}")
        return function(*args, **kwargs)

    return call
