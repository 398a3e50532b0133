"""TorqueInterface: what a maker does with the torques that a robot is sent; TorqueLink: a link that takes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, as_array, flag, instance, number, vector

MAX_TORQUE_DELAY_S = 0.05


@dataclass(frozen=True, eq=False)
class TorqueInterface:
    """What a robot does with torques that it is sent, and what its maker allows.

    A controller gives the whole torque of the motors. What the maker adds is subtracted from it before it is sent.

    Attributes:
        tau_max: (n,) N m, the greatest torque of the motors, and the greatest that may be sent.
        rate_max: N m/s, by which a torque that is sent may change; one number for all joints or (n,). Infinite: unlimited.
        adds_gravity: Whether the robot adds the torque that holds its weight.
        adds_friction: Whether the robot adds the torque of friction.
        lag: s, the time constant of the low-pass filter that torques pass; 0 for none.
        delay: s, from a command to the torque, besides the tick in which the law computes it, the greatest jitter included.
            None: it is measured when the link is opened.
        settle: m, and rad, how near to a target a law ends on this robot, whose friction keeps one without integral from it.
            None: as near as the robot's own servo does.
        source: Where the maker publishes it.
    """

    tau_max: ArrayLike
    rate_max: ArrayLike = np.inf
    adds_gravity: bool = False
    adds_friction: bool = False
    lag: float = 0.0
    delay: float | None = None
    settle: tuple[float, float] | None = None
    source: str = ""

    def __post_init__(self) -> None:
        torques = vector("tau_max", self.tau_max, finite=False)
        if not (torques > 0.0).all():
            raise InputError(f"tau_max: every torque must be above 0 N m, got {torques.min():g}")
        rates = as_array("rate_max", self.rate_max)
        rates = vector("rate_max", np.full(len(torques), rates) if rates.ndim == 0 else rates, len(torques), finite=False)
        if not (rates > 0.0).all():
            raise InputError(f"rate_max: every rate must be above 0 N m/s, got {rates.min():g}")
        object.__setattr__(self, "tau_max", torques)
        object.__setattr__(self, "rate_max", rates)
        flag("adds_gravity", self.adds_gravity)
        flag("adds_friction", self.adds_friction)
        object.__setattr__(self, "lag", number("lag", self.lag, 0.0, 1.0))
        if self.delay is not None:
            object.__setattr__(self, "delay", number("delay", self.delay, 0.0, MAX_TORQUE_DELAY_S))
        if self.settle is not None:
            settle = vector("settle", self.settle, 2)
            if not (settle > 0.0).all():
                raise InputError(f"settle: both must be above 0, got {settle.tolist()}; (0.001, 0.01) is 1 mm and 0.01 rad")
            object.__setattr__(self, "settle", (float(settle[0]), float(settle[1])))
        instance("source", self.source, str, "the page of the maker is one")

    @property
    def torque_limits(self) -> Array:
        """(n,) N m, `tau_max` as an array."""
        return np.asarray(self.tau_max, dtype=np.float64)

    @property
    def rate_limits(self) -> Array:
        """(n,) N m/s, `rate_max` as an array."""
        return np.asarray(self.rate_max, dtype=np.float64)


@runtime_checkable
class TorqueLink(Protocol):
    """The part of a link that takes torques instead of positions. `wait` and the rest are as of every `Link`.

    Every method raises LinkError if the connection fails or the robot reports a fault.

    Attributes:
        torque: What the robot does with torques; None if it takes none.
    """

    torque: TorqueInterface | None

    def start_torques(self) -> None:
        """Begins a stream of torques."""
        ...

    def send_torques(self, tau: Array, last: bool) -> None:
        """Sends the torques of this tick, (n,) N m. After the last ones the robot's own servo and brakes hold the arm."""
        ...
