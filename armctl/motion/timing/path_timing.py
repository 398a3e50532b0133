"""The fastest pace along a path of the joints, inside their limits on speed, acceleration and jerk, and inside caps.

A first guide runs along the path from rest to rest, the compiled solver finds the best pace of it on a coarse grid, that pace
is the guide of a finer one, and what still overshoots between the edges of the grid is tightened there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.motion.timing.initial_timing import Guide, Path, first_guide, smooth
from armctl.motion.trajectory.limit_check import piece_extremes
from armctl.motion.trajectory.piecewise import DEGREE, Pieces, basis_many, hermite

if TYPE_CHECKING:
    from armctl.motion.timing import path_timing_kernel as pace_kernel

_INTERVAL, _FEWEST, _MOST = 0.004, 60, 500  # s, and how many of them
_TIGHTENINGS, _TORQUE_TIGHTENINGS = 3, 6
_SLOWER = np.array([1, 1 / 2, 1 / 3, 1 / 2])  # the power of a stretch that lowers speed, acceleration, jerk and torque
_GOOD_ENOUGH = 1e-4
_APART = 2e-5  # s, between nodes: rounding tells nothing of the jerk in a shorter piece
_BOUNDLESS = 1e12
_MIN_DIP = 1e-2  # of the smaller squared speed at the ends of an interval
_BUSY = 0.8  # of a torque's limit, where it is looked at between nodes too
_STEADY = 0.02  # of the pace in the first and last interval, that it may change by


class TorqueRows(NamedTuple):
    """Bounds of the form low <= alpha b'/2 + beta b + delta sqrt(b) <= high, each (T, r).

    Attributes:
        alpha: Of the change of the squared pace.
        beta: Of the squared pace.
        delta: Of the pace.
        low: Less than 0.
        high: Greater than 0.
    """

    alpha: Array
    beta: Array
    delta: Array
    low: Array
    high: Array


class Torques(Protocol):
    """What bounds the torques of a motion."""

    def rows(self, q: Array, v: Array, a: Array) -> TorqueRows:
        """The bounds at places of a motion that is to be run at another pace.

        Args:
            q: (T, n) rad.
            v: (T, n) rad/s.
            a: (T, n) rad/s^2.

        Returns:
            The bounds.
        """
        ...

    def overshoot(self, q: Array, v: Array, a: Array) -> Array:
        """How much of what the bounds leave beside holding still a motion uses.

        Args:
            q: (T, n) rad.
            v: (T, n) rad/s.
            a: (T, n) rad/s^2.

        Returns:
            (T,), 1 is all.
        """
        ...


def fastest(path: Path, limits: Limits, caps: Callable[[Array], Array] | None = None) -> Pieces:
    """The fastest motion along a path, from rest to rest.

    Args:
        path: The path.
        limits: What the joints can do; positions are the path's own affair.
        caps: From lengths (T,) to the greatest speeds along the path (T,); none if left out.

    Returns:
        The motion.
    """
    problem = _Problem(path, limits, caps)
    guide = first_guide(path, limits)
    timed = problem.timed(guide, guide.edges)
    return _tightened(problem, _refined(timed, intervals_for(timed.t[-1])))


def slower(path: Path, limits: Limits, knots: Array, torques: Torques) -> Pieces:
    """A motion, at rest at both ends, run nowhere faster and slower where torques ask for it.

    Args:
        path: The motion, its length the time.
        limits: What the joints can do.
        knots: (m + 1,) s, where its jerk may jump.
        torques: What bounds the torques.

    Returns:
        The slower motion.
    """
    problem = _Problem(path, limits, np.ones_like, torques)
    intervals = intervals_for(path.length)
    return _tightened(problem, Guide(path.length / intervals, intervals, None), knots)


def intervals_for(duration: float) -> int:
    """How many intervals a motion is cut into.

    Args:
        duration: s.

    Returns:
        The number.
    """
    return max(_FEWEST, min(_MOST, math.ceil(duration / _INTERVAL)))


def _tightened(problem: _Problem, guide: Guide, knots: Array | None = None) -> Pieces:
    """The best pace of a guide, cut at knots too, its bounds tightened wherever it overshoots them between the edges."""
    nodes = guide.edges if knots is None else _merged(guide.edges, knots)
    interval = np.clip(np.searchsorted(guide.edges, 0.5 * (nodes[1:] + nodes[:-1])) - 1, 0, guide.intervals - 1)
    slack = np.ones((4, guide.intervals + 1))
    tried: list[tuple[Pieces, float]] = []
    for tightening in range(1 + (_TIGHTENINGS if problem.torques is None else _TORQUE_TIGHTENINGS)):
        pieces = hermite(*problem.timed(guide, nodes, slack if tightening else None))
        overshoot = problem.overshoot(pieces)
        tried.append((pieces, float(np.maximum(1.0, overshoot.max(axis=1) ** _SLOWER).max())))
        if (overshoot <= 1 + _GOOD_ENOUGH).all():
            break
        worst = np.ones((4, guide.intervals))
        for most, over in zip(worst, overshoot, strict=True):
            np.maximum.at(most, interval, over)
        slack[:, :-1] /= worst
        slack[:, 1:] /= worst
    pieces, stretch = min(tried, key=lambda one: one[1] * one[0].knots[-1])
    powers = stretch ** -np.arange(DEGREE + 1.0)
    return Pieces(pieces.knots * stretch, pieces.coefficients[:, :, :-1] * powers[:, None])


class _Timed(NamedTuple):
    """A motion at nodes: times (k,), joints and behind them the length (k, n + 1), first and second derivatives."""

    t: Array
    q: Array
    v: Array
    a: Array


class _Problem:
    """A path and all that bounds its pace."""

    def __init__(self, path: Path, limits: Limits, caps: Callable | None, torques: Torques | None = None):
        self.path, self.limits = path, limits
        self._caps, self.torques = caps, torques
        self._last: Array | None = None  # the last pace found, to tighten from

    def timed(self, guide: Guide, nodes: Array, slack: Array | None = None) -> _Timed:
        """The best pace of a guide, at nodes that include its edges; `slack` (4, m + 1) are factors on its bounds."""
        from armctl.motion.timing import path_timing_kernel as pace_kernel

        problem = self._bounds(guide, np.ones((4, guide.intervals + 1)) if slack is None else slack)
        c, barrier = np.full(guide.intervals + 2, 0.5 * float(problem.b_max.min())), pace_kernel.COLD
        if slack is not None and self._last is not None:
            c, barrier = 0.95 * self._last, pace_kernel.WARM
        while not np.isfinite(pace_kernel.value(c, problem, 1.0)):
            c *= 0.5
        pace_kernel.solve(problem, c, barrier)
        self._last = c
        b, slope = _squared_pace(c, guide.h, nodes)
        t = np.concatenate([[0.0], np.cumsum(_durations(c, guide.h, nodes))])
        s, s1, s2, _ = guide.at(nodes)
        q, d1, d2, _ = (np.column_stack(pair) for pair in zip(self.path.derivatives(s), _identity(s), strict=True))
        s1, s2, b, slope = (x[:, None] for x in (s1, s2, b, slope))
        q1, q2 = d1 * s1, d2 * s1**2 + d1 * s2
        return _Timed(t, q, q1 * np.sqrt(b), q2 * b + q1 * slope / 2)

    def overshoot(self, pieces: Pieces) -> Array:
        """How much of their limits speed, acceleration, jerk and torque use in each piece, (4, m): 1 is all."""
        limits, steps = self.limits, np.diff(pieces.knots)
        v_max = np.tile(np.append(limits.v_max, np.inf), (len(steps), 1))
        if self._caps is not None:
            caps = self._caps(np.append(pieces.coefficients[:, 0, -1], self.path.length))
            v_max[:, -1] = np.minimum(caps[1:], caps[:-1])
        bounds = (v_max, np.append(limits.a_max, np.inf), np.append(limits.j_max, np.inf))
        peaks = (np.abs(piece_extremes(pieces.coefficients, steps, order)[1]).max(axis=2) for order in (1, 2, 3))
        shares = [(peak / bound).max(axis=1) for peak, bound in zip(peaks, bounds, strict=True)]
        return np.array([*shares, self._torque_overshoot(pieces)])

    def _torque_overshoot(self, pieces: Pieces) -> Array:
        """How much of their limits torques use at the start of each piece and, where that is much, in its middle, (m,)."""
        steps, joints = np.diff(pieces.knots), pieces.coefficients[:, :, :-1]
        if self.torques is None:
            return np.zeros_like(steps)
        shares = self.torques.overshoot(joints[:, 0], joints[:, 1], 2 * joints[:, 2])
        busy = (shares > _BUSY) | (np.append(shares[1:], 0.0) > _BUSY)
        middle = np.einsum("otc,tcn->otn", basis_many(0.5 * steps[busy]), joints[busy])
        shares[busy] = np.maximum(shares[busy], self.torques.overshoot(*middle))
        return shares

    def _bounds(self, guide: Guide, slack: Array) -> pace_kernel.Problem:
        """What bounds the pace at the guide's edges."""
        from armctl.motion.timing import path_timing_kernel as pace_kernel

        s, s1, s2, s3 = guide.at(guide.edges)
        q, d1, d2, d3 = self.path.derivatives(s)
        s1, s2, s3 = (x[:, None] for x in (s1, s2, s3))
        q1, q2, q3 = d1 * s1, d2 * s1**2 + d1 * s2, d3 * s1**3 + 3 * d2 * s1 * s2 + d1 * s3
        j_max, ends = self.limits.j_max * slack[2][:, None], [0, -1]
        with np.errstate(divide="ignore"):
            b_max = ((self.limits.v_max / np.abs(q1)).min(axis=1) * slack[0]) ** 2
            if self._caps is not None:
                b_max = np.minimum(b_max, (self._caps(s) / np.abs(s1[:, 0]) * slack[0]) ** 2)
            b_max[ends] = np.minimum(b_max[ends], ((j_max[ends] / np.abs(q3[ends])) ** (2 / 3)).min(axis=1))
        b_max = np.minimum(b_max, _BOUNDLESS)
        rows = self._rows(q, q1, q2, slack)
        # At rest there is neither velocity nor acceleration to bound: instead the pace is held steady there.
        rows.alpha[ends], rows.beta[ends], rows.delta[ends] = 2.0, 0.0, 0.0
        rows.high[ends] = _STEADY * b_max[ends, None] / guide.h
        rows.low[ends] = -rows.high[ends]
        return pace_kernel.Problem(guide.h, b_max, q1, q2, q3, j_max, *rows)

    def _rows(self, q: Array, q1: Array, q2: Array, slack: Array) -> TorqueRows:
        a_max = self.limits.a_max * slack[1][:, None]
        rows = TorqueRows(q1.copy(), q2.copy(), np.zeros_like(q1), -a_max, a_max.copy())
        if self.torques is None:
            return rows
        torques = self.torques.rows(q, q1, q2)
        torques = torques._replace(low=torques.low * slack[3][:, None], high=torques.high * slack[3][:, None])
        return TorqueRows(*(np.concatenate(pair, axis=1) for pair in zip(rows, torques, strict=True)))


def _identity(s: Array) -> tuple[Array, Array, Array, Array]:
    """The length and its derivatives with respect to itself."""
    return s, np.ones_like(s), np.zeros_like(s), np.zeros_like(s)


def _refined(timed: _Timed, intervals: int) -> Guide:
    """The guide that a timed motion makes, smoothed a little."""
    coefficients = hermite(*timed).coefficients[:, :, -1]
    t = np.linspace(0.0, timed.t[-1], intervals // 2 + 1)
    k = np.clip(np.searchsorted(timed.t, t, side="right") - 1, 0, len(timed.t) - 2)
    s = (coefficients[k] * (t - timed.t[k])[:, None] ** np.arange(DEGREE + 1)).sum(axis=1)
    return smooth(t, s, intervals)


def _merged(edges: Array, knots: Array) -> Array:
    """Edges and knots in order, without knots that come too soon after another node or before an edge."""
    k = np.clip(np.searchsorted(edges, knots), 1, len(edges) - 1)
    apart = np.minimum(np.abs(knots - edges[k - 1]), np.abs(edges[k] - knots)) > _APART
    inner = knots[apart]
    kept = [knot for i, knot in enumerate(inner) if i == 0 or knot - inner[i - 1] > _APART]
    return np.sort(np.concatenate([edges, kept]))


def _squared_pace(c: Array, h: float, u: Array) -> tuple[Array, Array]:
    """The quadratic B-spline with coefficients c and its slope, at times u."""
    m = np.clip((u / h).astype(int), 0, len(c) - 3)
    x = u / h - m
    left, slope, bend = 0.5 * (c[m] + c[m + 1]), c[m + 1] - c[m], c[m + 2] - 2 * c[m + 1] + c[m]
    return left + x * (slope + 0.5 * x * bend), (slope + x * bend) / h


def _durations(c: Array, h: float, nodes: Array) -> Array:
    """The times from node to node: the integral of 1/w, by Gauss and Legendre's rule."""
    x, weight = np.polynomial.legendre.leggauss(5)
    length = np.diff(nodes)
    b, _ = _squared_pace(c, h, nodes[:-1, None] + 0.5 * length[:, None] * (x + 1))
    edges, _ = _squared_pace(c, h, nodes)
    # The solver keeps b positive at edges and middles only. Between them it can dip below 0 where limits are extreme.
    b = np.maximum(b, _MIN_DIP * np.minimum(edges[1:], edges[:-1])[:, None])
    return 0.5 * length * ((1 / np.sqrt(b)) @ weight)
