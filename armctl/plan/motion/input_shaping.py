"""Input shaping: a motion that does not leave a known vibration behind.

The shaped motion is a weighted sum of the motion and of later copies of it, whose vibrations cancel: N. C. Singer and
W. P. Seering, "Preshaping command inputs to reduce system vibration" (1990). The weights are positive and sum to 1, so no limit
of position, speed, acceleration or jerk is exceeded.
"""

from __future__ import annotations

import math

import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array, choice, instance, number
from armctl.plan.motion.trajectory import piecewise
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces

_WEIGHTS = {"zv": (1, 1), "zvd": (1, 2, 1), "zvdd": (1, 3, 3, 1)}  # of the copies, without damping
_MAX_DAMPING_RATIO = 0.9
_AT_REST = 1e-6  # rad/s, and rad/s^2


def shape_motion(motion: JointTrajectory, frequency: float, damping_ratio: float = 0.0, shaper: str = "zv") -> JointTrajectory:
    """A motion from rest to rest, shaped so that it does not excite a vibration.

    Args:
        motion: A motion that starts and ends at rest.
        frequency: rad/s, of the vibration, with its damping. `Loop.modes` gives those of an arm with a controller.
        damping_ratio: Of the vibration.
        shaper: "zv" takes half a period longer and cancels the vibration of this frequency; "zvd" takes one period, and "zvdd"
            one and a half, and forgive a wrong frequency.

    Returns:
        The shaped motion: to the same end, with limits kept. Straight joint motions stay on their line; others leave their
        path a little.

    Raises:
        InputError: An argument has a wrong type or value, or the motion does not start and end at rest.
    """
    instance("motion", motion, JointTrajectory, "armctl.move_j(arm, start, end) is one")
    frequency = number("frequency", frequency, 1e-3, 1e5)
    damping_ratio = number("damping_ratio", damping_ratio, 0.0, _MAX_DAMPING_RATIO)
    binomial = np.array(_WEIGHTS[choice("shaper", shaper, _WEIGHTS)], dtype=np.float64)
    ends = motion.sample([0.0, motion.duration])
    if np.abs(ends.v).max() > _AT_REST or np.abs(ends.a).max() > _AT_REST:
        raise InputError("motion: it does not start and end at rest; shape the whole motion from rest to rest")
    decay = math.exp(-math.pi * damping_ratio / math.sqrt(1 - damping_ratio**2))  # in half a period
    weights = binomial * decay ** np.arange(len(binomial))
    delays = np.linspace(0.0, (len(binomial) - 1) * math.pi / frequency, len(binomial))
    pieces = _weighted(motion.pieces, weights / weights.sum(), delays)
    return JointTrajectory(*pieces, motion.joint_names, motion.limits, slowed=motion.slowed, units=motion.units)


def _weighted(pieces: Pieces, weights: Array, delays: Array) -> Pieces:
    """The weighted sum of delayed copies of a motion."""
    duration = pieces.knots[-1]
    knots = np.unique(np.concatenate([pieces.knots + delay for delay in delays]))
    starts = knots[:-1]
    middles = 0.5 * (starts + knots[1:])
    total = np.zeros((len(starts), *pieces.coefficients.shape[1:]))
    first = pieces.coefficients[0, 0]
    last = piecewise.sample(pieces, np.array([duration])).q[0]
    for weight, delay in zip(weights, delays, strict=True):
        inside = (middles > delay) & (middles < delay + duration)
        total[inside] += weight * piecewise.restarted(pieces, middles[inside] - delay, starts[inside] - delay)
        total[middles <= delay, 0] += weight * first
        total[middles >= delay + duration, 0] += weight * last
    return Pieces(knots, total)
