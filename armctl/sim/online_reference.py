"""OnlineReference: the reference of an arm whose target changes while it moves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array
from armctl.motion import OnlineMotion
from armctl.motion.trajectory.piecewise import Pieces
from armctl.robot.arm import Arm
from armctl.sim.speed_override import Advance, SpeedOverride


class OnlineReference:
    """A reference as rows for the tick loop, a few at a time: an online motion, whose goal may change, or a planned motion.

    Attributes:
        arm: The arm, with the limits of the motions.
        q: (n,) rad, where the reference is now.
    """

    def __init__(self, arm: Arm, dt: float, q: Array, *, acceleration_scale: float = 1.0, continuous: bool = False):
        """A reference that rests at q.

        Args:
            dt: s, the tick.
            q: (n,) rad, where it starts.
            acceleration_scale: Factor on the acceleration limits; its square scales the jerk limits.
            continuous: Whether the arm moves almost continuously between ticks, so that its velocity is not the difference of
                two positions.
        """
        self._override = SpeedOverride(arm.limits)
        self._rate = 1.0
        if acceleration_scale != 1.0:
            a_max = acceleration_scale * arm.limits.a_max
            j_max = acceleration_scale**2 * arm.limits.j_max
            arm = arm.with_limits(replace(arm.limits, a_max=a_max, j_max=j_max))
        self.arm = arm
        self._dt = dt
        self._continuous = continuous
        self.stand(q)

    @property
    def is_on_planned_path(self) -> bool:
        """Whether it follows a planned motion that has neither ended nor been stopped."""
        return self._planned is not None

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands still until it gets another goal."""
        return self._planned is None and self._motion.time_left == 0.0

    @property
    def pieces(self) -> Pieces:
        """The online motion from now on, up to rest."""
        return self._motion.pieces

    def stand(self, q: Array) -> None:
        """Rests at q, (n,) rad, from now on."""
        self.q = np.array(q)
        self._previous = self.q
        self._rest()

    def set_speed(self, rate: float) -> None:
        """The speed override, in (0, 1]: the share of the planned speed at which the reference moves along its path."""
        self._rate = rate
        if not self._is_stopping:
            self._override.go_to(rate)

    def follow(self, trajectory: Trajectory) -> None:
        """Follows a planned motion, which starts where the reference rests."""
        self._planned = trajectory
        self._path_time = 0.0

    def stop(self) -> None:
        """Stops on the planned path."""
        if self._planned is not None:
            self._is_stopping = True
            self._override.go_to(0.0)

    def go_to(self, goal: Array, accepts: Callable[[Pieces], bool]) -> bool:
        """Takes a goal, (n,) rad, if the motion there is accepted; otherwise the reference goes on as it was."""
        return self._motion.go_to_if(goal, accepts)

    def toward(self, goal: Array, ticks: int) -> TickReference:
        """The next ticks of a motion to a goal, (n,) rad, where the reference is at rest."""
        with contextlib.suppress(PlanError):  # the motion then stops; the next call plans again
            self._motion.go_to(goal)
        return self.next(ticks)

    def next(self, ticks: int) -> TickReference:
        """The next ticks."""
        if self._planned is not None and (self._path_time >= self._planned.duration or self._has_stopped):
            self._rest()
        steps = [self._setpoint(self._override.step(dt)) for dt in (0.0, *ticks * [self._dt])]
        q = np.array([step.q for step in steps])
        v = np.array([step.v for step in steps])
        a = np.array([step.a for step in steps])
        v_tick = v if self._continuous else np.diff(np.vstack([self._previous, q]), axis=0) / self._dt
        self.q = q[-1]
        self._previous = q[-2]
        return TickReference(q[:-1], v[:-1], a[:-1], v_tick[:-1], np.diff(v_tick, axis=0) / self._dt)

    @property
    def _has_stopped(self) -> bool:
        return self._is_stopping and self._override.rate == 0.0

    def _rest(self) -> None:
        """Ends a planned motion: the reference stands at q."""
        self._planned: Trajectory | None = None
        self._path_time = 0.0
        self._is_stopping = False
        self._override.jump_to(self._rate)
        self._motion = OnlineMotion(self.arm, self.arm.limits.clamp(self.q))

    def _setpoint(self, advance: Advance) -> Setpoint:
        """Where the reference is after some path time, with its derivatives by time."""
        if self._planned is None:
            point = self._motion.step(advance.progress)
        else:
            self._path_time += advance.progress
            point = self._planned(self._path_time)
        rate = advance.rate
        if rate == 1.0 and advance.slope == 0.0:
            return point
        return Setpoint(point.q, rate * point.v, rate**2 * point.a + advance.slope * point.v)
