"""IterativeLearning: a motion that is repeated gets better from one repetition to the next.

The reference of the next repetition is the present one plus the error of the last, low-passed without lag: D. A. Bristow,
M. Tharayil and A. G. Alleyne, "A survey of iterative learning control" (2006). That converges for any controller that follows
slow references, and learns whatever is the same in all repetitions: friction, a payload, a wrong model, gravity.
"""

from __future__ import annotations

import math

import numpy as np

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.validation import Array, instance, number
from armctl.motion.trajectory import piecewise
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.robot.arm import Arm, check_arm

_KNOT_INTERVAL_S = 0.004
_START_S = 0.02  # over which a correction begins: a repetition starts where the motion does
_ORDER = 2  # of the low-pass, which runs forwards and backwards


class IterativeLearning:
    """Learns the reference with which an arm follows a motion, from one repetition of it to the next.

    Attributes:
        motion: The motion that the arm is to follow.
        reference: The motion to give to the arm in the next repetition; it holds its end for `dwell` seconds.
        errors: Root mean square joint error of each repetition so far, rad, against `motion`.
    """

    def __init__(self, arm: Arm, motion: JointTrajectory, *, bandwidth: float = 100.0, gain: float = 1.0, dwell: float = 0.3):
        """Learning that has seen no repetition.

        Args:
            motion: What the arm is to follow.
            bandwidth: rad/s, of what is learnt. Lower it if the errors grow again after some repetitions.
            gain: The share of an error that the next repetition corrects, above 0 and at most 1.
            dwell: s after the motion, in which errors are corrected, too.

        Raises:
            InputError: An argument has a wrong type or value, or the motion is one of other joints.
        """
        check_arm(arm)
        instance("motion", motion, JointTrajectory, "armctl.move_j(arm, start, end) is one")
        if motion.joint_names != arm.joint_names:
            raise InputError(f"motion: it moves other joints than those of {arm.name:.60}")
        self.motion = motion
        self.errors: tuple[float, ...] = ()
        self._bandwidth = number("bandwidth", bandwidth, 0.1, 1e4)
        self._gain = number("gain", gain, 1e-3, 1.0)
        self._limits = arm.limits
        duration = motion.duration + number("dwell", dwell, 0.0, 60.0)
        self._times = np.linspace(0.0, duration, max(2, math.ceil(duration / _KNOT_INTERVAL_S)) + 1)
        self._correction = np.zeros((len(self._times), arm.n))
        self.reference = self._corrected()

    def update(self, log: Log) -> float:
        """Learns from a repetition.

        Args:
            log: The run of `reference`, of any simulation or robot.

        Returns:
            Its root mean square joint error, rad, against `motion`.

        Raises:
            InputError: It is no log, or one of other joints, or of a run that ended early.
        """
        instance("log", log, Log, "armctl.simulate gives one")
        if log.joint_names != self.motion.joint_names or log.failure or len(log) * log.dt < self._times[-1] - log.dt:
            raise InputError(
                "log: it is not a complete run of the reference, as armctl.simulate(arm, law, learning.reference) gives"
            )
        error = self.motion.sample(log.t).q - log.q
        moving = log.t <= self._times[-1]
        rms = float(np.sqrt(np.mean(error[moving] ** 2)))
        self.errors = (*self.errors, rms)
        learnt = np.column_stack([np.interp(self._times, log.t, column) for column in error.T])
        self._correction = self._smooth(self._correction + self._gain * learnt)
        self.reference = self._corrected()
        return rms

    def _smooth(self, values: Array) -> Array:
        """Low-passed forwards and backwards, so without lag; from 0 at the start to a constant at the end."""
        from scipy.signal import butter, sosfiltfilt

        interval = self._times[1]
        sections = butter(_ORDER, min(self._bandwidth, 0.9 * math.pi / interval), fs=2 * math.pi / interval, output="sos")
        length = min(len(values) - 1, round(10 / self._bandwidth / interval))
        padded = np.vstack([np.zeros((length, values.shape[1])), values, np.repeat(values[-1:], length, axis=0)])
        smooth = sosfiltfilt(sections, padded, axis=0, padlen=0)[length : length + len(values)]
        start = np.clip(self._times / _START_S, 0.0, 1.0)[:, None]
        return np.asarray(smooth * start**3 * (10 - 15 * start + 6 * start**2), dtype=np.float64)

    def _corrected(self) -> JointTrajectory:
        q, v, a = self.motion.sample(self._times)[:3]
        speed = np.array(np.gradient(self._correction, self._times, axis=0))
        speed[[0, -1]] = 0.0
        acceleration = np.array(np.gradient(speed, self._times, axis=0))
        acceleration[[0, -1]] = 0.0
        pieces = piecewise.hermite(self._times, q + self._correction, v + speed, a + acceleration)
        return JointTrajectory(*pieces, self.motion.joint_names, self._limits, units=self.motion.units)
