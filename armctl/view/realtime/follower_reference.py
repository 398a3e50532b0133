"""FollowerReference: where an arm should be that follows a target: on its way to a joint goal, or on a planned path."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from armctl.core.trajectory import TickReference
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.timing.otg import JointState
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, standing
from armctl.plan.stream.committed_motion import CommittedMotion

_ACCELERATION_SCALE = 0.3  # a target moved by hand jerks; the jerk limits are scaled by its square


class FollowerReference:
    """A reference for the tick loop, some ticks at a time. It always is on a motion that ends at rest.

    Its limits are those of its arm; a stop or another speed on a path may use those of the arm itself. `q` (n,) rad is where it
    is now.
    """

    def __init__(self, arm: Arm, dt: float, q: Array, refusal: Callable[[Pieces], str]):
        """A reference that rests at q; `refusal` says why a motion to a joint goal may not be made, and is empty if it may."""
        limits = arm.limits
        self._limits = limits
        a_max = _ACCELERATION_SCALE * limits.a_max
        self.arm = arm.with_limits(replace(limits, a_max=a_max, j_max=_ACCELERATION_SCALE**2 * limits.j_max))
        self._dt = dt
        self._refusal = refusal
        self._rate = 1.0
        self._planner = CommittedMotion(self.arm, refusal=refusal)
        self.q = np.array(q)
        self._previous = self.q  # (n,) rad, a tick before
        self._motion = self._trajectory(standing(self.arm.limits.clamp(self.q)))
        self._t = 0.0  # s of the motion
        self.is_on_planned_path = False
        self._is_stopping = False

    @property
    def obstacle(self) -> str:
        """Why the last joint goal was refused; empty if it was not."""
        return self._planner.obstacle

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands still until it gets another goal."""
        return not self.is_on_planned_path and self._t >= self._motion.duration

    def stand(self, q: Array) -> None:
        """Rests at q, (n,) rad, from now on."""
        self.q = np.array(q)
        self._previous = self.q
        self._take(standing(self.arm.limits.clamp(self.q)))

    def set_speed(self, rate: float) -> None:
        """The speed override, in (0, 1]: the share of the planned speed at which the reference moves along its path."""
        if self._t < self._motion.duration and not self._is_stopping:
            self._motion = self._motion.overridden(self._t, rate / self._rate)
        self._rate = rate
        self._planner = CommittedMotion(self.arm.with_limits(self.arm.limits.at_speed(rate)), refusal=self._refusal)

    def follow(self, trajectory: JointTrajectory) -> None:
        """Follows a planned motion, which starts where the reference rests."""
        self._take(trajectory.scaled(self._rate).pieces, is_planned=True)

    def stop(self) -> None:
        if self.is_on_planned_path and not self._is_stopping:
            self._is_stopping = True
            self._motion = self._motion.stopped_at(min(self._t, self._motion.duration))

    def go_to(self, goal: Array) -> bool:
        """Goes to rest at a goal, (n,) rad, if the limits and the refusal allow; otherwise it goes on as it was."""
        pieces = self._planner.to_rest(JointState(*self._motion(self._t)[:3]), goal)
        if pieces is not None:
            self._take(pieces)
        return pieces is not None

    def next(self, ticks: int) -> TickReference:
        if self.is_on_planned_path and self._t >= self._motion.duration:
            self._take(standing(self.arm.limits.clamp(self.q)))
        q, v, a = self._motion.sample(self._t + self._dt * np.arange(ticks + 1))[:3]
        self._t += ticks * self._dt
        reference = TickReference.between(q, v, a, self._previous, self._dt)
        self.q = q[-1]
        self._previous = q[-2]
        return reference

    def _take(self, pieces: Pieces, is_planned: bool = False) -> None:
        """Goes on along a motion that starts where the reference is."""
        self._motion = self._trajectory(pieces)
        self._t = 0.0
        self.is_on_planned_path = is_planned
        self._is_stopping = False

    def _trajectory(self, pieces: Pieces) -> JointTrajectory:
        return JointTrajectory(*pieces, self.arm.joint_names, self._limits)
