"""Guide: the reference of an arm that is told where to go while it moves."""

from __future__ import annotations

import numpy as np

from armctl.arm import Arm
from armctl.arrays import Array
from armctl.errors import PlanError
from armctl.motion import JointTrajectory
from armctl.motion.profiles import Moving, Profiles, at_rest
from armctl.trajectory import TickReference


class Guide:
    """A jerk-limited reference, tick by tick, whose goal may change at any time.

    Attributes:
        q: (n,) rad, where the reference is now.
    """

    def __init__(self, arm: Arm, dt: float):
        """A guide that stands still at the arm's home.

        Args:
            arm: The arm.
            dt: s, the tick.
        """
        self._arm, self._dt, self._profiles = arm, dt, Profiles.of(arm.limits)
        self.stand(arm.home)

    def stand(self, q: Array) -> None:
        """Stands still from now on.

        Args:
            q: (n,) rad, where.
        """
        self.q = self._before = self._goal = np.array(q)
        self._motion, self._time = JointTrajectory.standing(self._arm.joint_names, self._arm.limits, self.q), 0.0

    def toward(self, goal: Array, ticks: int) -> TickReference:
        """The next ticks on the way to a goal, as fast as the joints' limits allow.

        Args:
            goal: (n,) rad, where to come to rest.
            ticks: How many.

        Returns:
            The reference at these ticks.
        """
        if not np.array_equal(goal, self._goal):
            self._set_out(np.array(goal))
        q, v, a = self._motion.sample(self._time + self._dt * np.arange(ticks + 1))[:3]
        v_tick = np.diff(np.vstack([self._before, q]), axis=0) / self._dt
        self._time += ticks * self._dt
        self.q, self._before = q[-1], q[-2]
        return TickReference(q[:-1], v[:-1], a[:-1], v_tick[:-1], np.diff(v_tick, axis=0) / self._dt)

    def _set_out(self, goal: Array) -> None:
        """Plans from the state that the reference is in; where that cannot be done, the old motion goes on."""
        try:
            pieces = self._profiles.solve(Moving(*self._motion(self._time)[:3]), at_rest(goal))
        except PlanError:
            return
        self._goal, self._time = goal, 0.0
        self._motion = JointTrajectory(*pieces, self._arm.joint_names, self._arm.limits)
