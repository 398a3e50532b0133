"""Time-optimal path parameterization with limits on velocity, acceleration, jerk and torque, and with caps on the path speed.

An initial timing runs along the path from rest to rest. The compiled solver finds the best speed for it on a coarse grid; the
result is the timing on a finer grid. Bounds that are still exceeded between the edges of the grid are tightened there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.motion.timing.initial_timing import Path, Timing, initial_timing, smooth_timing
from armctl.motion.trajectory.limit_check import piece_extremes
from armctl.motion.trajectory.piecewise import DEGREE, Pieces, basis_many, hermite

if TYPE_CHECKING:
    from armctl.motion.timing import path_timing_kernel as kernel

_INTERVAL_S = 0.004
_MIN_INTERVALS = 60
_MAX_INTERVALS = 500
_MAX_TIGHTENINGS = 3
_MAX_TORQUE_TIGHTENINGS = 6
# Exponents of the overshoot of velocity, acceleration, jerk and torque that give the stretch in time which removes it.
_STRETCH_EXPONENTS = np.array([1, 1 / 2, 1 / 3, 1 / 2])
_OVERSHOOT_TOLERANCE = 1e-4  # relative; a stretch in time removes the rest
_MIN_NODE_DISTANCE_S = 2e-5  # rounding decides the jerk of a shorter piece
_MAX_SQUARED_SPEED = 1e12  # of the path speed, where nothing bounds it
_MIN_DIP = 1e-2  # of the smaller squared speed at the ends of an interval
# Torques vary between grid nodes. Above this share of a limit they are also checked between the nodes.
_TORQUE_SHARE_CHECKED_BETWEEN_NODES = 0.8
_MAX_END_SPEED_CHANGE = 0.02  # relative, of the squared path speed in the first and in the last interval


class TorqueRows(NamedTuple):
    """Bounds of the form low <= alpha b'/2 + beta b + delta sqrt(b) <= high, each (T, r).

    Attributes:
        alpha: Of the change of the squared path speed.
        beta: Of the squared path speed.
        delta: Of the path speed.
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
        """The bounds at places of a motion that is to run at another speed.

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


def time_optimal(path: Path, limits: Limits, caps: Callable[[Array], Array] | None = None) -> Pieces:
    """The time-optimal motion along a path, from rest to rest.

    Args:
        path: The path.
        limits: What the joints can do; positions are the path's own affair.
        caps: From lengths (T,) to the greatest speeds along the path (T,); none if left out.

    Returns:
        The motion.
    """
    problem = _Problem(path, limits, caps)
    timing = initial_timing(path, limits)
    timed = problem.timed(timing, timing.edges)
    return _tightened(problem, _refined(timed, intervals_for(timed.t[-1])))


def slowed_down(path: Path, limits: Limits, knots: Array, torques: Torques) -> Pieces:
    """A motion, at rest at both ends, slower where the torques require it and never faster.

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
    return _tightened(problem, Timing(path.length / intervals, intervals, None), knots)


def intervals_for(duration: float) -> int:
    """How many intervals a motion is cut into.

    Args:
        duration: s.

    Returns:
        The number.
    """
    return max(_MIN_INTERVALS, min(_MAX_INTERVALS, math.ceil(duration / _INTERVAL_S)))


def _tightened(problem: _Problem, timing: Timing, knots: Array | None = None) -> Pieces:
    """The best path speed for a timing, cut at knots too, its bounds tightened where it exceeds them between the edges."""
    nodes = timing.edges if knots is None else _merged(timing.edges, knots)
    interval = np.clip(np.searchsorted(timing.edges, 0.5 * (nodes[1:] + nodes[:-1])) - 1, 0, timing.intervals - 1)
    slack = np.ones((4, timing.intervals + 1))
    tried: list[tuple[Pieces, float]] = []
    for tightening in range(1 + (_MAX_TIGHTENINGS if problem.torques is None else _MAX_TORQUE_TIGHTENINGS)):
        pieces = hermite(*problem.timed(timing, nodes, slack if tightening else None))
        overshoot = problem.overshoot(pieces)
        tried.append((pieces, float(np.maximum(1.0, overshoot.max(axis=1) ** _STRETCH_EXPONENTS).max())))
        if (overshoot <= 1 + _OVERSHOOT_TOLERANCE).all():
            break
        worst = np.ones((4, timing.intervals))
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
    """A path and all bounds on its speed."""

    def __init__(self, path: Path, limits: Limits, caps: Callable | None, torques: Torques | None = None):
        self.path = path
        self.limits = limits
        self._caps = caps
        self.torques = torques
        self._last: Array | None = None  # the last solution, to tighten from

    def timed(self, timing: Timing, nodes: Array, slack: Array | None = None) -> _Timed:
        """The best path speed for a timing, at nodes that include its edges; `slack` (4, m + 1) are factors on its bounds."""
        from armctl.motion.timing import path_timing_kernel as kernel

        problem = self._bounds(timing, np.ones((4, timing.intervals + 1)) if slack is None else slack)
        c = np.full(timing.intervals + 2, 0.5 * float(problem.b_max.min()))
        barrier = kernel.BARRIER_COLD
        if slack is not None and self._last is not None:
            c = 0.95 * self._last
            barrier = kernel.BARRIER_WARM
        while not np.isfinite(kernel.value(c, problem, 1.0)):
            c *= 0.5
        kernel.solve(problem, c, barrier)
        self._last = c
        b, slope = _squared_speed(c, timing.h, nodes)
        t = np.concatenate([[0.0], np.cumsum(_durations(c, timing.h, nodes))])
        s, s1, s2, _ = timing.at(nodes)
        derivatives = [np.column_stack(pair) for pair in zip(self.path.derivatives(s), _identity(s), strict=True)]
        q = derivatives[0]
        d1 = derivatives[1]
        d2 = derivatives[2]
        s1 = s1[:, None]
        s2 = s2[:, None]
        b = b[:, None]
        slope = slope[:, None]
        q1 = d1 * s1
        q2 = d2 * s1**2 + d1 * s2
        return _Timed(t, q, q1 * np.sqrt(b), q2 * b + q1 * slope / 2)

    def overshoot(self, pieces: Pieces) -> Array:
        """How much of their limits speed, acceleration, jerk and torque use in each piece, (4, m): 1 is all."""
        limits = self.limits
        steps = np.diff(pieces.knots)
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
        steps = np.diff(pieces.knots)
        joints = pieces.coefficients[:, :, :-1]
        if self.torques is None:
            return np.zeros_like(steps)
        shares = self.torques.overshoot(joints[:, 0], joints[:, 1], 2 * joints[:, 2])
        checked = (shares > _TORQUE_SHARE_CHECKED_BETWEEN_NODES) | (
            np.append(shares[1:], 0.0) > _TORQUE_SHARE_CHECKED_BETWEEN_NODES
        )
        middle = np.einsum("otc,tcn->otn", basis_many(0.5 * steps[checked]), joints[checked])
        shares[checked] = np.maximum(shares[checked], self.torques.overshoot(*middle))
        return shares

    def _bounds(self, timing: Timing, slack: Array) -> kernel.Problem:
        """The bounds on the path speed at the timing's edges."""
        from armctl.motion.timing import path_timing_kernel as kernel

        s, s1, s2, s3 = timing.at(timing.edges)
        q, d1, d2, d3 = self.path.derivatives(s)
        s1 = s1[:, None]
        s2 = s2[:, None]
        s3 = s3[:, None]
        q1 = d1 * s1
        q2 = d2 * s1**2 + d1 * s2
        q3 = d3 * s1**3 + 3 * d2 * s1 * s2 + d1 * s3
        j_max = self.limits.j_max * slack[2][:, None]
        ends = [0, -1]
        with np.errstate(divide="ignore"):
            b_max = ((self.limits.v_max / np.abs(q1)).min(axis=1) * slack[0]) ** 2
            if self._caps is not None:
                b_max = np.minimum(b_max, (self._caps(s) / np.abs(s1[:, 0]) * slack[0]) ** 2)
            b_max[ends] = np.minimum(b_max[ends], ((j_max[ends] / np.abs(q3[ends])) ** (2 / 3)).min(axis=1))
        b_max = np.minimum(b_max, _MAX_SQUARED_SPEED)
        rows = self._rows(q, q1, q2, slack)
        # At rest there is neither velocity nor acceleration to bound: instead the path speed is nearly constant there.
        rows.alpha[ends] = 2.0
        rows.beta[ends] = 0.0
        rows.delta[ends] = 0.0
        rows.high[ends] = _MAX_END_SPEED_CHANGE * b_max[ends, None] / timing.h
        rows.low[ends] = -rows.high[ends]
        return kernel.Problem(timing.h, b_max, q1, q2, q3, j_max, *rows)

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


def _refined(timed: _Timed, intervals: int) -> Timing:
    """The timing that a timed motion makes, smoothed a little."""
    coefficients = hermite(*timed).coefficients[:, :, -1]
    t = np.linspace(0.0, timed.t[-1], intervals // 2 + 1)
    k = np.clip(np.searchsorted(timed.t, t, side="right") - 1, 0, len(timed.t) - 2)
    s = (coefficients[k] * (t - timed.t[k])[:, None] ** np.arange(DEGREE + 1)).sum(axis=1)
    return smooth_timing(t, s, intervals)


def _merged(edges: Array, knots: Array) -> Array:
    """Edges and knots in order, without knots that come too soon after another node or before an edge."""
    k = np.clip(np.searchsorted(edges, knots), 1, len(edges) - 1)
    apart = np.minimum(np.abs(knots - edges[k - 1]), np.abs(edges[k] - knots)) > _MIN_NODE_DISTANCE_S
    inner = knots[apart]
    kept = [knot for i, knot in enumerate(inner) if i == 0 or knot - inner[i - 1] > _MIN_NODE_DISTANCE_S]
    return np.sort(np.concatenate([edges, kept]))


def _squared_speed(c: Array, h: float, u: Array) -> tuple[Array, Array]:
    """The quadratic B-spline with coefficients c and its slope, at times u."""
    m = np.clip((u / h).astype(int), 0, len(c) - 3)
    x = u / h - m
    left = 0.5 * (c[m] + c[m + 1])
    slope = c[m + 1] - c[m]
    bend = c[m + 2] - 2 * c[m + 1] + c[m]
    return left + x * (slope + 0.5 * x * bend), (slope + x * bend) / h


def _durations(c: Array, h: float, nodes: Array) -> Array:
    """The times from node to node: the integral of 1/w, by Gauss and Legendre's rule."""
    x, weight = np.polynomial.legendre.leggauss(5)
    length = np.diff(nodes)
    b, _ = _squared_speed(c, h, nodes[:-1, None] + 0.5 * length[:, None] * (x + 1))
    edges, _ = _squared_speed(c, h, nodes)
    # The solver keeps b positive at edges and middles only. Between them it can dip below 0 where limits are extreme.
    b = np.maximum(b, _MIN_DIP * np.minimum(edges[1:], edges[:-1])[:, None])
    return 0.5 * length * ((1 / np.sqrt(b)) @ weight)
