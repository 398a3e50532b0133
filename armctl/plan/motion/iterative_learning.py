"""IterativeLearning: a motion that is repeated gets better from one repetition to the next.

The first correction is the error itself, low-passed without lag: D. A. Bristow, M. Tharayil and A. G. Alleyne, "A survey of
iterative learning control" (2006). That is right for a law that follows its reference as computed torque does. A PD follows
late: errors near its bandwidth would fall slowly, or grow. What corrections did to the motion shows how late, so from then on
a noncausal filter of each joint, fitted to all repetitions, inverts the loop. Whatever is the same in all repetitions is
learnt: friction, a payload, a wrong model, gravity. A repetition that got worse is not built upon.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.validation import Array, instance, number
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.trajectory import piecewise
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

_KNOT_INTERVAL_S = 0.004
_START_S = 0.02  # over which a correction begins: a repetition starts where the motion does
_ORDER = 2  # of the low-pass, which runs forwards and backwards
# Of the inverse of the loop: an impulse response from -48 to 48 ms, longer than the lag of a loop of 5 ms delay margin.
_TAPS = 4  # on either side
_TAP_INTERVAL = 3  # knots
_RIDGE = 1e-2  # relative; a response that the repetitions do not show stays that of a perfect loop


class _Repetition(NamedTuple):
    """What was added to the motion, and the errors that were left, (T, n) rad each."""

    correction: Array
    error: Array


def _shifted(values: Array) -> Array:
    """(T, taps) values (T,), earlier and later ones; the first and the last one go on."""
    reach = _TAPS * _TAP_INTERVAL
    padded = np.pad(values, reach, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)[:, ::_TAP_INTERVAL]


class IterativeLearning:
    """Learns the reference with which an arm follows a motion, from one repetition of it to the next.

    Attributes:
        motion: The motion that the arm is to follow.
        reference: The motion to give to the arm in the next repetition; it holds its end for `dwell` seconds.
        best: That of the repetition with the smallest error so far; the motion before the first one.
        errors: Root mean square joint error of each repetition so far, rad, against `motion`.
    """

    def __init__(self, arm: Arm, motion: JointTrajectory, *, bandwidth: float = 200.0, gain: float = 1.0, dwell: float = 0.3):
        """Learning that has seen no repetition.

        Args:
            motion: What the arm is to follow.
            bandwidth: rad/s, of what is learnt in a repetition.
            gain: The share of an error that the next repetition corrects, above 0 and at most 1; less after one that got worse.
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
        self._repetitions: list[_Repetition] = []
        self._correction = np.zeros((len(self._times), arm.n))
        self._share = 1.0
        self.reference = self._corrected()
        self.best = self.reference

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
        learnt = np.column_stack([np.interp(self._times, log.t, column) for column in error.T])
        self._repetitions.append(_Repetition(self._correction, learnt))
        is_best = rms < min(self.errors, default=math.inf)
        if is_best:
            self.best = self.reference
        self._share = min(1.0, 2.0 * self._share) if is_best else 0.5 * self._share
        self.errors = (*self.errors, rms)
        best = self._repetitions[int(np.argmin(self.errors))]
        # What was right is not filtered again, so that a small share of what is learnt is a small change.
        self._correction = best.correction + self._gain * self._share * self._smooth(self._inverted(best.error))
        self.reference = self._corrected()
        return rms

    def _inverted(self, errors: Array) -> Array:
        """(T, n) the change of the reference that moves the joints by these errors."""
        steps = list(pairwise(self._repetitions))
        if not steps:
            return errors
        inverted = np.empty_like(errors)
        changes = np.array([after.correction - before.correction for before, after in steps])
        moved = np.array([self._smooth(before.error - after.error) for before, after in steps])
        smooth = self._smooth(errors)
        for joint in range(errors.shape[1]):
            change = changes[:, :, joint]
            weights = 1 / np.maximum(np.linalg.norm(change, axis=1), 1e-12)
            rows = np.vstack([weight * _shifted(each) for weight, each in zip(weights, moved[:, :, joint], strict=True)])
            perfect = np.eye(2 * _TAPS + 1)[_TAPS]
            missing = (weights[:, None] * change).ravel() - rows @ perfect
            normal = rows.T @ rows
            ridge = _RIDGE * np.trace(normal) / len(normal) + np.finfo(float).tiny
            response = np.linalg.solve(normal + ridge * np.eye(len(normal)), rows.T @ missing)
            left = missing - rows @ response
            # The share that the fit explains: friction that sticks, or a torque limit, are no property of the loop.
            explained = max(0.0, 1 - float(left @ left) / max(float(missing @ missing), np.finfo(float).tiny))
            inverted[:, joint] = _shifted(smooth[:, joint]) @ (perfect + explained * response)
        return inverted

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
