"""Gain: an attribute of a controller that is checked where it is given or assigned."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar, overload

import numpy as np

from armctl.control.gains import MAX_BANDWIDTH, gain
from armctl.control.interface import CompiledController
from armctl.control.task_space import POSE_SIZE
from armctl.core.errors import InputError
from armctl.core.validation import Array, as_array, choice, number

_Checked = TypeVar("_Checked")


class Gain(Generic[_Checked]):
    """An attribute of a controller that is checked where it is given or assigned."""

    def __init__(self, check: Callable[[str, Any, int], _Checked]):
        """A gain; `check` gives the checked value for the name of the attribute, the value, and the number of joints."""
        self._check = check

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    # A value is read from the controller itself, since a descriptor without `__get__` does not come before it.
    if TYPE_CHECKING:

        @overload
        def __get__(self, controller: None, owner: type) -> Self: ...
        @overload
        def __get__(self, controller: CompiledController, owner: type) -> _Checked: ...
        def __get__(self, controller: CompiledController | None, owner: type) -> Self | _Checked: ...

    def __set__(self, controller: CompiledController, value: object) -> None:
        vars(controller)[self._name] = self._check(self._name, value, controller.n)


def scalar_gain(low: float = 0.0, high: float = MAX_BANDWIDTH) -> Gain[float]:
    """One number within bounds."""
    return Gain(lambda name, value, _n: number(name, value, low, high))


def optional_gain(low: float = 0.0, high: float = MAX_BANDWIDTH) -> Gain[float | None]:
    """One number within bounds, or None."""
    return Gain(lambda name, value, _n: None if value is None else number(name, value, low, high))


def choice_gain(choices: tuple[str, ...]) -> Gain[str]:
    """One of some choices."""
    return Gain(lambda name, value, _n: choice(name, value, choices))


def joint_gain() -> Gain[Array]:
    """(n,) numbers of at least 0; one number applies to all joints."""
    return Gain(gain)


def tip_gain(*, above_zero: bool = False) -> Gain[Array]:
    """(6,) numbers of at least 0, or above 0; one number applies to all directions."""

    def check(name: str, value: Any, _n: int) -> Array:
        gains = gain(name, value, POSE_SIZE)
        if above_zero and not (gains > 0.0).all():
            raise InputError(f"{name}: every value must be greater than 0, got {gains.min():g}")
        return gains

    return Gain(check)


def tip_bound() -> Gain[Array]:
    """(6,) numbers of at least 0, of which some may be infinite; one number applies to all directions."""

    def check(name: str, value: Any, _n: int) -> Array:
        given = as_array(name, value)
        is_infinite = np.isposinf(given) if given.dtype.kind == "f" else np.False_
        if not np.any(is_infinite):
            return gain(name, value, POSE_SIZE)
        bounds = gain(name, np.where(is_infinite, 0.0, value), POSE_SIZE)
        return np.where(is_infinite, np.inf, bounds)

    return Gain(check)
