"""Smooth paths through waypoints, and their time-optimal motions.

Where waypoints are dense, they determine the path, and all that is left to choose is the speed along it. The path is a cubic
spline; between corners at which the arm stops, lines are exactly straight.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array, IntArray
from armctl.plan.motion.timing.otg import MIN_PIECE_S, straight_rest_to_rest
from armctl.plan.motion.timing.path_timing import time_optimal, times_at
from armctl.plan.motion.trajectory.limit_check import limit_excess
from armctl.plan.motion.trajectory.piecewise import Pieces, hermite, jerk, joined, joints_of, restarted, sample

_MIN_WAYPOINTS = 3  # of a path that may be smooth
_MAX_SMOOTH_ANGLE = np.pi / 3  # rad, between the chords before and behind a waypoint of a smooth path
_MIN_SMOOTH_SHARE = 0.5  # of the inner waypoints of a path that may be smooth
_CORNER_ANGLE = np.pi / 6  # rad, between two chords: a larger one may be worth a stop
_MAX_CURVES = 16  # between stops; each takes some 30 ms to time
_OFF_LINE = 1e-11  # rad (m), of waypoints on a straight line: rounding
_POSITION_ROUNDING = 1e-10  # rad (m)
_MIN_RECORDED = 20  # waypoints of a recording
_AT_LIMIT = 1e-9  # rad (m), nearer to a limit than this a joint is at it
_AT_BOTH_ENDS = 64.0  # times height / length^2: second derivatives that push a quintic by twice the height in its middle
_MAX_PUSHES = 12
_EVEN = 1.25  # the longest chord over the shortest one, of waypoints at which chords and numbers give the same path
_QUADRATURE = np.polynomial.legendre.leggauss(5)  # points in [-1, 1] and weights of Gauss and Legendre's rule


class Passage(NamedTuple):
    """A motion through waypoints from rest to rest, and the times at which it passes each of them."""

    pieces: Pieces
    times: Array  # (k,) s


def passage_of(parts: Sequence[Passage | Pieces]) -> Passage:
    """Motions from waypoint to waypoint, or through several, one after another."""
    passages = [Passage(part, part.knots[[0, -1]]) if isinstance(part, Pieces) else part for part in parts]
    pieces = joined([passage.pieces for passage in passages])
    starts = pieces.knots[np.cumsum([0, *(len(passage.pieces.coefficients) for passage in passages)])]
    times = [passage.times[1:] - passage.times[-1] + end for passage, end in zip(passages, starts[1:], strict=True)]
    return Passage(pieces, np.concatenate([[0.0], *times]))


class WaypointPath:
    """A path through waypoints with continuous first and second derivatives, inside the position limits."""

    def __init__(self, q: Array, lengths: Array, limits: Limits):
        """For waypoints q (k, n) inside the limits, at increasing lengths (k,) from 0.

        A cubic spline. Where it leaves the limits between two waypoints, its second derivatives there are changed: they push a
        quintic in its middle. At a limit itself a joint has no first derivative. Where this does not help, it passes both
        waypoints without first and second derivative: then the quintic between them is monotone.
        """
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(lengths, q)
        slope = spline(lengths, 1)
        curvature = spline(lengths, 2)
        self.length = float(lengths[-1])
        is_high = limits.q_max - q < q - limits.q_min
        at_limit = np.minimum(limits.q_max - q, q - limits.q_min) < _AT_LIMIT
        step = np.diff(lengths)[:, None]
        for _ in range(_MAX_PUSHES):
            self._pieces = hermite(lengths, q, slope, curvature)
            excess = self._excess(limits)
            if not excess.any():
                return
            push = _AT_BOTH_ENDS * excess / step**2
            curvature -= np.where(is_high, 1.0, -1.0) * _larger_beside(push)
            touching = at_limit & (_larger_beside(excess) > 0.0)
            slope[touching] = 0.0
            curvature[touching & (np.where(is_high, curvature, -curvature) > 0.0)] = 0.0
        while True:
            self._pieces = hermite(lengths, q, slope, curvature)
            beside = (_larger_beside(self._excess(limits)) > 0.0) & ((slope != 0.0) | (curvature != 0.0))
            if not beside.any():
                return
            slope[beside] = 0.0
            curvature[beside] = 0.0

    def _excess(self, limits: Limits) -> Array:
        """(k - 1, n) rad, by how much a joint leaves its limits between two waypoints."""
        knots, coefficients = self._pieces
        excess = limit_excess(coefficients, np.diff(knots), 0, limits.q_min, limits.q_max)
        return np.where(excess > _POSITION_ROUNDING, excess, 0.0)

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq/ds, d2q/ds2 and d3q/ds3, each (T, n), at lengths (T,)."""
        inside = np.clip(s, 0.0, self.length)  # of rounding; a motion has no velocity outside
        q, slope, curvature = sample(self._pieces, inside)
        return q, slope, curvature, jerk(self._pieces, inside)


def _larger_beside(sections: Array) -> Array:
    """(k, n) for each waypoint the larger of the numbers of the sections before and behind it, (k - 1, n), at least 0."""
    none = np.zeros((1, sections.shape[1]))
    return np.maximum(np.concatenate([sections, none]), np.concatenate([none, sections]))


def may_be_smooth(q: Array, limits: Limits) -> bool:
    """Whether waypoints q (k, n) look like points of a smooth path, or of a few: most of them are no corners."""
    return len(q) >= _MIN_WAYPOINTS and float((_angles(q, limits) < _MAX_SMOOTH_ANGLE).mean()) >= _MIN_SMOOTH_SHARE


def along_smooth_paths(q: Array, limits: Limits) -> list[Passage]:
    """Time-optimal motions along smooth paths through waypoints q (k, n), no two neighbours equal.

    The parameter of one path is its length; of another one the number of the waypoint, which suits points that were recorded at
    a fixed rate; a third one stops at corners.
    """
    if _is_straight(q):
        return [_straight(q, limits)]
    found = [_along(q, arc_lengths(q, limits), limits)]
    chords = _chords(q, limits)
    if len(q) >= _MIN_RECORDED and chords.max() > _EVEN * chords.min():
        found.append(_along(q, chords.mean() * np.arange(len(q)), limits))
    found.append(_with_stops(q, limits))
    return [passage for passage in found if passage is not None]


def straight_runs(q: Array) -> IntArray:
    """(r + 1,) numbers of waypoints, with the first and the last one: the others are on lines between them, in order."""
    ahead = np.diff(q, axis=0)
    way = q[2:] - q[:-2]
    squared = np.maximum((way * way).sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    share = (ahead[:-1] * way).sum(axis=1, keepdims=True) / squared
    off = np.abs(ahead[:-1] - share * way).max(axis=1)
    is_on_line = (off <= _OFF_LINE) & (share[:, 0] > 0.0) & (share[:, 0] < 1.0)
    ends = np.concatenate([[0], 1 + np.flatnonzero(~is_on_line), [len(q) - 1]])
    kept = [
        np.array([begin, end]) if _is_straight(q[begin : end + 1]) else np.arange(begin, end + 1)
        for begin, end in pairwise(ends)
    ]
    return np.unique(np.concatenate(kept))


def _is_straight(q: Array) -> bool:
    """Whether waypoints (k, n) are on a straight line in their order, as a whole."""
    way = q[-1] - q[0]
    squared = float(way @ way)
    if squared == 0.0:
        return False
    share = (q - q[0]) @ way / squared
    return bool(np.abs(q - q[0] - share[:, None] * way).max() <= _OFF_LINE and (np.diff(share) > 0.0).all())


def _chords(q: Array, limits: Limits) -> Array:
    """(k - 1,) the distances of neighbours, as times: the velocity limits of the joints are the unit."""
    return np.linalg.norm(np.diff(q, axis=0) / limits.v_max, axis=1)


def arc_lengths(q: Array, limits: Limits) -> Array:
    """(k,) the lengths of a smooth path from its start to each waypoint, in the unit of `_chords`.

    With the lengths of the chords as parameter, the speed of the spline changes where long and short chords alternate.
    """
    from scipy.interpolate import CubicSpline

    chords = _chords(q, limits)
    lengths = np.append(0.0, np.cumsum(chords))
    places, weights = _QUADRATURE
    spline = CubicSpline(lengths, q / limits.v_max)
    speed = np.linalg.norm(spline(lengths[:-1, None] + 0.5 * chords[:, None] * (places + 1), 1), axis=2)
    return np.append(0.0, np.cumsum(0.5 * chords * (speed @ weights)))


def _angles(q: Array, limits: Limits) -> Array:
    """(k - 2,) rad, the angles between the chords before and behind the inner waypoints."""
    ways = np.diff(q, axis=0) / limits.v_max
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return np.arccos(np.clip((ways[1:] * ways[:-1]).sum(axis=1), -1.0, 1.0))


def _along(q: Array, lengths: Array, limits: Limits) -> Passage | None:
    """The time-optimal motion along a smooth path; None if none can be computed."""
    try:
        pieces = time_optimal(WaypointPath(q, lengths, limits), limits, knots=lengths)
    except PlanError:
        return None
    return Passage(joints_of(pieces), times_at(pieces, lengths))


def _with_stops(q: Array, limits: Limits) -> Passage | None:
    """The motion that stops at corners, and follows a line or a smooth path between them; None if there are too many."""
    corners = 1 + np.flatnonzero(_angles(q, limits) > _CORNER_ANGLE)
    ends = np.concatenate([[0], corners, [len(q) - 1]])
    parts = [q[begin : end + 1] for begin, end in pairwise(ends)]
    curves = [not _is_straight(part) for part in parts]
    if sum(curves) > _MAX_CURVES or len(parts) == 1:
        return None
    passages: list[Passage] = []
    for part, is_curve in zip(parts, curves, strict=True):
        passage = _along(part, arc_lengths(part, limits), limits) if is_curve else _straight(part, limits)
        if passage is None:
            return None
        passages.append(passage)
    return passage_of(passages)


def _straight(q: Array, limits: Limits) -> Passage:
    """The straight move through waypoints on a line."""
    lengths = np.append(0.0, np.cumsum(_chords(q, limits)))
    bounds = [np.append(bound, np.inf) for bound in (limits.v_max, limits.a_max, limits.j_max)]
    pieces = straight_rest_to_rest(np.append(q[0], 0.0), np.append(q[-1], lengths[-1]), (bounds[0], bounds[1], bounds[2]))
    times = times_at(pieces, lengths)
    return Passage(_cut(joints_of(pieces), times), times)


def _cut(pieces: Pieces, times: Array) -> Pieces:
    """A motion whose knots include some times, so that nothing between knots hides where it is then."""
    knots = np.union1d(pieces.knots, times)
    knots = knots[np.diff(knots, append=np.inf) > MIN_PIECE_S]
    middle = 0.5 * (knots[1:] + knots[:-1])
    return Pieces(knots, restarted(pieces, middle, knots[:-1]))
