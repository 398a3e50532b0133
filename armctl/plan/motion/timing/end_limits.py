"""Motions within velocity limits that shrink near the ends of the joints' ranges.

A joint that decelerates with at most a and comes to rest at a position g has, at a position q before it, a velocity of at most
sqrt(2 a (g - q)). With the limit sqrt(2 A (q_max - q)) - c and the distance e = q_max - g, the smallest difference of both is
sqrt(2 e (A - a)) - c. So every motion with a <= A - c^2 / (2 e) keeps the limit, wherever it is fast.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NoReturn

import numpy as np

from armctl.core.errors import LimitError
from armctl.core.limits import Limits
from armctl.core.validation import Array, BoolArray
from armctl.plan.motion.trajectory.limit_check import RATIO_TOLERANCE
from armctl.plan.motion.trajectory.piecewise import Pieces, time_scaled
from armctl.plan.motion.trajectory.velocity_bounds import velocity_peaks

_FIRST_MARGIN = 1e-7  # of a slowdown; twice as much in each further one
_LEAST_SHARE = 1e-3  # of the acceleration limits: less is a motion into the zone at an end in which no speed is allowed
# Shares of the deceleration limit with which joints stop at an end. With the last one they can do so everywhere in the range of
# `room_to_stop`; with the others only farther inside, but they are faster.
END_SHARES = (0.9, 0.5)


def gentle_limits(limits: Limits, low: Array, high: Array, up: BoolArray, down: BoolArray) -> Limits:
    """Limits with which motions between the positions low and high (n,) keep the velocity limits near the ends.

    Args:
        up: (n,) whether a joint may come to rest while it moves towards its upper end.
        down: (n,) likewise towards its lower end.

    Raises:
        LimitError: A joint would have to move towards an end so near to it that no speed is allowed.
    """
    a_up = _deceleration(limits, limits.q_max - high, limits.v_max)
    a_down = _deceleration(limits, low - limits.q_min, -limits.v_low)
    least = _LEAST_SHARE * limits.deceleration_limit
    for moves, a, end in ((up, a_up, limits.q_max), (down, a_down, limits.q_min)):
        wrong = moves & np.isfinite(limits.deceleration_limit) & (a < least)
        if wrong.any():
            refuse_end(limits, int(wrong.argmax()), float(end[wrong.argmax()]))
    a_min = np.where(up, np.maximum(limits.a_low, -a_up), limits.a_low)
    a_max = np.where(down, np.minimum(limits.a_max, a_down), limits.a_max)
    return replace(limits, a_min=a_min, a_max=a_max)


def gentle_in_both_directions(limits: Limits, low: Array, high: Array) -> Limits:
    """`gentle_limits` that are the same in both directions."""
    everywhere = np.ones(len(low), dtype=bool)
    return gentle_limits(limits, low, high, everywhere, everywhere).symmetric


def room_to_stop(limits: Limits) -> Limits:
    """The same limits with a range in which a joint can come to rest everywhere with a share of its deceleration limit."""
    if not limits.depends_on_position:
        return limits
    room = limits.end_zones / (1.0 - END_SHARES[-1])
    middle = 0.5 * (limits.q_min + limits.q_max)
    middle = np.where(np.isfinite(middle), middle, limits.q_max)
    q_min = np.where(np.isfinite(limits.q_min), np.minimum(limits.q_min + room, middle), limits.q_min)
    return replace(limits, q_min=q_min, q_max=np.maximum(limits.q_max - room, q_min))


def slowed_into(pieces: Pieces, limits: Limits) -> Pieces:
    """A motion from rest to rest, slowed down as a whole to its velocity limits near the ends of the ranges.

    Raises:
        LimitError: A joint moves towards an end of its range so near to it that no speed is allowed.
    """
    if not limits.depends_on_position:
        return pieces
    margin = _FIRST_MARGIN
    while True:
        peaks = velocity_peaks(pieces.coefficients, np.diff(pieces.knots), limits)
        beyond = np.flatnonzero(peaks.excess > 0.5 * RATIO_TOLERANCE * limits.v_max[peaks.joint])
        if not len(beyond):
            return pieces
        with np.errstate(divide="ignore"):
            ratios = np.abs(peaks.value[beyond]) / np.abs(peaks.bound[beyond])
        worst = int(ratios.argmax())
        if not ratios[worst] < 1.0 / _LEAST_SHARE:
            at = int(beyond[worst])
            joint = int(peaks.joint[at])
            refuse_end(limits, joint, float((limits.q_max if peaks.value[at] > 0.0 else limits.q_min)[joint]))
        pieces = time_scaled(pieces, 1.0 / (ratios[worst] * (1.0 + margin)))
        margin *= 2.0  # each slowdown takes away at least twice as much as the one before, so that they come to an end


def _deceleration(limits: Limits, distance: Array, fastest: Array) -> Array:
    """(n,) rad/s^2, the greatest decelerations to rest at distances from an end, from speeds of at most `fastest`.

    Where the greatest speed is reached before the tangent point of both curves, it is the one that counts: with it, the
    deceleration ends where sqrt(2 A (x + e)) - c is the speed, x = v^2 / (2 a).
    """
    limit = limits.deceleration_limit
    offset = limits.velocity_offset
    with np.errstate(divide="ignore", invalid="ignore"):
        anywhere = limit - np.where(offset > 0.0, offset**2 / (2.0 * np.maximum(distance, 0.0)), 0.0)
        missing = (fastest + offset) ** 2 - 2.0 * limit * distance
        at_speed = np.where(missing > 0.0, limit * fastest**2 / missing, np.inf)
        tangent = np.where(at_speed < limit, at_speed * distance / (limit - at_speed), np.inf)
        is_first = fastest**2 / (2.0 * at_speed) <= tangent
    best = np.where(is_first, np.maximum(anywhere, at_speed), anywhere)
    return np.where(np.isfinite(limit) & np.isfinite(distance), best, np.inf)


def refuse_end(limits: Limits, joint: int, end: float) -> NoReturn:
    """Raises the LimitError of a motion that leads too near to an end of a joint's range."""
    raise LimitError(
        f"joint {joint + 1}: the motion leads so near to the end of its range, {end:.6g}, that no speed towards it is allowed; "
        f"stay {limits.end_zones[joint]:.3g} and more away from it"
    )
