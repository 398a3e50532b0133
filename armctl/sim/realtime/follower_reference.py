"""FollowerReference: where an arm should be that follows a target: on its way to a joint goal, or on a planned path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array
from armctl.motion.timing.otg import JointState
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.motion.trajectory.piecewise import Pieces, standing
from armctl.robot.arm import Arm
from armctl.sim.speed_override import Advance, SpeedOverride
from armctl.stream.committed_motion import CommittedMotion


class FollowerReference:
    """A reference as rows for the tick loop, a few at a time. It always is on a motion that ends at rest.

    Attributes:
        arm: The arm, with the limits of the motions.
        q: (n,) rad, where the reference is now.
        is_on_planned_path: Whether it follows a planned motion that has neither ended nor been stopped.
    """

    def __init__(self, arm: Arm, dt: float, q: Array, refusal: Callable[[Pieces], str], acceleration_scale: float = 1.0):
        """A reference that rests at q.

        Args:
            dt: s, the tick.
            q: (n,) rad, where it starts.
            refusal: Why a motion to a joint goal may not be made; empty if it may.
            acceleration_scale: Factor on the acceleration limits; its square scales the jerk limits.
        """
        self._override = SpeedOverride(arm.limits)
        self._rate = 1.0
        if acceleration_scale != 1.0:
            a_max = acceleration_scale * arm.limits.a_max
            j_max = acceleration_scale**2 * arm.limits.j_max
            arm = arm.with_limits(replace(arm.limits, a_max=a_max, j_max=j_max))
        self.arm = arm
        self._dt = dt
        self._planner = CommittedMotion(arm, refusal=refusal)
        self.stand(q)

    @property
    def obstacle(self) -> str:
        """Why the last joint goal was refused; empty if it was not."""
        return self._planner.obstacle

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands still until it gets another goal."""
        return not self.is_on_planned_path and self._path_time >= self._motion.duration

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
        self._take(trajectory)
        self.is_on_planned_path = True

    def stop(self) -> None:
        """Stops on the planned path."""
        if self.is_on_planned_path:
            self._is_stopping = True
            self._override.go_to(0.0)

    def go_to(self, goal: Array) -> bool:
        """Goes to rest at a goal, (n,) rad, if the limits and the refusal allow; otherwise it goes on as it was."""
        pieces = self._planner.to_rest(JointState(*self._motion(self._path_time)[:3]), goal)
        if pieces is not None:
            self._take(self._trajectory(pieces))
        return pieces is not None

    def next(self, ticks: int) -> TickReference:
        """The next ticks."""
        if self.is_on_planned_path and (self._path_time >= self._motion.duration or self._has_stopped):
            self._rest()
        steps = [self._setpoint(self._override.step(dt)) for dt in (0.0, *ticks * [self._dt])]
        q = np.array([step.q for step in steps])
        v = np.array([step.v for step in steps])
        rows = TickReference.between(q, v, np.array([step.a for step in steps]), self._previous, self._dt)
        self.q = q[-1]
        self._previous = q[-2]
        return rows

    @property
    def _has_stopped(self) -> bool:
        return self._is_stopping and self._override.rate == 0.0

    def _rest(self) -> None:
        """Ends a motion: the reference stands at q."""
        self.is_on_planned_path = False
        self._is_stopping = False
        self._override.jump_to(self._rate)
        self._take(self._trajectory(standing(self.arm.limits.clamp(self.q))))

    def _take(self, motion: Trajectory) -> None:
        self._motion = motion
        self._path_time = 0.0

    def _trajectory(self, pieces: Pieces) -> JointTrajectory:
        return JointTrajectory(*pieces, self.arm.joint_names, self.arm.limits)

    def _setpoint(self, advance: Advance) -> Setpoint:
        """Where the reference is after some path time, with its derivatives by time."""
        self._path_time += advance.progress
        point = self._motion(self._path_time)
        rate = advance.rate
        if rate == 1.0 and advance.slope == 0.0:
            return point
        return Setpoint(point.q, rate * point.v, rate**2 * point.a + advance.slope * point.v)
