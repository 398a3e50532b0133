"""The contract of a controller: torque from state and setpoint."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from armctl.arrays import Array
from armctl.trajectory import Setpoint


class State(NamedTuple):
    """What a controller is told at a tick.

    Attributes:
        q: (n,) measured positions, rad.
        v: (n,) measured velocities, rad/s.
        t: Time, s.
        dt: The control period, for which the torque will be held, s; 0 means continuous time.
    """

    q: Array
    v: Array
    t: float = 0.0
    dt: float = 0.0


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


def controller_name(controller: Controller) -> str:
    """What reports call a controller.

    Args:
        controller: The controller.

    Returns:
        Its `name`, or its class's.
    """
    return getattr(controller, "name", type(controller).__name__)
