"""The interface of a controller: torque from state and setpoint."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, shown


class State(NamedTuple):
    """What a controller measures at a tick.

    Attributes:
        q: (n,) measured positions, rad.
        v: (n,) measured velocities, rad/s.
        t: Time, s.
        dt: The control period, s, during which the torque is held constant; 0 means continuous time.
        continuous: Whether the arm moves continuously during the control period, as a real arm does. If False, the control
            period is one step of the simulator.
        wrench: (6,) N and N m, the measured wrench of the environment on the tip: force first, world axes, at the tip. None if
            nobody measures it: a simulation does for controllers with the attribute `needs_wrench = True`.
    """

    q: Array
    v: Array
    t: float = 0.0
    dt: float = 0.0
    continuous: bool = False
    wrench: Array | None = None


@runtime_checkable
class Controller(Protocol):
    """Any object with a method `torque`. Reports show its attribute `name`, if it has one.

    A controller with memory resets it if `state.t` is not one `state.dt` later than in the previous call.
    """

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m; the simulation clips it to the arm's limits.
        """
        ...


class Clock:
    """Tells a controller with memory whether a tick directly follows the previous one."""

    def __init__(self) -> None:
        """A clock that has not seen any tick."""
        self._next = math.nan

    def follows(self, state: State) -> bool:
        """Whether a state is one control period later than the state of the previous call; False in the first call."""
        follows = abs(state.t - self._next) <= 0.5 * state.dt
        self._next = state.t + state.dt
        return follows


_TorqueMethod = TypeVar("_TorqueMethod", bound=Callable[..., Array])


def explains_wrong_arguments(torque: _TorqueMethod) -> _TorqueMethod:
    """Decorates a `torque` method: a call with wrong arguments raises an InputError.

    The arguments are checked only after an exception, because a controller runs in every tick.
    """

    @functools.wraps(torque)
    def torque_or_input_error(controller: Any, state: State, setpoint: Setpoint) -> Array:
        try:
            return torque(controller, state, setpoint)
        except (AttributeError, TypeError, ValueError):
            _check_arguments(state, setpoint)
            raise

    return torque_or_input_error  # type: ignore[return-value]


def _check_arguments(state: object, setpoint: object) -> None:
    if not isinstance(state, State):
        raise InputError(f"state: {shown(state)} is no State; armctl.State(q, v) is one")
    if not isinstance(setpoint, Setpoint):
        raise InputError(f"setpoint: {shown(setpoint)} is no Setpoint; armctl.Setpoint(q, v, a) is one")
    values = {
        "state.q": state.q,
        "state.v": state.v,
        "setpoint.q": setpoint.q,
        "setpoint.v": setpoint.v,
        "setpoint.a": setpoint.a,
    }
    for name, value in values.items():
        if not isinstance(value, np.ndarray) or value.ndim != 1 or value.dtype != np.float64:
            raise InputError(f"{name}: {shown(value)} is not a vector of floats; numpy.array([...], dtype=float) is one")
    sizes = {name: value.size for name, value in values.items()}
    if len(set(sizes.values())) > 1:
        raise InputError(f"state and setpoint: all vectors must have the same length, got {sizes}")


def controller_name(controller: Controller) -> str:
    """The name of a controller in reports: its `name`, or that of its class."""
    return getattr(controller, "name", type(controller).__name__)
