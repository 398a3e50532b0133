"""A stop on the path, or another speed along it: the path in joint space stays, and the limits are kept.

For the motion q(u) and the path speed w = du/dt, w goes from 1 to 0, or to a factor. Its slope is a trapezoid, so that the
jerk is bounded. Later and longer changes are tried until one keeps the limits; if no stop is sooner, the motion's own end is
the stop.
"""

from typing import NamedTuple

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array, BoolArray
from armctl.plan.motion.trajectory.limit_check import REST_SPEED, is_inside, stretch_needed
from armctl.plan.motion.trajectory.piecewise import (
    JointSamples,
    Pieces,
    hermite,
    joined,
    knots_of,
    locate,
    sample,
    shifted,
    time_scaled,
)

_DELAYS = 12  # start times of the deceleration that are tried
_MIN_DECELERATION_S = 0.01
_DECELERATION_GROWTH = 1.15  # from one duration to the next
_MAX_GROWTHS = 200  # the last of them would take 10^10 s
_MIN_CHANGE = 1e-6  # of the speed
_CHANGE_SHARES = (1.0, 0.75, 0.5, 0.25)  # of a change of the speed that are tried
_RAMP = 0.2  # share of the deceleration in which its slope grows, and again in which it falls
_CUTS = 20  # pieces of a deceleration, at least
_MIN_PIECE_S = 2e-5  # rounding decides the jerk of a shorter piece
_JERK_MARGIN = 1.05  # a sample next to a knot is left out later, which moves a difference by less than this
_SHORTEST_CUT_S = 1e-9  # an earlier piece that is cut to less than this is left out


class _Deceleration(NamedTuple):
    """For shares of a deceleration: the integral of the path speed, the path speed, and its slope, each (T,)."""

    shares: Array
    progress: Array
    speed: Array
    slope: Array


def stopped(pieces: Pieces, limits: Limits, t: float) -> Pieces:
    """A motion that follows `pieces` until the time t and then stops on the same path, as soon as a stop is found.

    Raises PlanError if none was found and the motion does not end at rest.
    """
    left = float(pieces.knots[-1]) - t
    stop = _soonest_change(pieces, limits, t, 0.0)
    ends_at_rest = np.abs(sample(pieces, pieces.knots[-1:]).v).max() < REST_SPEED
    if stop is None and not ends_at_rest:
        raise PlanError(f"stopped_at: no stop on the path keeps the limits from {t:.4g} s on; stop sooner")
    if stop is None or (ends_at_rest and stop.begin - t + stop.pieces.knots[-1] >= left):
        return pieces
    return _until(pieces, stop.begin, stop.pieces)


def speed_changed(pieces: Pieces, limits: Limits, t: float, factor: float) -> Pieces:
    """A motion that follows `pieces` until the time t and then changes towards `factor` times its speed, as soon as possible.

    Where the rest of the motion cannot be so fast, or the change is not found, it changes less; at worst not at all.
    """
    symmetric = limits.symmetric
    bounds = (symmetric.v_max, symmetric.a_max, symmetric.j_max)
    if factor > 1.0:
        factor = max(1.0, factor / stretch_needed(time_scaled(remaining(pieces, t), factor), bounds))
    if abs(factor - 1.0) < _MIN_CHANGE:
        return pieces
    for share in _CHANGE_SHARES:
        target = 1.0 + share * (factor - 1.0)
        change = _soonest_change(pieces, limits, t, target)
        if change is not None:
            rest = time_scaled(remaining(pieces, change.end), target)
            return _until(pieces, change.begin, joined([change.pieces, rest]))
    return pieces


def resting_at_end(pieces: Pieces, limits: Limits) -> Pieces | None:
    """The motion with a stop at its end on the same path, from as late on as one is found; None if none keeps the limits."""
    duration = float(pieces.knots[-1])
    lengths = _MIN_DECELERATION_S * _DECELERATION_GROWTH ** np.arange(_MAX_GROWTHS, dtype=np.float64)
    for length in lengths[lengths < 2.0 * duration]:
        begin = duration - 0.5 * float(length)  # a deceleration to rest covers half of its length
        change = _decelerated(pieces, limits, begin, float(length), 0.0)
        if change is not None and is_inside(change, limits):
            return _until(pieces, begin, change)
    return None


class _Change(NamedTuple):
    """A change of the path speed: when it begins and ends in the motion, s, and the motion meanwhile."""

    begin: float
    end: float
    pieces: Pieces


def _soonest_change(pieces: Pieces, limits: Limits, t: float, factor: float) -> _Change | None:
    """The change to `factor` times the speed that is over first; None if none keeps the limits."""
    left = float(pieces.knots[-1]) - t
    mean = 0.5 * (1 + factor)  # of the path speed while it changes
    best: _Change | None = None
    soonest = np.inf
    lengths = _MIN_DECELERATION_S * _DECELERATION_GROWTH ** np.arange(_MAX_GROWTHS, dtype=np.float64)
    for delay in np.linspace(0.0, 0.9 * left, _DELAYS):
        fits = (delay + lengths < soonest) & (delay + mean * lengths <= left)
        for length in _gentle(pieces, limits, t + delay, lengths[fits], factor):
            change = _decelerated(pieces, limits, t + delay, length, factor)
            if change is not None and is_inside(change, limits):
                best = _Change(t + delay, t + delay + mean * length, change)
                soonest = delay + length
                break
    return best


def _gentle(pieces: Pieces, limits: Limits, begin: float, lengths: Array, final: float) -> list[float]:
    """The lengths of a change of the path speed that may keep the limits: evenly spaced samples of the acceleration do.

    Between two of them, the jerk is at least their difference divided by the time.
    """
    a = _retimed(pieces, begin, lengths[:, None], _change(_EVEN, final)).a
    times = lengths[:, None, None] * np.diff(_EVEN.shares)[:, None]
    is_smooth = np.abs(np.diff(a, axis=1)) <= _JERK_MARGIN * limits.j_max * times
    return lengths[_keeps(a, limits).all(axis=(1, 2)) & is_smooth.all(axis=(1, 2))].tolist()


def _decelerated(pieces: Pieces, limits: Limits, begin: float, length: float, final: float) -> Pieces | None:
    """The motion from `begin` on with the path speed going to `final`; None if a sample exceeds the acceleration limit."""
    crossed = pieces.knots[(pieces.knots > begin) & (pieces.knots < begin + 0.5 * (1 + final) * length)]
    crossings = np.interp((crossed - begin) / length, _change(_FINE, final).progress, _FINE.shares)
    x = np.unique(np.concatenate([_EVEN.shares, crossings]))
    inner = x[1:-1]
    is_apart = np.minimum(inner, np.diff(x)[1:]) * length > _MIN_PIECE_S
    x = np.concatenate([[0.0], inner[is_apart], [1.0]])
    samples = _retimed(pieces, begin, np.array(length), _change(_deceleration(x), final))
    return hermite(length * x, *samples) if _keeps(samples.a, limits).all() else None


def _retimed(pieces: Pieces, begin: float, lengths: Array, law: _Deceleration) -> JointSamples:
    """The motion from `begin` on, with a path speed that changes in each of the lengths (..., 1): (..., T, n)."""
    times = np.minimum(begin + lengths * law.progress, pieces.knots[-1])
    samples = sample(pieces, times.ravel())
    shape = (*times.shape, pieces.coefficients.shape[2])
    v = samples.v.reshape(shape)
    w = law.speed[:, None]
    slope = (law.slope / lengths)[..., None]
    return JointSamples(samples.q.reshape(shape), v * w, samples.a.reshape(shape) * w**2 + v * slope)


def _keeps(a: Array, limits: Limits) -> BoolArray:
    return (a <= (1 + 1e-6) * limits.a_max) & (a >= (1 + 1e-6) * limits.a_low)


def _deceleration(x: Array) -> _Deceleration:
    """The path speed from 1 to 0 with a slope that is a trapezoid of area -1."""
    top = 1 / (1 - _RAMP)
    rise = top / _RAMP
    up = np.minimum(x, _RAMP)
    down = np.maximum(x - (1 - _RAMP), 0.0)
    flat = np.maximum(x - _RAMP, 0.0)
    slope = rise * (up - down)
    speed = 1 - rise * (up**2 / 2 + _RAMP * flat - down**2 / 2)
    progress = x - rise * (up**3 / 6 + _RAMP**2 / 2 * flat + _RAMP * flat**2 / 2 - down**3 / 6)
    return _Deceleration(x, progress, speed, -slope)


_EVEN = _deceleration(np.unique(np.concatenate([np.linspace(0.0, 1.0, _CUTS + 1), [_RAMP, 1 - _RAMP]])))
_FINE = _deceleration(np.linspace(0.0, 1.0, 400))


def _change(law: _Deceleration, final: float) -> _Deceleration:
    """The path speed from 1 to `final`: a deceleration of another depth."""
    x = law.shares
    depth = 1 - final
    return _Deceleration(x, x + depth * (law.progress - x), 1 + depth * (law.speed - 1), depth * law.slope)


def remaining(pieces: Pieces, t: float) -> Pieces:
    """What is left of a motion after a time."""
    k = int(locate(pieces.knots, np.array([t]))[1][0])
    first = shifted(pieces.coefficients[k : k + 1], t - pieces.knots[k : k + 1])
    coefficients = np.concatenate([first, pieces.coefficients[k + 1 :]])
    return Pieces(knots_of(np.diff(pieces.knots[k + 1 :], prepend=t)), coefficients)


def _until(pieces: Pieces, t: float, rest: Pieces) -> Pieces:
    """A motion up to the time t, and then another."""
    k = int(np.searchsorted(pieces.knots, t, side="left"))
    if k > 0 and t - pieces.knots[k - 1] < _SHORTEST_CUT_S:
        k -= 1
        t = float(pieces.knots[k])
    if k == 0:
        return rest
    return joined([Pieces(np.append(pieces.knots[:k], t), pieces.coefficients[:k]), rest])
