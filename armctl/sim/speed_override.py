"""SpeedOverride: how fast a reference passes along its path, changed smoothly while it moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.limits import Limits

# Of the acceleration and jerk limits, what a change of the rate may take. The rest is left for the motion, which uses 0.3 of
# the acceleration and 0.09 of the jerk: 0.09 + 3 * 0.3 * 0.4 + 0.5 < 1 where a joint needs longer to full speed than to full
# acceleration.
_ACCELERATION_SHARE = 0.4
_JERK_SHARE = 0.5
# Largest first and second derivative of the quintic s(x) = 10 x^3 - 15 x^4 + 6 x^5 on [0, 1].
_MAX_SLOPE = 1.875
_MAX_CURVATURE = 5.774


class Advance(NamedTuple):
    """One tick of path time.

    Attributes:
        progress: s of path time that pass in the tick.
        rate: Path time per time at its end.
        slope: 1/s, how fast the rate changes at its end.
    """

    progress: float
    rate: float
    slope: float


class SpeedOverride:
    """The rate of path time: 1 is the planned speed, 0 stands still on the path.

    For q(s(t)) the velocity is v ds/dt and the acceleration is a (ds/dt)^2 + v d^2s/dt^2. The rate changes by a quintic over a
    time that keeps both terms within the limits of a motion that leaves them room.

    Attributes:
        rate: Path time per time now.
    """

    def __init__(self, limits: Limits):
        """The planned speed, for joints with these limits.

        Args:
            limits: Limits of the joints, not those that the motion was planned with.
        """
        self.rate = 1.0
        self._goal = 1.0
        self._ramp: _Ramp | None = None
        self._by_acceleration = float(np.max(_MAX_SLOPE * limits.v_max / (_ACCELERATION_SHARE * limits.a_max)))
        self._by_jerk = float(np.max(_MAX_CURVATURE * limits.v_max / (_JERK_SHARE * limits.j_max)))

    def go_to(self, rate: float) -> None:
        """Changes to a rate in [0, 1], after the change that is under way."""
        self._goal = rate

    def jump_to(self, rate: float) -> None:
        """Takes a rate at once, while nothing moves."""
        self.rate = rate
        self._goal = rate
        self._ramp = None

    def step(self, dt: float) -> Advance:
        """Goes on by one tick of dt s."""
        if self._ramp is None:
            change = self._goal - self.rate
            if change == 0.0:
                return Advance(self.rate * dt, self.rate, 0.0)
            duration = max(abs(change) * self._by_acceleration, (abs(change) * self._by_jerk) ** 0.5)
            self._ramp = _Ramp(self.rate, self._goal, duration, 0.0)
        begin = self.rate
        self._ramp = self._ramp._replace(t=self._ramp.t + dt)
        self.rate = self._ramp.rate
        slope = self._ramp.slope
        if self._ramp.t >= self._ramp.duration:
            self._ramp = None
        return Advance(0.5 * (begin + self.rate) * dt, self.rate, slope)


class _Ramp(NamedTuple):
    """A change of the rate, at the time t s since it began."""

    begin: float
    end: float
    duration: float
    t: float

    @property
    def rate(self) -> float:
        x = self.t / self.duration
        return self.end if x >= 1.0 else self.begin + (self.end - self.begin) * x**3 * (10 - 15 * x + 6 * x * x)

    @property
    def slope(self) -> float:
        x = min(self.t / self.duration, 1.0)
        return (self.end - self.begin) * 30 * x * x * (1 - x) ** 2 / self.duration
