"""OnlineReference: the reference of an arm whose target changes while it moves."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.trajectory import TickReference
from armctl.core.validation import Array
from armctl.motion import OnlineMotion
from armctl.robot.arm import Arm


class OnlineReference:
    """An online motion as rows for the tick loop, a few at a time; its goal may change between them.

    Attributes:
        q: (n,) rad, where the reference is now.
    """

    def __init__(self, arm: Arm, dt: float, q: Array, *, acceleration_scale: float = 1.0, continuous: bool = False):
        """A reference that rests at q.

        Args:
            arm: The arm.
            dt: s, the tick.
            q: (n,) rad, where it starts.
            acceleration_scale: Factor on the acceleration limits; its square scales the jerk limits.
            continuous: Whether the arm moves almost continuously between ticks, so that its velocity is not the difference of
                two positions.
        """
        if acceleration_scale != 1.0:
            a_max = acceleration_scale * arm.limits.a_max
            j_max = acceleration_scale**2 * arm.limits.j_max
            arm = arm.with_limits(replace(arm.limits, a_max=a_max, j_max=j_max))
        self._arm = arm
        self._dt = dt
        self._continuous = continuous
        self.stand(q)

    def stand(self, q: Array) -> None:
        """Rests at q, (n,) rad, from now on."""
        self.q = np.array(q)
        self._previous = self.q
        self._motion = OnlineMotion(self._arm, q)

    def toward(self, goal: Array, ticks: int) -> TickReference:
        """The next ticks on the way to a goal, (n,) rad, where the reference comes to rest."""
        with contextlib.suppress(PlanError):  # the motion then stops; the next call plans again
            self._motion.go_to(goal)
        steps = [self._motion.setpoint, *(self._motion.step(self._dt) for _ in range(ticks))]
        q = np.array([step.q for step in steps])
        v = np.array([step.v for step in steps])
        a = np.array([step.a for step in steps])
        v_tick = v if self._continuous else np.diff(np.vstack([self._previous, q]), axis=0) / self._dt
        self.q = q[-1]
        self._previous = q[-2]
        return TickReference(q[:-1], v[:-1], a[:-1], v_tick[:-1], np.diff(v_tick, axis=0) / self._dt)
