"""The fastest pace along a path of the joints, inside their limits on speed, acceleration and jerk, and inside caps.

A first guide runs along the path from rest to rest, the compiled solver finds the best pace of it on a coarse grid, that pace
is the guide of a finer one, and what still overshoots between the edges of the grid is tightened there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from armctl.arrays import Array
from armctl.motion.joint_trajectory import DEGREE
from armctl.motion.peaks import piece_extremes
from armctl.motion.profiles import Pieces
from armctl.trajectory import Limits

_COARSE, _FINE_STEP, _FINE_MOST = 120, 0.004, 400  # intervals, s, intervals
_TIGHTENINGS = 3
_GOOD_ENOUGH = 1e-4
_STEADY = 0.02  # of the pace in the first and last interval, that it may change by


class Path(Protocol):
    """A path of the joints, as a function of its length."""

    @property
    def length(self) -> float:
        """In whatever unit the path is measured in."""
        ...

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """Positions and three derivatives.

        Args:
            s: (T,) lengths.

        Returns:
            q, dq/ds, d2q/ds2 and d3q/ds3, each (T, n).
        """
        ...


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


class Guide(NamedTuple):
    """A path's length over time and its derivatives, at the edges of equal intervals.

    Attributes:
        h: s, an interval.
        s: (m + 1,) length.
        s1: Its first derivative.
        s2: The second.
        s3: The third.
    """

    h: float
    s: Array
    s1: Array
    s2: Array
    s3: Array


def fastest(
    path: Path,
    limits: Limits,
    *,
    caps: Callable[[Array], Array] | None = None,
    torques: Callable[[Array, Array, Array], TorqueRows] | None = None,
    guide: Guide | None = None,
) -> Pieces:
    """The fastest motion along a path, from rest to rest.

    Args:
        path: The path.
        limits: What the joints can do; positions are the path's own affair.
        caps: From lengths (T,) to the greatest speeds along the path (T,); none if left out.
        torques: From q, q' and q'' (T, n) of a guide to what bounds its torques; none if left out.
        guide: A motion along the path to begin with; left out, one is made.

    Returns:
        The motion.
    """
    problem = _Problem(path, limits, caps, torques)
    guide = guide or _first_guide(path, limits)
    timed = problem.timed(guide)
    guide = _refined(timed, max(60, min(_FINE_MOST, math.ceil(timed.t[-1] / _FINE_STEP))))
    slack = np.ones((3, len(guide.s)))
    pieces = _hermite(problem.timed(guide, slack))
    overshoot = problem.overshoot(pieces)
    for _ in range(_TIGHTENINGS):
        if (overshoot <= 1 + _GOOD_ENOUGH).all():
            break
        worst = np.maximum(overshoot, 1.0)
        slack[:, :-1] /= worst
        slack[:, 1:] /= worst
        pieces = _hermite(problem.timed(guide, slack))
        overshoot = problem.overshoot(pieces)
    stretch = float(np.maximum(1.0, overshoot.max(axis=1) ** (1 / np.arange(1, 4))).max())
    powers = stretch ** -np.arange(DEGREE + 1.0)
    return Pieces(pieces.knots * stretch, pieces.coefficients[:, :, :-1] * powers[:, None])


class _Timed(NamedTuple):
    """A motion at the edges: times (m + 1,), joints and the length behind them (m + 1, n + 1), first and second derivatives."""

    t: Array
    q: Array
    v: Array
    a: Array


class _Problem:
    """A path and all that bounds its pace."""

    def __init__(self, path: Path, limits: Limits, caps: Callable | None, torques: Callable | None):
        self.path, self.limits = path, limits
        self._caps, self._torques = caps, torques

    def timed(self, guide: Guide, slack: Array | None = None) -> _Timed:
        """The best pace of a guide, its bounds on speed, acceleration and jerk times the slack (3, m + 1)."""
        from armctl.motion import pace_kernel

        slack = np.ones((3, len(guide.s))) if slack is None else slack
        q, q1, q2, q3 = _along(self.path, guide)
        rows = self._rows(q, q1, q2, slack[1])
        j_max = self.limits.j_max * slack[2][:, None]
        with np.errstate(divide="ignore"):
            b_max = ((self.limits.v_max / np.abs(q1)).min(axis=1) * slack[0]) ** 2
            if self._caps is not None:
                b_max = np.minimum(b_max, (self._caps(guide.s) / np.abs(guide.s1) * slack[0]) ** 2)
            ends = [0, -1]
            b_max[ends] = ((j_max[ends] / np.abs(q3[ends])) ** (2 / 3)).min(axis=1)
        b_max = np.minimum(b_max, 1e12)
        # At rest there is neither velocity nor acceleration to bound: instead the pace is held steady there.
        rows.alpha[ends], rows.beta[ends], rows.delta[ends] = 2.0, 0.0, 0.0
        rows.high[ends] = _STEADY * b_max[ends, None] / guide.h
        rows.low[ends] = -rows.high[ends]
        problem = pace_kernel.Problem(guide.h, b_max, q1, q2, q3, j_max, *rows)
        c = np.full(len(guide.s) + 1, 0.5 * float(b_max.min()))
        while not np.isfinite(pace_kernel.value(c, problem, 1.0)):
            c *= 0.5
        pace_kernel.solve(problem, c)
        b, slope = 0.5 * (c[1:] + c[:-1]), np.diff(c) / guide.h
        w = np.sqrt(b)[:, None]
        q, q1, q2 = (np.column_stack(pair) for pair in ((q, guide.s), (q1, guide.s1), (q2, guide.s2)))
        return _Timed(_times(c, guide.h), q, q1 * w, q2 * b[:, None] + q1 * slope[:, None] / 2)

    def overshoot(self, pieces: Pieces) -> Array:
        """How much of their limits speed, acceleration and jerk use in each piece, (3, m): 1 is all."""
        limits, steps = self.limits, np.diff(pieces.knots)
        v_max = np.column_stack([np.broadcast_to(limits.v_max, (len(steps), len(limits.v_max))), np.full(len(steps), np.inf)])
        if self._caps is not None:
            s = np.append(pieces.coefficients[:, 0, -1], self.path.length)
            caps = self._caps(s)
            v_max[:, -1] = np.minimum(caps[1:], caps[:-1])
        bounds = (v_max, np.append(limits.a_max, np.inf), np.append(limits.j_max, np.inf))
        peaks = (np.abs(piece_extremes(pieces.coefficients, steps, order)[1]).max(axis=2) for order in (1, 2, 3))
        return np.array([(peak / bound).max(axis=1) for peak, bound in zip(peaks, bounds, strict=True)])

    def _rows(self, q: Array, q1: Array, q2: Array, slack: Array) -> TorqueRows:
        a_max = self.limits.a_max * slack[:, None]
        rows = TorqueRows(q1.copy(), q2.copy(), np.zeros_like(q1), -a_max, a_max.copy())
        if self._torques is None:
            return rows
        return TorqueRows(*(np.concatenate(pair, axis=1) for pair in zip(rows, self._torques(q, q1, q2), strict=True)))


def _along(path: Path, guide: Guide) -> tuple[Array, Array, Array, Array]:
    """The joints and their derivatives with respect to the guide's time, at its edges."""
    q, d1, d2, d3 = path.derivatives(guide.s)
    s1, s2, s3 = (x[:, None] for x in guide[2:])
    return q, d1 * s1, d2 * s1**2 + d1 * s2, d3 * s1**3 + 3 * d2 * s1 * s2 + d1 * s3


def _first_guide(path: Path, limits: Limits) -> Guide:
    """From rest to rest, the joints together at an even speed in between: a path by a singularity needs that."""
    from scipy.interpolate import CubicSpline

    s = np.linspace(0.0, path.length, 4 * _COARSE + 1)
    rate = np.linalg.norm(path.derivatives(s)[1] / limits.v_max, axis=1)
    rate += 1e-3 * rate.mean()
    way = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(s))])
    u = np.linspace(0.0, 1.0, _COARSE // 2 + 1)
    step = u**3 * (10 + u * (6 * u - 15))
    duration = 2 * float(way[-1])
    return _smooth(u * duration, np.clip(CubicSpline(way, s)(way[-1] * step), 0.0, path.length), _COARSE)


def _refined(timed: _Timed, intervals: int) -> Guide:
    """The guide that a timed motion makes, smoothed a little."""
    coefficients = _hermite(timed).coefficients[:, :, -1]
    t = np.linspace(0.0, timed.t[-1], intervals // 2 + 1)
    k = np.clip(np.searchsorted(timed.t, t, side="right") - 1, 0, len(timed.t) - 2)
    s = (coefficients[k] * (t - timed.t[k])[:, None] ** np.arange(DEGREE + 1)).sum(axis=1)
    return _smooth(t, s, intervals)


def _smooth(t: Array, s: Array, intervals: int) -> Guide:
    """The guide along a spline of degree five, at rest at both ends."""
    from scipy.interpolate import make_interp_spline

    rest = [(1, 0.0), (2, 0.0)]
    spline = make_interp_spline(t, s, k=5, bc_type=(rest, rest))
    edges = np.linspace(0.0, t[-1], intervals + 1)
    s, s1, s2, s3 = (spline(edges, order) for order in range(4))
    for values, last in ((s, s[-1]), (s1, 0.0), (s2, 0.0)):
        values[0], values[-1] = 0.0, last
    return Guide(float(edges[1]), s, s1, s2, s3)


def _times(c: Array, h: float) -> Array:
    """When the edges are passed: the integral of 1/w over each interval, by Gauss and Legendre's rule."""
    b, slope, bend = 0.5 * (c[1:-1] + c[:-2]), np.diff(c)[:-1], 0.5 * (c[2:] - 2 * c[1:-1] + c[:-2])
    x, weight = np.polynomial.legendre.leggauss(5)
    u = 0.5 * (x[:, None] + 1)
    steps = 0.5 * h * weight @ (1 / np.sqrt(b + u * (slope + u * bend)))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _hermite(timed: _Timed) -> Pieces:
    """Pieces of degree five between states, each with its position, velocity and acceleration."""
    t, q, v, a = timed
    h = np.diff(t)[:, None]
    v0, v1, a0, a1 = v[:-1] * h, v[1:] * h, a[:-1] * h * h, a[1:] * h * h
    d = q[1:] - q[:-1]
    c3 = 10 * d - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15 * d + 8 * v0 + 7 * v1 + 1.5 * a0 - a1
    c5 = 6 * d - 3 * (v0 + v1) - 0.5 * (a0 - a1)
    return Pieces(t, np.stack([q[:-1], v[:-1], a[:-1] / 2, c3 / h**3, c4 / h**4, c5 / h**5], axis=1))
