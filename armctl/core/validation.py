"""Checks of arguments: the one place where a caller's value becomes a checked number or a checked, read-only array.

All of them raise InputError; `what` is the name of the argument in its message. Use the returned value, not the argument.
"""

import math
import numbers
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armctl.core.errors import InputError, shown

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
TextArray = NDArray[np.object_]
_Scalar = TypeVar("_Scalar", bound=np.generic)
_FEW_NUMBERS = 32  # up to which Python looks at them faster than NumPy
_INERTIA_TOLERANCE = 1e-3  # of the largest element: data sheets round to a few digits


def instance(what: str, value: object, kind: type | tuple[type, ...], hint: str) -> None:
    """Checks that an argument is of a type, or of one of several; `hint` says how to get such a value."""
    if not isinstance(value, kind):
        names = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
        raise InputError(f"{what}: expected {names}, got {shown(value)}; {hint}")


def choice(what: str, value: object, known: Iterable[str]) -> str:
    """Checks that an argument is one of a few words, and returns it."""
    names = list(known)
    if not isinstance(value, str) or value not in names:
        raise InputError(f"{what}: expected one of {', '.join(names)}, got {shown(value)}")
    return value


def words(what: str, value: object) -> tuple[str, ...]:
    """Checks that an argument is a sequence of texts, and not one text."""
    texts = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(texts, Sequence) or isinstance(texts, str) or not all(isinstance(each, str) for each in texts):
        raise InputError(f"{what}: expected a tuple of names, got {shown(value)}")
    return tuple(texts)


def vector(what: str, value: ArrayLike, length: int | None = None, *, finite: bool = True) -> Array:
    """A list of numbers as a read-only float64 vector, of a required length if one is given."""
    out = array(what, value, 1, finite=finite)
    if length is not None and out.shape != (length,):
        raise InputError(f"{what}: expected {length} numbers, got {out.size}")
    return out


def matrix(what: str, value: ArrayLike, columns: int, *, finite: bool = True) -> Array:
    """Rows of numbers as a read-only float64 matrix (k, columns)."""
    out = array(what, value, 2, finite=finite)
    if out.shape[1] != columns:
        raise InputError(f"{what}: expected rows of {columns} numbers, got {out.shape[1]}")
    return out


def array(what: str, value: ArrayLike, ndim: int, *, finite: bool = True) -> Array:
    """Numbers as a read-only float64 array of `ndim` dimensions, without NaN and infinity if `finite`.

    Text, booleans and complex numbers are rejected; NumPy would convert all of them to float without a word.
    """
    try:
        given = as_array(what, value)
        if given.dtype.kind not in "fiu" and not _holds_real_numbers(given):
            raise TypeError
        out = np.array(given, dtype=np.float64)
    except Exception:  # a caller's object may raise anything while NumPy converts it
        raise InputError(f"{what}: {shown(value)} is not an array of numbers") from None
    if out.ndim != ndim:
        kind = {1: "a list of numbers", 2: "a list of rows"}.get(ndim, f"{ndim} dimensions")
        given = f"an array of shape {out.shape}" if out.ndim else "a single number"
        hint = "; Pose.from_matrix takes a matrix" if ndim == 1 and out.shape == (4, 4) else ""
        raise InputError(f"{what}: expected {kind}, got {given}{hint}")
    if finite and not _all_finite(out):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(out))[0])
        raise InputError(f"{what}: element {list(where)} is {out[where]}, expected a finite number")
    return frozen(out)


def _all_finite(values: Array) -> bool:
    if values.size <= _FEW_NUMBERS:
        return all(map(math.isfinite, values.ravel().tolist()))
    return bool(np.isfinite(values).all())


def as_array(what: str, value: object) -> NDArray[Any]:
    """What NumPy makes of an argument, of any type; InputError if it makes nothing."""
    try:
        return np.asarray(value)
    except InputError as error:  # an object of armctl that says what it is instead
        raise InputError(f"{what}: {error}") from None
    except Exception:  # a caller's object may raise anything while NumPy converts it
        raise InputError(f"{what}: {shown(value)} is not an array of numbers") from None


def _holds_real_numbers(given: NDArray[np.generic]) -> bool:
    return given.dtype.kind == "O" and all(isinstance(x, numbers.Real) and not isinstance(x, bool) for x in given.flat)


def inertia_tensor(what: str, value: ArrayLike) -> Array:
    """(3, 3) kg m^2 of a body about its center of mass, from three moments along the axes, or a symmetric matrix.

    InputError if no body has it: a negative moment, or one above the sum of the two others.
    """
    given = as_array(what, value)
    tensor = np.diag(vector(what, value, 3)) if given.ndim == 1 else array(what, value, 2)
    if tensor.shape != (3, 3):
        raise InputError(f"{what}: expected three moments or a (3, 3) matrix, kg m^2, got the shape {tensor.shape}")
    size = float(np.abs(tensor).max())
    if np.abs(tensor - tensor.T).max() > _INERTIA_TOLERANCE * size:
        raise InputError(f"{what}: the matrix is not symmetric, so no body has this inertia")
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] < -_INERTIA_TOLERANCE * size or moments[2] > moments[0] + moments[1] + _INERTIA_TOLERANCE * size:
        text = ", ".join(f"{x:.4g}" for x in moments)
        raise InputError(
            f"{what}: no body has the principal moments [{text}] kg m^2; each is at least 0 and at most the sum of the others"
        )
    return frozen(0.5 * (tensor + tensor.T))


def number(what: str, value: float, low: float = -np.inf, high: float = np.inf) -> float:
    """A number within bounds. Text and booleans are rejected, also where `float()` would convert them."""
    out = value if type(value) is float else _as_float(what, value)
    if not math.isfinite(out):
        raise InputError(f"{what}: expected a finite number, got {out}")
    if not low <= out <= high:
        raise InputError(f"{what}: expected a number {_bounds(low, high)}, got {out:g}")
    return out


def integer(what: str, value: float, low: float = -np.inf, high: float = np.inf) -> int:
    """A whole number within bounds; a float is accepted if it is whole."""
    out = number(what, value, low, high)
    if not out.is_integer():
        raise InputError(f"{what}: expected a whole number {_bounds(low, high)}, got {out:g}")
    return int(value)


def _as_float(what: str, value: object) -> float:
    try:
        if isinstance(value, (bool, np.bool_, str, bytes, bytearray, complex, np.complexfloating)):
            raise TypeError
        if isinstance(value, np.ndarray) and value.ndim:  # NumPy converts an array of one element
            raise TypeError
        return float(value)  # type: ignore[arg-type]
    except Exception:  # the __float__ of a caller's object may raise anything
        raise InputError(f"{what}: {shown(value)} is not a number") from None


def _bounds(low: float, high: float) -> str:
    if low == -np.inf:
        return f"at most {high:g}" if high < np.inf else "of any size"
    return f"at least {low:g}" if high == np.inf else f"in [{low:g}, {high:g}]"


def flag(what: str, value: object) -> bool:
    """Checks that an argument is True or False, and no array, whose truth would be ambiguous."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{what}: expected True or False, got {shown(value)}")
    return bool(value)


def frozen(value: NDArray[_Scalar]) -> NDArray[_Scalar]:
    value.setflags(write=False)
    return value


def read_only(values: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """A view that nobody can make writable: NumPy sets the flag again on an ordinary view of an array that can be written.

    Such a view itself is returned as it is, so that what is known of it can be found again.
    """
    if isinstance(values.base, memoryview) and values.base.readonly:
        return values
    return np.asarray(memoryview(values).toreadonly())  # pyright: ignore[reportArgumentType]
