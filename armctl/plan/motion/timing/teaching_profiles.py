"""Profiles of textbooks for a straight move from rest to rest: they keep velocity and acceleration limits, and no jerk limit.

Lynch and Park, "Modern Robotics", 2017, 9.2.2: quintic time scaling, and trapezoidal motion profiles.
"""

from __future__ import annotations

import math

import numpy as np

from armctl.core.validation import Array
from armctl.plan.motion.timing.otg import MIN_PIECE_S, Bounds
from armctl.plan.motion.trajectory.piecewise import DEGREE, Pieces, standing

# Of s(x) = 10 x^3 - 15 x^4 + 6 x^5 on [0, 1].
_QUINTIC = (0.0, 0.0, 0.0, 10.0, -15.0, 6.0)
_PEAK_VELOCITY = 15 / 8
_PEAK_ACCELERATION = 10 / math.sqrt(3)


def trapezoid(start: Array, goal: Array, bounds: Bounds) -> Pieces:
    """The fastest move with constant acceleration, constant velocity and constant deceleration, all joints in proportion."""
    way = goal - start
    v, a = _shares(way, bounds)
    if not math.isfinite(v):
        return standing(start)
    ramp = min(v / a, math.sqrt(1 / a))
    v = a * ramp
    cruise = max(0.0, (1 - v * ramp) / v)
    share = 0.5 * a * ramp**2
    rows = [(0.0, 0.0, 0.5 * a), (share, v, 0.0), (1 - share, v, -0.5 * a)]
    durations = [ramp, cruise, ramp]
    if cruise < MIN_PIECE_S:
        del rows[1], durations[1]
    coefficients = np.zeros((len(rows), DEGREE + 1, len(way)))
    coefficients[:, :3] = np.array(rows)[:, :, None] * way
    coefficients[:, 0] += start
    return Pieces(np.append(0.0, np.cumsum(durations)), coefficients)


def quintic(start: Array, goal: Array, bounds: Bounds) -> Pieces:
    """The fastest move along one polynomial of degree five, all joints in proportion: rest and no acceleration at its ends."""
    way = goal - start
    v, a = _shares(way, bounds)
    if not math.isfinite(v):
        return standing(start)
    duration = max(_PEAK_VELOCITY / v, math.sqrt(_PEAK_ACCELERATION / a))
    coefficients = np.array(_QUINTIC)[:, None] * way / duration ** np.arange(DEGREE + 1.0)[:, None]
    coefficients[0] += start
    return Pieces(np.array([0.0, duration]), coefficients[None])


def _shares(way: Array, bounds: Bounds) -> tuple[float, float]:
    """The greatest velocity, 1/s, and acceleration, 1/s^2, of the share of a way; infinite if there is none."""
    with np.errstate(divide="ignore"):
        return float((bounds[0] / np.abs(way)).min()), float((bounds[1] / np.abs(way)).min())
