"""The contract of a controller: torque from state and setpoint."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, runtime_checkable

from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array


class State(NamedTuple):
    """What a controller is told at a tick.

    Attributes:
        q: (n,) measured positions, rad.
        v: (n,) measured velocities, rad/s.
        t: Time, s.
        dt: The control period, for which the torque will be held, s; 0 means continuous time.
        continuous: Whether the arm moves on continuously while the torque is held, as a real one does. Otherwise one step of
            the simulator is the period.
    """

    q: Array
    v: Array
    t: float = 0.0
    dt: float = 0.0
    continuous: bool = False


@runtime_checkable
class Controller(Protocol):
    """Anything with a method `torque`; an attribute `name` is shown in reports where there is one.

    A controller with memory starts afresh when `state.t` is not one `state.dt` after the tick before.
    """

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m; the simulation clips it at the arm's limits.
        """
        ...


class Clock:
    """Tells a controller with memory whether a tick follows the one before it."""

    def __init__(self) -> None:
        """A clock that has seen no tick."""
        self._next = math.nan

    def follows(self, state: State) -> bool:
        """Whether a state is one control period after the state of the last call; False at first.

        Args:
            state: The measured state at this tick.

        Returns:
            True if it is.
        """
        follows = abs(state.t - self._next) <= 0.5 * state.dt
        self._next = state.t + state.dt
        return follows


def controller_name(controller: Controller) -> str:
    """What reports call a controller.

    Args:
        controller: The controller.

    Returns:
        Its `name`, or its class's.
    """
    return getattr(controller, "name", type(controller).__name__)
