"""OnlineReference: the reference of an arm that is told where to go while it moves."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.trajectory import TickReference
from armctl.core.validation import Array
from armctl.motion import OnlineMotion
from armctl.robot.arm import Arm

_EASE = 0.3  # share of the acceleration that a hand's jerky target is followed with; its square for the jerk


class OnlineReference:
    """An online motion as rows for the tick loop, a few at a time; its goal may change between them.

    Attributes:
        q: (n,) rad, where the reference is now.
    """

    def __init__(self, arm: Arm, dt: float):
        """A guide that stands still at the arm's home.

        Args:
            arm: The arm.
            dt: s, the tick.
        """
        calm = replace(arm.limits, a_max=_EASE * arm.limits.a_max, j_max=_EASE**2 * arm.limits.j_max)
        self._arm, self._dt = arm.with_limits(calm), dt
        self.stand(arm.home)

    def stand(self, q: Array) -> None:
        """Stands still from now on.

        Args:
            q: (n,) rad, where.
        """
        self.q = self._before = np.array(q)
        self._motion = OnlineMotion(self._arm, q)

    def toward(self, goal: Array, ticks: int) -> TickReference:
        """The next ticks on the way to a goal: the joints' full speed, at a calm acceleration.

        Args:
            goal: (n,) rad, where to come to rest.
            ticks: How many.

        Returns:
            The reference at these ticks.
        """
        if self._motion.goal is None or not np.array_equal(goal, self._motion.goal):
            with contextlib.suppress(PlanError):  # it stops instead; the next look asks again
                self._motion.go_to(goal)
        steps = [self._motion.setpoint, *(self._motion.step(self._dt) for _ in range(ticks))]
        q, v, a = (np.array(column) for column in zip(*(step[:3] for step in steps), strict=True))
        v_tick = np.diff(np.vstack([self._before, q]), axis=0) / self._dt
        self.q, self._before = q[-1], q[-2]
        return TickReference(q[:-1], v[:-1], a[:-1], v_tick[:-1], np.diff(v_tick, axis=0) / self._dt)
