"""Time-optimal path parameterization with limits on velocity, acceleration, jerk and torque, and with caps on the path speed.

An initial timing runs along the path from rest to rest. The compiled solver finds the best speed for it on a coarse grid; the
result is the timing on a finer grid. Bounds that are still exceeded between the edges of the grid are tightened there.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from armctl import _core
from armctl.core.errors import PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array, IntArray
from armctl.plan.motion.timing.end_limits import refuse_end
from armctl.plan.motion.timing.initial_timing import Path, Timing, initial_timing, smooth_timing, where_reached
from armctl.plan.motion.timing.speed_bounds import TorqueRows, points_of, speed_bounds
from armctl.plan.motion.trajectory.limit_check import limit_excess
from armctl.plan.motion.trajectory.piecewise import DEGREE, Pieces, basis_many, hermite
from armctl.plan.motion.trajectory.velocity_bounds import velocity_peaks

_INTERVAL_S = 0.004
_MIN_INTERVALS = 60
_MAX_INTERVALS = 500
_MAX_TIGHTENINGS = 3
_MAX_TIGHTENINGS_OF_LARGE_EXCESS = 10
_LARGE_STRETCH = 1.01  # in time, which more tightenings avoid
# Exponents of the overshoot of velocity, acceleration, jerk and torque that give the stretch in time which removes it.
_STRETCH_EXPONENTS = np.array([1, 1 / 2, 1 / 3, 1 / 2])
_STRETCH_TOLERANCE = 1e-3  # relative: a stretch in time so small removes what bounds are still exceeded by
_MIN_NODE_DISTANCE_S = 1e-8  # of two nodes; a motion does not change in between
_SHORT_PIECE_S = 1e-4  # rounding of the positions at its ends decides the jerk of a shorter quintic
_SAME_LENGTH = 1e-9  # of a path, where one fraction ends and the next begins
_END_ROUNDING = 1e-12  # of a path
_MAX_SQUARED_SPEED = 1e12  # of the path speed, where nothing bounds it
_LEAST_SQUARED_SPEED = 1e-12  # of the path speed at a node: rounding of the spline may leave none
_MIN_DIP = 1e-2  # of the smaller squared speed at the ends of an interval
# Torques vary between grid nodes. Above this share of a limit they are also checked between the nodes.
_TORQUE_SHARE_CHECKED_BETWEEN_NODES = 0.8
_QUADRATURE = np.polynomial.legendre.leggauss(5)  # points in [-1, 1] and weights of Gauss and Legendre's rule
_MAX_END_SPEED_CHANGE = 0.02  # relative, of the squared path speed in the first and in the last interval


class Torques(Protocol):
    """What bounds the torques of a motion."""

    def rows(self, s: Array, q: Array, v: Array, a: Array) -> TorqueRows:
        """The bounds at states (T, n) and lengths (T,) of a motion that is to run at another speed."""
        ...

    def overshoot(self, s: Array, q: Array, v: Array, a: Array) -> Array:
        """The share of what the bounds leave beside holding still that states (T, n) use, (T,)."""
        ...


class Caps(Protocol):
    """What bounds the speed along a path beside the joints."""

    def at(self, s: Array) -> Array:
        """The greatest speeds along the path at lengths (T,), infinite without a bound."""
        ...

    def acceleration_at(self, s: Array) -> Array:
        """The fractions of the joints' acceleration limits at lengths (T,)."""
        ...

    def overshoot(self, pieces: Pieces) -> Array:
        """The share of its bounds that a motion uses in each piece, (m,); any number of at most 1 where it keeps them.

        The last column of the motion is its length.
        """
        ...


class Fractions:
    """Fractions of a motion's own speed and of the acceleration limits, from one length to the next."""

    def __init__(self, ends: Array, speed: Array, acceleration: Array):
        """Up to each of the lengths `ends` (k,) hold one of the fractions, (k,) each."""
        self._ends = ends
        self._speed = speed
        self._acceleration = acceleration

    def at(self, s: Array) -> Array:
        """Of the speed, (T,) at lengths (T,)."""
        return self._at(self._speed, s)

    def acceleration_at(self, s: Array) -> Array:
        """Of the acceleration limits, (T,) at lengths (T,)."""
        return self._at(self._acceleration, s)

    def _at(self, fractions: Array, s: Array) -> Array:
        """Where one ends and the next begins, the smaller of both."""
        last = len(self._ends) - 1
        before = np.clip(np.searchsorted(self._ends, s - _SAME_LENGTH), 0, last)
        after = np.clip(np.searchsorted(self._ends, s + _SAME_LENGTH), 0, last)
        return np.minimum(fractions[before], fractions[after])

    def overshoot(self, pieces: Pieces) -> Array:
        """The share of the fraction that each piece uses, (m,): exact where it is more than 1."""
        length = pieces.coefficients[:, :, -1:]
        bound = self.at(middle_lengths(pieces))[:, None]
        return (1 + limit_excess(length, np.diff(pieces.knots), 1, -bound, bound) / bound)[:, 0]


def middle_lengths(pieces: Pieces) -> Array:
    """(m,) the lengths, the last column of a motion, in the middle of its pieces: inside of what begins and ends at nodes."""
    return np.einsum("tc,tc->t", basis_many(0.5 * np.diff(pieces.knots))[0], pieces.coefficients[:, :, -1])


def times_at(pieces: Pieces, lengths: Array) -> Array:
    """(k,) s, when the last column of a motion, its length, which increases from 0, reaches lengths up to the whole one."""
    starts = pieces.coefficients[:, 0, -1]
    piece = np.clip(np.searchsorted(starts, lengths, side="right") - 1, 0, len(starts) - 1)
    rows = pieces.coefficients[piece, :, -1]
    steps = np.diff(pieces.knots)[piece]
    inside = where_reached(lambda u: (basis_many(u)[0] * rows).sum(axis=1), lengths, np.zeros_like(steps), steps)
    # At both ends the motion rests, and the length hardly depends on the time.
    times = np.where(lengths > 0.0, pieces.knots[piece] + inside, 0.0)
    return np.where(lengths < (1 - _END_ROUNDING) * _length_of(pieces), times, pieces.knots[-1])


def _length_of(pieces: Pieces) -> float:
    """The last column of a motion at its end."""
    return float(basis_many(np.diff(pieces.knots[-2:]))[0, 0] @ pieces.coefficients[-1, :, -1])


def time_optimal(path: Path, limits: Limits, caps: Caps | None = None, knots: Array | None = None, fineness: int = 1) -> Pieces:
    """The time-optimal motion along a path, from rest to rest; its last column is the length. Positions are not limited.

    At `knots` (k,), lengths, its third derivative may jump, and the motion is exactly on the path. `fineness` times as many
    intervals cost as much more time, and gain up to 4 % where an acceleration may jump within 4 ms.
    """
    inner = np.empty(0) if knots is None else knots[1:-1]
    problem = _TimingProblem(path, limits, caps)
    timing = initial_timing(path, limits)
    timed = problem.timed(problem.sampled(_Places.from_timing(timing, _merged(timing.edges, timing.times_at(inner)))))
    refined = _refined(timed, intervals_for(timed.t[-1], fineness))
    return _tightened(problem, refined, refined.times_at(inner))


def slowed_down(
    path: Path, limits: Limits, knots: Array, torques: Torques | None, fractions: Fractions | None = None
) -> Pieces:
    """A motion, at rest at both ends, slower where the torques or fractions of its speed require it and never faster.

    The length of its path is the time; at `knots` (m + 1,) s its jerk or a bound may jump. The last column of the result is the
    time in the faster motion.
    """
    caps = Fractions(np.array([path.length]), np.ones(1), np.ones(1)) if fractions is None else fractions
    intervals = intervals_for(path.length)
    return _tightened(_TimingProblem(path, limits, caps, torques), Timing(path.length / intervals, intervals, None), knots)


def intervals_for(duration: float, fineness: int = 1) -> int:
    """How many intervals a motion of a duration in s is cut into, times a fineness."""
    return fineness * max(_MIN_INTERVALS, min(_MAX_INTERVALS, math.ceil(duration / _INTERVAL_S)))


def _tightened(problem: _TimingProblem, timing: Timing, knots: Array) -> Pieces:
    """The best path speed for a timing, cut at knots too, its bounds tightened where it exceeds them between the nodes."""
    sampled = problem.sampled(_Places.from_timing(timing, _merged(timing.edges, knots)))
    slack = np.ones((4, len(sampled.places.nodes)))
    tried: list[tuple[Pieces, float]] = []
    for tightening in range(1 + _MAX_TIGHTENINGS_OF_LARGE_EXCESS):
        pieces = problem.timed(sampled, slack if tightening else None).pieces()
        overshoot = problem.overshoot(pieces)
        stretch = float((np.maximum(overshoot.max(axis=1), 1.0) ** _STRETCH_EXPONENTS).max())
        tried.append((pieces, stretch))
        if stretch <= (1 + _STRETCH_TOLERANCE if tightening < _MAX_TIGHTENINGS else _LARGE_STRETCH):
            break
        excess = np.maximum(overshoot, 1.0)
        slack[:, :-1] /= excess
        slack[:, 1:] /= excess
    pieces, stretch = min(tried, key=lambda one: one[1] * one[0].knots[-1])
    powers = stretch ** -np.arange(DEGREE + 1.0)
    return Pieces(pieces.knots * stretch, pieces.coefficients * powers[:, None])


class _Places(NamedTuple):
    """The nodes that cut a motion into pieces, and where the pieces lie in the intervals of a timing."""

    timing: Timing
    nodes: Array  # (N,) s
    interval: IntArray  # (N - 1,) of each piece
    begin: Array  # (N - 1,) the share of the interval at which it begins
    end: Array  # (N - 1,) and at which it ends

    @classmethod
    def from_timing(cls, timing: Timing, nodes: Array) -> _Places:
        """The places of nodes that include the timing's edges."""
        edges = timing.edges
        interval = np.clip(np.searchsorted(edges, 0.5 * (nodes[1:] + nodes[:-1])) - 1, 0, timing.intervals - 1)
        begin = np.clip((nodes[:-1] - edges[interval]) / timing.h, 0.0, 1.0)
        end = np.clip((nodes[1:] - edges[interval]) / timing.h, 0.0, 1.0)
        return cls(timing, nodes, interval, begin, end)


class _Sampled(NamedTuple):
    """A motion of the joints and, as the last column, of the length, at nodes, and the bounds on its speed there."""

    places: _Places  # the nodes
    q: Array  # (N, n + 1)
    q1: Array  # (N, n + 1) first derivative
    q2: Array  # (N, n + 1) second
    q3_after: Array  # (N - 1, n + 1) third, just after the start of each piece
    q3_before: Array  # (N - 1, n + 1) third, just before the end of each piece
    b_max: Array  # (N,) greatest square of the path speed
    torques: TorqueRows | None  # bounds on the torques, if there are any


class _Timed(NamedTuple):
    """A motion at nodes, of the joints and behind them the length."""

    t: Array  # (N,) s
    q: Array  # (N, n + 1)
    v: Array  # (N, n + 1)
    a: Array  # (N, n + 1)
    j_after: Array  # (N - 1, n + 1) jerk at the start of each piece
    j_before: Array  # (N - 1, n + 1) jerk at the end of each piece

    def pieces(self) -> Pieces:
        """The motion between the nodes: quintic from the states at both ends; short pieces from the jerk at both ends.

        The positions at the ends of a short piece do not determine its jerk, because of rounding.
        """
        h = np.diff(self.t)
        q = self.q.copy()
        v = self.v.copy()
        a = self.a.copy()
        short = np.flatnonzero(h < _SHORT_PIECE_S)
        for k in short:
            x = h[k]
            j = self.j_after[k]
            change = self.j_before[k] - j
            q[k + 1] = q[k] + x * (v[k] + x * (a[k] / 2 + x * (j / 6 + change / 24)))
            v[k + 1] = v[k] + x * (a[k] + x * (j / 2 + change / 6))
            a[k + 1] = a[k] + x * (j + change / 2)
        pieces = hermite(self.t, q, v, a)
        pieces.coefficients[short, 3] = self.j_after[short] / 6
        pieces.coefficients[short, 4] = (self.j_before[short] - self.j_after[short]) / (24 * h[short, None])
        pieces.coefficients[short, 5] = 0.0
        return pieces


class _TimingProblem:
    """A path and all bounds on its speed."""

    def __init__(self, path: Path, limits: Limits, caps: Caps | None, torques: Torques | None = None):
        self.path = path
        self.limits = limits
        self._caps = caps
        self.torques = torques
        self._last: Array | None = None  # the last solution, to tighten from

    def sampled(self, places: _Places) -> _Sampled:
        nodes = places.nodes
        q, q1, q2, _ = self._with_length(places.timing, nodes)
        # The third derivative jumps at knots, also at those that come too soon after another one to be nodes.
        inside = np.minimum(2.0 * _MIN_NODE_DISTANCE_S, 0.5 * np.diff(nodes))
        q3_after = self._with_length(places.timing, nodes[:-1] + inside)[3]
        q3_before = self._with_length(places.timing, nodes[1:] - inside)[3]
        with np.errstate(divide="ignore"):
            b_max = (self._fastest(q[:, :-1], q1[:, :-1]) / np.abs(q1[:, :-1])).min(axis=1) ** 2
            if self._caps is not None:
                b_max = np.minimum(b_max, (self._caps.at(q[:, -1]) / np.abs(q1[:, -1])) ** 2)
        torques = None if self.torques is None else self.torques.rows(q[:, -1], q[:, :-1], q1[:, :-1], q2[:, :-1])
        return _Sampled(places, q, q1, q2, q3_after, q3_before, b_max, torques)

    def _fastest(self, q: Array, q1: Array) -> Array:
        """The greatest speeds of the joints at positions, (N, n), in the direction of the path. Raises LimitError."""
        limits = self.limits
        if not limits.depends_on_sign and not limits.depends_on_position:
            return np.broadcast_to(limits.v_max, q.shape)
        low, high = limits.velocity_bounds(q)
        fastest = np.where(q1 < 0.0, -low, high)
        if ((fastest == 0.0) & (q1 != 0.0)).any():
            k, i = np.argwhere((fastest == 0.0) & (q1 != 0.0))[0].tolist()
            refuse_end(limits, i, float(limits.q_max[i] if q1[k, i] > 0.0 else limits.q_min[i]))
        return fastest

    def timed(self, sampled: _Sampled, slack: Array | None = None) -> _Timed:
        """The best path speed for a timing; `slack` (4, N) are factors on its bounds."""
        places, q, q1, q2, q3_after, q3_before, _, _ = sampled
        timing, _, interval, begin, end = places
        h = timing.h
        bounds = self._bounds(sampled, np.ones((4, len(q))) if slack is None else slack)
        near = None if slack is None else self._last
        c = np.empty(timing.intervals + 2) if near is None else near.copy()
        if not _core.fastest_path_speed(c, h, near is not None, **bounds):
            raise PlanError("limits: they differ too much in size to compute a speed along the path")
        self._last = c
        b, slope = _squared_speed(c, h, np.append(interval, interval[-1]), np.append(begin, end[-1]))
        t = np.concatenate([[0.0], np.cumsum(_durations(c, h, places))])
        bend = (c[interval + 2] - 2 * c[interval + 1] + c[interval])[:, None] / h**2
        b = b[:, None]
        slope = slope[:, None]
        w = np.sqrt(b)
        j_after = w[:-1] * (q3_after * b[:-1] + 1.5 * q2[:-1] * slope[:-1] + 0.5 * q1[:-1] * bend)
        j_before = w[1:] * (q3_before * b[1:] + 1.5 * q2[1:] * slope[1:] + 0.5 * q1[1:] * bend)
        return _Timed(t, q, q1 * w, q2 * b + q1 * slope / 2, j_after, j_before)

    def _with_length(self, timing: Timing, u: Array) -> list[Array]:
        s, s1, s2, s3 = timing.at(u)
        d0, d1, d2, d3 = self.path.derivatives(s)
        s1 = s1[:, None]
        s2 = s2[:, None]
        s3 = s3[:, None]
        joints = (d0, d1 * s1, d2 * s1**2 + d1 * s2, d3 * s1**3 + 3 * d2 * s1 * s2 + d1 * s3)
        return [np.hstack(pair) for pair in zip(joints, (s[:, None], s1, s2, s3), strict=True)]

    def overshoot(self, pieces: Pieces) -> Array:
        """How much of their limits speed, acceleration, jerk and torque use in each piece, (4, m): 1 is all.

        Exact where it is more than all; any number of at most 1 elsewhere.
        """
        limits = self.limits
        steps = np.diff(pieces.knots)
        joints = np.ascontiguousarray(pieces.coefficients[:, :, :-1])
        shares = []
        sides = ((limits.v_low, limits.v_max), (limits.a_low, limits.a_max), (-limits.j_max, limits.j_max))
        for order, (low, high) in enumerate(sides, start=1):
            lows = np.tile(low, (len(steps), 1))
            highs = np.tile(high, (len(steps), 1))
            if order == 2 and self._caps is not None:
                fractions = self._caps.acceleration_at(middle_lengths(pieces))[:, None]
                lows *= fractions
                highs *= fractions
            shares.append((1 + limit_excess(joints, steps, order, lows, highs) / np.minimum(highs, -lows)).max(axis=1))
        if limits.depends_on_position:
            peaks = velocity_peaks(joints, steps, limits)
            with np.errstate(divide="ignore"):
                np.maximum.at(shares[0], peaks.piece, np.abs(peaks.value) / np.abs(peaks.bound))
        if self._caps is not None:
            shares[0] = np.maximum(shares[0], self._caps.overshoot(pieces))
        return np.array([*shares, self._torque_overshoot(pieces)])

    def _torque_overshoot(self, pieces: Pieces) -> Array:
        """How much of their limits torques use at the start of each piece and, where that is much, in its middle, (m,)."""
        steps = np.diff(pieces.knots)
        if self.torques is None:
            return np.zeros_like(steps)
        start = pieces.coefficients
        shares = self.torques.overshoot(start[:, 0, -1], start[:, 0, :-1], start[:, 1, :-1], 2 * start[:, 2, :-1])
        checked = (shares > _TORQUE_SHARE_CHECKED_BETWEEN_NODES) | (
            np.append(shares[1:], 0.0) > _TORQUE_SHARE_CHECKED_BETWEEN_NODES
        )
        q, v, a = np.einsum("otc,tcn->otn", basis_many(0.5 * steps[checked]), pieces.coefficients[checked])
        shares[checked] = np.maximum(shares[checked], self.torques.overshoot(q[:, -1], q[:, :-1], v[:, :-1], a[:, :-1]))
        return shares

    def _bounds(self, sampled: _Sampled, slack: Array) -> dict[str, Array | IntArray]:
        """The bounds on the path speed that can become active, as the compiled solver takes them."""
        places = sampled.places
        q1 = np.ascontiguousarray(sampled.q1[:, :-1])
        q2 = np.ascontiguousarray(sampled.q2[:, :-1])
        q3_after = np.ascontiguousarray(sampled.q3_after[:, :-1])
        q3_before = np.ascontiguousarray(sampled.q3_before[:, :-1])
        j_max = self.limits.j_max * slack[2][:, None]
        b_max = sampled.b_max * slack[0] ** 2
        ends = [0, -1]
        with np.errstate(divide="ignore"):
            q3_ends = np.stack([q3_after[0], q3_before[-1]])
            b_max[ends] = np.minimum(b_max[ends], ((j_max[ends] / np.abs(q3_ends)) ** (2 / 3)).min(axis=1))
        b_max = np.minimum(b_max, _MAX_SQUARED_SPEED)
        a_max = self.limits.a_max * slack[1][:, None]
        a_low = self.limits.a_low * slack[1][:, None]
        if self._caps is not None:
            fractions = self._caps.acceleration_at(sampled.q[:, -1])[:, None]
            a_max = a_max * fractions
            a_low = a_low * fractions
        rows = TorqueRows(q1.copy(), q2.copy(), np.zeros_like(q1), a_low, a_max)
        if sampled.torques is not None:
            share = slack[3][:, None]
            torques = sampled.torques._replace(low=sampled.torques.low * share, high=sampled.torques.high * share)
            rows = TorqueRows(*(np.concatenate(pair, axis=1) for pair in zip(rows, torques, strict=True)))
        # At rest there is neither velocity nor acceleration to bound: instead the path speed is nearly constant there.
        rows.alpha[ends] = 0.0
        rows.alpha[ends, 0] = 2.0
        rows.beta[ends] = 0.0
        rows.delta[ends] = 0.0
        rows.high[ends] = _MAX_END_SPEED_CHANGE * b_max[ends, None] / places.timing.h
        rows.low[ends] = -rows.high[ends]
        derivatives = (q1, q2, np.stack([q3_after, q3_before], axis=1).reshape(-1, q1.shape[1]))
        return speed_bounds(
            points_of(places.timing.h, places.interval, places.begin, places.end), rows, derivatives, b_max, j_max
        )


def _refined(timed: _Timed, intervals: int) -> Timing:
    """The timing that a timed motion makes, smoothed a little."""
    knots, coefficients = timed.pieces()
    t = np.linspace(0.0, knots[-1], intervals // 2 + 1)
    k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    s = (coefficients[k, :, -1] * (t - knots[k])[:, None] ** np.arange(DEGREE + 1)).sum(axis=1)
    return smooth_timing(t, s, intervals)


def _merged(edges: Array, knots: Array) -> Array:
    """Edges and knots in order, without knots that come too soon after another one, and inner edges too near to a knot."""
    inner = knots[(knots > _MIN_NODE_DISTANCE_S) & (knots < edges[-1] - _MIN_NODE_DISTANCE_S)]
    kept = inner[np.diff(inner, prepend=-np.inf) > _MIN_NODE_DISTANCE_S]
    if not len(kept):
        return edges
    k = np.searchsorted(kept, edges)
    before = edges - kept[np.maximum(k - 1, 0)]
    behind = kept[np.minimum(k, len(kept) - 1)] - edges
    apart = np.minimum(np.abs(before), np.abs(behind)) > _MIN_NODE_DISTANCE_S
    return np.sort(np.concatenate([edges[apart], kept]))


def _squared_speed(c: Array, h: float, m: IntArray, x: Array) -> tuple[Array, Array]:
    """The quadratic B-spline with coefficients c, where rounding may end at 0, and its slope, at shares x of intervals m."""
    left = 0.5 * (c[m] + c[m + 1])
    slope = c[m + 1] - c[m]
    bend = c[m + 2] - 2 * c[m + 1] + c[m]
    return np.maximum(left + x * (slope + 0.5 * x * bend), _LEAST_SQUARED_SPEED), (slope + x * bend) / h


def _durations(c: Array, h: float, places: _Places) -> Array:
    """The times from node to node: the integral of 1/w, by Gauss and Legendre's rule."""
    x, weight = _QUADRATURE
    m = places.interval
    share = places.end - places.begin
    b, _ = _squared_speed(c, h, m[:, None], places.begin[:, None] + 0.5 * share[:, None] * (x + 1))
    ends = [_squared_speed(c, h, m, at)[0] for at in (places.begin, places.end)]
    # The solver keeps b positive at nodes and middles only. Between them it can dip below 0 where limits are extreme.
    b = np.maximum(b, _MIN_DIP * np.minimum(*ends)[:, None])
    return 0.5 * h * share * ((1 / np.sqrt(b)) @ weight)
