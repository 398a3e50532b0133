"""Reading numbers from a caller: the one place where a list becomes a checked, read-only array."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armctl.core.errors import InputError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
TextArray = NDArray[np.object_]
_Scalar = TypeVar("_Scalar", bound=np.generic)


def instance(what: str, value: object, kind: type | tuple[type, ...], hint: str) -> None:
    """Makes sure that an argument is of its kind.

    Args:
        what: The name of the argument, for the error.
        value: What the caller gave.
        kind: What it must be.
        hint: How to get one, for the error.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(value, kind):
        names = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
        raise InputError(f"{what}: {value!r:.80} is no {names}; {hint}")


def vector(what: str, value: ArrayLike, length: int | None = None, *, finite: bool = True) -> Array:
    """A caller's numbers as a new read-only vector.

    Args:
        what: The name of the argument, for the error.
        value: (length,) numbers.
        length: How many there must be; None takes any number of them.
        finite: Whether NaN and infinity are refused.

    Returns:
        (length,) float64, read-only.

    Raises:
        InputError: The value has another shape, is no number, or is not finite.
    """
    out = array(what, value, 1, finite=finite)
    if length is not None and out.shape != (length,):
        raise InputError(f"{what}: {out.size} numbers given, {length} wanted")
    return out


def matrix(what: str, value: ArrayLike, columns: int) -> Array:
    """A caller's rows of numbers as a new read-only matrix.

    Args:
        what: The name of the argument, for the error.
        value: (k, columns) numbers.
        columns: How many each row must have.

    Returns:
        (k, columns) float64, read-only.

    Raises:
        InputError: The value has another shape, is no number, or is not finite.
    """
    out = array(what, value, 2)
    if out.shape[1] != columns:
        raise InputError(f"{what}: rows of {out.shape[1]} numbers given, {columns} wanted")
    return out


def array(what: str, value: ArrayLike, ndim: int, *, finite: bool = True) -> Array:
    """A caller's numbers as a new read-only array of `ndim` dimensions.

    Args:
        what: The name of the argument, for the error.
        value: The numbers.
        ndim: How many dimensions there must be.
        finite: Whether NaN and infinity are refused.

    Returns:
        float64, read-only.

    Raises:
        InputError: The value has another shape, is no number, or is not finite.
    """
    try:
        given = np.asarray(value)
        if np.iscomplexobj(given):  # NumPy would drop the imaginary part
            raise TypeError
        out = np.array(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what}: {value!r} is not an array of numbers") from None
    if out.ndim != ndim:
        kind = {1: "a list of numbers", 2: "a list of rows"}.get(ndim, f"{ndim} dimensions")
        given = f"an array of shape {out.shape}" if out.ndim else "a single number"
        raise InputError(f"{what}: {given} given, {kind} wanted")
    if finite and not np.isfinite(out).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(out))[0])
        raise InputError(f"{what}: element {list(where)} is {out[where]}, a finite number wanted")
    return frozen(out)


def number(what: str, value: float, low: float = -np.inf, high: float = np.inf) -> float:
    """A caller's number, checked against its bounds.

    Args:
        what: The name of the argument, for the error.
        value: The number.
        low: The least it may be.
        high: The most it may be.

    Returns:
        The number as a float.

    Raises:
        InputError: It is no number, not finite, or out of its bounds.
    """
    try:
        if isinstance(value, np.complexfloating):  # float() would drop the imaginary part
            raise TypeError
        out = float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what}: {value!r} is not a number") from None
    if not math.isfinite(out):
        raise InputError(f"{what}: {out} given, a finite number wanted")
    if not low <= out <= high:
        wanted = f"at least {low:g}" if high == np.inf else f"in [{low:g}, {high:g}]"
        raise InputError(f"{what}: {out:g} given, a number {wanted} wanted")
    return out


def frozen(value: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """The same array, made read-only.

    Args:
        value: An array that the caller owns.

    Returns:
        The array itself.
    """
    value.setflags(write=False)
    return value
