"""TimedTargets: what a source of targets wants in the near future, from what it sent."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from armctl._core import solve_program
from armctl.core.validation import Array, BoolArray

_HISTORY_S = 0.8  # older targets say nothing about the next one
# Numbers of targets in a fit, and the degree of its polynomial. Few follow fast motions, many average noise; the lower the
# degree, the less noise is amplified far ahead. The first one predicts until errors are known: it follows best what begins
# from rest.
_FITS = ((4, 1), (6, 2), (10, 2), (16, 2), (32, 2), (2, 1), (8, 1), (16, 1), (32, 1), (1, 0), (3, 0), (10, 0))
_COUNTS = np.array([count for count, _ in _FITS])
_DEGREES = np.array([degree for _, degree in _FITS])
_MIN_FOR_SLOPE = 2
_MIN_FOR_CURVATURE = 6  # with fewer, the noise of the curvature exceeds what it corrects
_JUDGED_AHEAD = 2  # frames after its making for which a prediction is judged: the arm joins it there
_MAX_PREDICTIONS = 64  # that wait for their judgement
_MEMORY_S = 0.5  # in which the weight of earlier errors falls to 1/e
# Of the least squares of errors: it keeps few errors from deciding between fits that are about as good.
_EQUAL_SHARE = 0.05
_NO_ERROR = 1e-6  # rad^2 (m^2)
_SCATTER_MEMORY = 0.9  # of the earlier scatter, at each target
_MIN_FOR_SCATTER = 4
_MAX_FOR_SCATTER = 6
_JUMP_FACTOR = 6.0  # of the scatter about the fit; a target that is further off begins a new history
_MIN_JUMP = 0.02  # rad (m): smaller steps are followed as a motion
# After how many frames the arm may join the prediction; after one it would copy the noise of the targets.
_JOIN_FRAMES = (2, 3, 4, 6, 8, 12, 16, 24, 32)
_MAX_JOIN_S = 0.5  # an arm that is too slow for this comes to rest at the newest target instead
_FOLLOWED_FRAMES = 2  # after the join; a source that is silent for longer has stopped
_DEFAULT_INTERVAL_S = 1 / 30
_MIN_INTERVAL_S = 0.01
_MAX_INTERVAL_S = 0.2


class Knots(NamedTuple):
    """The wanted states at some times, and where the arm rests afterwards."""

    t: Array  # (K,) s, increasing
    q: Array  # (K, n) rad
    v: Array  # (K, n) rad/s
    a: Array  # (K, n) rad/s^2
    rest: Array  # (n,) rad
    # Which states a motion may follow, the best first: all of a slice, or of one without an end the first ones.
    joins: tuple[slice, ...]

    @classmethod
    def resting(cls, q: Array) -> Knots:
        """No wanted state but rest at q (n,), as soon as possible."""
        none = np.empty((0, len(q)))
        return cls(np.empty(0), none, none, none, q, ())

    def slowed(self, pace: float, now: float) -> Knots:
        """The same states, passed at a share of their speed from the time `now` on."""
        return self._replace(t=now + (self.t - now) / pace, v=pace * self.v, a=pace**2 * self.a)


class Rates(NamedTuple):
    """What a source says about the motion of its targets."""

    v: Array  # (n,) rad/s, or of a chunk (K, n)
    a: Array | None  # rad/s^2, of the same shape


class _Chunk(NamedTuple):
    """Targets for some times; NaN stands for rates that the source did not give."""

    t: Array  # (K,) s, increasing
    q: Array  # (K, n) rad
    v: Array  # (K, n) rad/s
    a: Array  # (K, n) rad/s^2

    @classmethod
    def from_rates(cls, t: Array, q: Array, rates: Rates | None) -> _Chunk:
        """Without accelerations, those of the velocities' own parabolas."""
        unknown = np.full_like(q, np.nan)
        if rates is None:
            return cls(t, q, unknown, unknown)
        return cls(t, q, rates.v, _parabolas(t, rates.v)[0] if rates.a is None else rates.a)

    def rows(self, which: slice | BoolArray) -> _Chunk:
        return _Chunk(self.t[which], self.q[which], self.v[which], self.a[which])

    def then(self, other: _Chunk) -> _Chunk:
        return _Chunk(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class TimedTargets:
    """The history of single targets, which is extrapolated, or the targets of a chunk, which are interpolated."""

    def __init__(self, q: Array, v_max: Array, a_max: Array):
        """No targets: an arm with these limits, each (n,), rests at q (n,)."""
        self._v_max = v_max
        self._a_max = a_max
        self.rest = q  # (n,) rad, the newest target, where the arm rests if nothing more arrives
        self._history: deque[tuple[float, Array]] = deque(maxlen=int(_COUNTS.max()))
        # The time for which each prediction is judged, that of its newest target, and the coefficients of its fits.
        self._predictions: deque[tuple[float, float, Array]] = deque(maxlen=_MAX_PREDICTIONS)
        self._errors = np.zeros((len(_FITS), len(_FITS)))  # products of the errors of each two fits
        self._weights = np.eye(len(_FITS))[0]
        self._scatter = np.zeros(len(q))  # of the targets about the prediction
        self._chunk: _Chunk | None = None
        self._moving: tuple[float, Array, Array, Array] | None = None  # the newest target, if its source gave its rates

    @property
    def newest(self) -> float:
        """The time of the newest single target, s."""
        return self._history[-1][0] if self._history else -np.inf

    def push(self, t: float, q: Array, now: float, rates: Rates | None = None) -> None:
        """Adds a target (n,) for a time that is later than `newest`, as it arrives at the time `now`. It ends a chunk.

        Rates that the source gives are its prediction.
        """
        self._chunk = None
        history = self._history
        while history and t - history[0][0] > _HISTORY_S:
            history.popleft()
        if not history or self._is_jump(t, q):
            history.clear()
            self._predictions.clear()
        self._judge(t, q)
        history.append((t, q))
        if len(history) >= _MIN_FOR_SLOPE:
            ahead = max(now, t) + (_JUDGED_AHEAD - 0.5) * self.interval
            self._predictions.append((ahead, t, _fits(*self._last())))
            self._weights = _weights(self._errors)
        self._moving = None if rates is None else (t, q, rates.v, np.zeros_like(q) if rates.a is None else rates.a)
        self.rest = q

    def push_chunk(self, t: Array, q: Array, rates: Rates | None = None) -> None:
        """Replaces all targets from t[0] on by those of q (K, n) at the times t (K,)."""
        chunk = _Chunk.from_rates(t, q, rates)
        if self._chunk is not None:
            earlier = self._chunk.t < t[0] - 0.5 * _step(t)  # a target just before the first one would make noise a velocity
            chunk = self._chunk.rows(earlier).then(chunk)
        self._chunk = chunk
        self._forget()
        self.rest = q[-1]

    def rest_at(self, q: Array) -> None:
        """Forgets all targets: the arm comes to rest, near q (n,)."""
        self._forget()
        self._chunk = None
        self.rest = q

    def knots(self, now: float) -> Knots:
        """The wanted states after a time, s."""
        if self._chunk is not None:
            return self._interpolated(now)
        step = self.interval
        frames = [k for k in _JOIN_FRAMES if k == _JOIN_FRAMES[0] or k * step <= _MAX_JOIN_S]
        times: Array = now + step * np.arange(1.0, frames[-1] + _FOLLOWED_FRAMES + 1.0)
        joins = tuple(slice(k - 1, k + _FOLLOWED_FRAMES) for k in frames)
        return Knots(times, *self._predicted(times), self.rest, joins)

    @property
    def interval(self) -> float:
        """s between two single targets."""
        if len(self._history) < _MIN_FOR_SLOPE:
            return _DEFAULT_INTERVAL_S
        times = [t for t, _ in self._history]
        return min(max(float(np.median(np.diff(times))), _MIN_INTERVAL_S), _MAX_INTERVAL_S)

    def _predicted(self, times: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at times (K,), by a polynomial of least squares through the history."""
        if self._moving is not None:
            t, q, v, a = self._moving
            u = (times - t)[:, None]
            return q + u * (v + 0.5 * u * a), v + u * a, np.broadcast_to(a, (len(times), len(a)))
        if len(self._history) < _MIN_FOR_SLOPE:
            at_rest = np.zeros((len(times), len(self.rest)))
            return self.rest + at_rest, at_rest, at_rest
        _, newest, fits = self._predictions[-1]
        c = np.tensordot(self._weights, fits, 1)
        u = (times - newest)[:, None]
        return c[0] + u * (c[1] + u * c[2]), c[1] + 2 * u * c[2], np.broadcast_to(2 * c[2], (len(times), c.shape[1]))

    def _judge(self, t: float, q: Array) -> None:
        """Compares a target with what each fit predicted for its time when the arm had to follow that prediction."""
        due = []
        while self._predictions and self._predictions[0][0] <= t:
            due.append(self._predictions.popleft())
        if len(self._history) < _MIN_FOR_CURVATURE:
            return
        for _, newest, fits in due[-1:]:
            u = t - newest
            errors = q - (fits[:, 0] + u * (fits[:, 1] + u * fits[:, 2]))
            self._errors = np.exp(-self.interval / _MEMORY_S) * self._errors + errors @ errors.T

    def _forget(self) -> None:
        """Begins a new history. What was learned about the fits is learned anew."""
        self._history.clear()
        self._predictions.clear()
        self._moving = None
        self._errors[:] = 0.0
        self._scatter[:] = 0.0

    def _last(self) -> tuple[Array, Array]:
        """Times (K,) and targets (K, n) of the history."""
        return np.array([t for t, _ in self._history]), np.array([q for _, q in self._history])

    def _is_jump(self, t: float, q: Array) -> bool:
        """Whether a target does not continue the motion of the history."""
        newest, last = self._history[-1]
        if len(self._history) < _MIN_FOR_SCATTER:
            fastest = self._v_max * max(t - newest, _DEFAULT_INTERVAL_S)
            return bool((np.abs(q - last) > np.maximum(fastest, _JUMP_FACTOR * self._scatter)).any())
        times, targets = self._last()
        fitted = self._predicted(np.append(times, t))[0]
        off = (fitted[:-1] - targets)[-_MAX_FOR_SCATTER:]
        scatter = np.sqrt((off**2).sum(axis=0) / (len(off) - _MIN_FOR_SLOPE))
        self._scatter = np.maximum(scatter, _SCATTER_MEMORY * self._scatter)
        possible = 0.5 * self._a_max * (t - newest) ** 2
        return bool((np.abs(q - fitted[-1]) > np.maximum(_JUMP_FACTOR * self._scatter, _MIN_JUMP) + possible).any())

    def _interpolated(self, now: float) -> Knots:
        """The targets of the chunk still to come, with given rates, or those of the parabola through each and its neighbors."""
        assert self._chunk is not None
        t, q, given_v, given_a = self._chunk
        v, a = _parabolas(t, q)
        v[-1] = 0.0  # the source may send nothing more
        a[-1] = 0.0
        v = np.where(np.isnan(given_v), v, given_v)
        a = np.where(np.isnan(given_a), a, given_a)
        ahead = t > now + 0.5 * _step(t)  # a target that is nearer could only be met by a jerk
        first = max(int(ahead.argmax()) - 1, 0) if ahead.any() else len(t)
        self._chunk = self._chunk.rows(slice(first, None))
        count = int(ahead.sum())
        joins = tuple(slice(k, None) for k in (0, 1, 2, 4, 8) if k < count)
        return Knots(t[ahead], q[ahead], v[ahead], a[ahead], self.rest, joins)


def _fits(t: Array, q: Array) -> Array:
    """Least-squares polynomials through the last of some targets q (K, n) at the times t (K,).

    Returns:
        (F, 3, n) coefficients of each of _FITS, of powers of the time since the last target.
    """
    counts = np.minimum(_COUNTS, len(t))
    degrees = np.minimum(_DEGREES, 1) if len(t) < _MIN_FOR_CURVATURE else _DEGREES
    u = (t - t[-1])[::-1]
    orders = np.arange(5)
    powers = u ** orders[:, None]
    # Powers of the time that a fit spans: they make the equations free of units.
    span = np.where(counts > 1, -u[counts - 1], 1.0)[:, None] ** orders
    sums = np.cumsum(powers, axis=1)[:, counts - 1].T / span  # (F, 5)
    right = np.cumsum(powers[:3, :, None] * q[::-1], axis=1)[:, counts - 1].swapaxes(0, 1) / span[:, :3, None]
    used = np.arange(3) <= degrees[:, None]
    left = np.where(used[:, :, None] & used[:, None, :], sums[:, np.add.outer(np.arange(3), np.arange(3))], np.eye(3))
    return np.linalg.solve(left, np.where(used[:, :, None], right, 0.0)) / span[:, :3, None]


def _weights(products: Array) -> Array:
    """The mean of predictions with the least squares of errors, whose products (F, F) are given: (F,), at least 0, with sum 1.

    After Bates and Granger, "The combination of forecasts" (1969). Errors that differ cancel each other, as those of holding,
    which lags, and of a slope, which is noisy; of errors that are alike the smaller ones decide.
    """
    count = len(products)
    equal = np.full(count, _NO_ERROR)
    equal[0] = 0.1 * _NO_ERROR  # at rest all are as good
    cost = products + np.diag(equal + _EQUAL_SHARE * products.diagonal().min())
    weights = np.zeros(count)
    zero_to_one = np.append(np.zeros(count), 1.0), np.ones(count + 1)
    found = solve_program(cost, np.zeros(count), np.ones((1, count)), *zero_to_one, weights)
    return weights if found else np.eye(count)[int(products.diagonal().argmin())]


def _step(t: Array) -> float:
    """s between two targets of a chunk, at most the longest interval that counts as a motion."""
    return min(float(np.median(np.diff(t))) if len(t) > 1 else _DEFAULT_INTERVAL_S, _MAX_INTERVAL_S)


def _parabolas(t: Array, q: Array) -> tuple[Array, Array]:
    """Velocities, accelerations (K, n) at targets: of the parabola through each and its neighbors, at the ends of the line."""
    v = np.zeros_like(q)
    a = np.zeros_like(q)
    if len(t) < 2:
        return v, a
    h = np.diff(t)[:, None]
    slope = np.diff(q, axis=0) / h
    v[0] = slope[0]
    v[-1] = slope[-1]
    before, after = h[:-1], h[1:]
    v[1:-1] = (after * slope[:-1] + before * slope[1:]) / (before + after)
    a[1:-1] = 2 * (slope[1:] - slope[:-1]) / (before + after)
    return v, a
