"""MotionCheck: what every motion is checked against before it is sent to a robot."""

import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.piecewise import Pieces, sample
from armctl.run.links.envelope import Envelope

_TIP_SPEED_TOLERANCE = 1.01  # what a motion that was slowed down to a speed may exceed it by, between samples
_TIP_INTERVAL_S = 0.005


class MotionCheck:
    """The maker's envelope for the joints, and a greatest speed of the tip."""

    def __init__(self, arm: Arm, envelope: Envelope, tip_speed: float, dt: float):
        """A check of motions whose rows are sent every dt s; `tip_speed` is in m/s."""
        self.envelope = envelope
        self.tip_speed = tip_speed
        self._arm = arm
        self._dt = dt

    def refusal(self, motion: Pieces, before: Array | None) -> str:
        """Why a motion that follows rows `before`, (3, n) rad, or starts at rest, must not be sent; empty if it may."""
        ticks = int(np.ceil(motion.knots[-1] / self._dt - 1e-9))
        rows = sample(motion, self._dt * np.arange(ticks + 2, dtype=np.float64)).q
        reason = self.envelope.refusal(rows, np.repeat(rows[:1], 3, axis=0) if before is None else before, self._dt)
        closure = self._arm.joint_map.closure
        if not reason and closure is not None:
            reason = closure.first_refusal(rows)[1]
        if not reason:
            speed = self.tip_speed_of(motion)
            if speed > _TIP_SPEED_TOLERANCE * self.tip_speed:
                reason = f"the tip moves at {speed:.3g} m/s, at most {self.tip_speed:.3g} m/s; set tip_speed= of the Robot"
        return f"not sent: {reason}" if reason else ""

    def tip_speed_of(self, motion: Pieces) -> float:
        """m/s, the greatest speed of the tip in a motion."""
        count = 2 + int(motion.knots[-1] / _TIP_INTERVAL_S)
        times = np.linspace(0.0, motion.knots[-1], count)
        steps = np.diff(self._arm.fk_many(sample(motion, times).q)[0], axis=0)
        return float(np.linalg.norm(steps, axis=1).max() / max(times[1], 1e-9))
