"""Velocity limits that shrink near the ends of the joints' ranges: exact checks of piecewise polynomials."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array, IntArray
from armctl.plan.motion.trajectory.polynomials import hull_of, on_unit_interval, polynomial_extremes


class VelocityPeaks(NamedTuple):
    """The states of joints in pieces in which they may be faster than an end of their range allows, each (K,)."""

    piece: IntArray
    joint: IntArray
    time: Array  # s since the piece began
    value: Array  # rad/s
    bound: Array  # rad/s, of the sign of the velocity

    @property
    def excess(self) -> Array:
        """(K,) rad/s by which the velocity is beyond its bound; less than 0 inside."""
        return np.abs(self.value) - np.abs(self.bound)


def velocity_peaks(coefficients: Array, steps: Array, limits: Limits) -> VelocityPeaks:
    """Where polynomials (m, d + 1, n) come nearest to the velocity limits near an end of a range, in (m,) s.

    With the distance d of the joint from its end and its velocity v towards it, the limit is (v + offset)^2 <= 2 a d where
    v > 0. The difference of both sides is a polynomial of the time: it is extreme at the ends of a piece or where its
    derivative is 0. Where v becomes 0 it is not largest, unless it is so on one of these. So if any state of a piece is beyond
    the limit, one of those found is. Pieces that keep it by the least distance and the greatest velocity are left out.
    """
    found = [_towards(side, coefficients, steps, limits) for side in (1.0, -1.0)]
    return VelocityPeaks(*(np.concatenate(pair) for pair in zip(*found, strict=True)))


def _towards(side: float, coefficients: Array, steps: Array, limits: Limits) -> VelocityPeaks:
    """`velocity_peaks` towards the upper ends of the ranges, or with -1 towards the lower ends."""
    end = limits.q_max if side > 0 else -limits.q_min
    is_limited = np.isfinite(limits.deceleration_limit) & np.isfinite(end)
    end = np.where(is_limited, end, 0.0)
    limit = np.where(is_limited, limits.deceleration_limit, 0.0)
    offset = limits.velocity_offset
    q = side * on_unit_interval(coefficients, steps, 0)
    v = side * on_unit_interval(coefficients, steps, 1)
    least_distance = np.maximum(end - hull_of(q).max(axis=0), 0.0)
    fastest = hull_of(v).max(axis=0)
    piece, joint = np.nonzero(is_limited & (fastest > 0.0) & (fastest + offset > np.sqrt(2.0 * limit * least_distance)))
    if not len(piece):
        return VelocityPeaks(piece, joint, *np.zeros((3, 0)))
    margin = _product(v[:, piece, joint], offset[joint])
    margin[: len(q)] += 2.0 * limit[joint] * q[:, piece, joint]
    margin[0] -= 2.0 * limit[joint] * end[joint]
    places = polynomial_extremes(margin.T[:, :, None])[0][:, 0]
    positions = _evaluated(q[:, piece, joint], places)
    values = _evaluated(v[:, piece, joint], places)
    bounds = np.maximum(
        np.sqrt(2.0 * limit[joint, None] * np.maximum(end[joint, None] - positions, 0.0)) - offset[joint, None], 0.0
    )
    excess = np.where(values > 0.0, values - bounds, -np.inf)
    worst = (np.arange(len(piece)), excess.argmax(axis=1))
    moves = values[worst] > 0.0
    return VelocityPeaks(
        piece[moves],
        joint[moves],
        (places[worst] * steps[piece])[moves],
        side * values[worst][moves],
        side * bounds[worst][moves],
    )


def _product(v: Array, offset: Array) -> Array:
    """The coefficients of (v + offset)^2 of polynomials (d + 1, K)."""
    moved = v.copy()
    moved[0] += offset
    square = np.zeros((2 * len(v) - 1, v.shape[1]))
    for i, c in enumerate(moved):
        square[i : i + len(v)] += c * moved
    return square


def _evaluated(p: Array, x: Array) -> Array:
    """Polynomials (d + 1, K) at points (K, k)."""
    value = np.zeros_like(x)
    for c in p[::-1]:
        value = value * x + c[:, None]
    return value
