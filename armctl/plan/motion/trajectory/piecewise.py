"""Piecewise polynomials of degree five in time, the representation of every motion: evaluation, interpolation, joining."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array, IntArray

DEGREE = 5
_MIN_OVERLAP_PIECE_S = 1e-9  # a knot that comes sooner after another one is left out
_JOIN_TOLERANCE = 1e-6  # relative to a value of at least 1; generous, because a join need not start on the same bits


class Pieces(NamedTuple):
    """Polynomials over time: q(t) = sum over i of coefficients[k, i] (t - knots[k])^i in piece k."""

    knots: Array  # (m + 1,) s, from 0
    coefficients: Array  # (m, 6, n)


class JointSamples(NamedTuple):
    """Positions, velocities and accelerations, each (T, n)."""

    q: Array
    v: Array
    a: Array


def standing(q: Array) -> Pieces:
    """One piece of zero duration at the configuration q (n,)."""
    coefficients = np.zeros((1, DEGREE + 1, len(q)))
    coefficients[0, 0] = q
    return Pieces(np.zeros(2), coefficients)


def hermite(t: Array, q: Array, v: Array, a: Array) -> Pieces:
    """Quintic pieces that have positions q, velocities v and accelerations a, each (m + 1, n), at the times t (m + 1,)."""
    return Pieces(t, quintics(np.diff(t), JointSamples(q[:-1], v[:-1], a[:-1]), JointSamples(q[1:], v[1:], a[1:])))


def quintics(durations: Array, start: JointSamples, end: JointSamples) -> Array:
    """(m, 6, n) polynomials of degree five that lead from m states to m others in some durations (m,).

    scipy's `BPoly.from_derivatives` computes the same, but takes 60 to 100 times as long (measured): it loops over the pieces.
    """
    h = durations[:, None]
    v0 = start.v * h
    v1 = end.v * h
    a0 = start.a * h * h
    a1 = end.a * h * h
    d = end.q - start.q
    c3 = 10 * d - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15 * d + 8 * v0 + 7 * v1 + 1.5 * a0 - a1
    c5 = 6 * d - 3 * (v0 + v1) - 0.5 * (a0 - a1)
    return np.stack([start.q, start.v, start.a / 2, c3 / h**3, c4 / h**4, c5 / h**5], axis=1)


def joints_of(pieces: Pieces) -> Pieces:
    """The motion without its last column, which is a length or a time."""
    return Pieces(pieces.knots, np.ascontiguousarray(pieces.coefficients[:, :, :-1]))


def locate(knots: Array, times: Array) -> tuple[Array, IntArray]:
    """Times clamped to [0, duration], and the indices of the pieces that contain them."""
    inside = np.clip(times, 0.0, knots[-1])
    return inside, np.clip(np.searchsorted(knots, inside, side="right"), 1, len(knots) - 1) - 1


def sample(pieces: Pieces, times: Array) -> JointSamples:
    """Position, velocity and acceleration at many times (T,), clamped to the motion; outside it, the arm stands still."""
    inside, k = locate(pieces.knots, times)
    q, v, a = np.einsum("otc,tcn->otn", basis_many(inside - pieces.knots[k]), pieces.coefficients[k])
    outside = times != inside
    v[outside] = 0.0
    a[outside] = 0.0
    return JointSamples(q, v, a)


def jerk(pieces: Pieces, times: Array) -> Array:
    """(T, n) jerk at many times, clamped to the motion; where it jumps, the value just after."""
    inside, k = locate(pieces.knots, times)
    u = (inside - pieces.knots[k])[:, None]
    c = pieces.coefficients[k]
    return 6 * c[:, 3] + u * (24 * c[:, 4] + u * 60 * c[:, 5])


def knots_of(durations: Array, begin: float = 0.0) -> Array:
    """Knots (m + 1,) of pieces with durations (m,), rounded so that no piece lasts longer: it might leave its limits.

    After 2000 s, the rounding of times is a millionth of a phase of 0.2 us. Multiples of a power of two add up exactly.
    """
    rounding = np.spacing(begin + durations.sum())
    return np.maximum(begin, np.cumsum(rounding * np.floor(np.append(begin, durations) / rounding)))


def time_scaled(pieces: Pieces, factor: float) -> Pieces:
    powers = factor ** np.arange(DEGREE + 1)
    return Pieces(knots_of(np.diff(pieces.knots) / factor), pieces.coefficients * powers[:, None])


def shifted(coefficients: Array, by: Array) -> Array:
    """Polynomials (m, d + 1, n) as polynomials of the time since `by` (m,): Taylor's series, by repeated synthetic division."""
    out = coefficients.copy()
    degree = out.shape[1] - 1
    for low in range(degree):
        for power in range(degree - 1, low - 1, -1):
            out[:, power] += by[:, None] * out[:, power + 1]
    return out


def restarted(pieces: Pieces, inside: Array, starts: Array) -> Array:
    """The polynomials of the pieces that contain the times `inside`, as polynomials of the time since `starts`."""
    k = locate(pieces.knots, inside)[1]
    return shifted(pieces.coefficients[k], starts - pieces.knots[k])


def joined(parts: Sequence[Pieces]) -> Pieces:
    """Motions one after another; each must start in the state in which the one before it ends."""
    first = parts[0].knots
    others = np.concatenate([np.empty(0), *(np.diff(part.knots) for part in parts[1:])])
    knots = np.concatenate([first[:-1], knots_of(others, first[-1])])
    return Pieces(knots, np.concatenate([part.coefficients for part in parts]))


def overlapped(first: Pieces, second: Pieces, overlap: float) -> Pieces:
    """q(t) = first(t) + second(t - begin) - c, where c is the configuration at which the first ends and the second starts.

    Both are at rest at c, so that the sum is continuous in position, velocity and acceleration.
    """
    end = float(first.knots[-1])
    begin = end - overlap
    total = begin + float(second.knots[-1])
    inner = np.unique(np.concatenate([[0.0, end], first.knots, begin + second.knots]))
    inner = inner[(inner >= 0.0) & (inner < total - _MIN_OVERLAP_PIECE_S)]
    starts = inner[np.concatenate([[True], np.diff(inner) > _MIN_OVERLAP_PIECE_S])]
    knots = np.append(starts, total)
    middle = 0.5 * (knots[1:] + knots[:-1])
    coefficients = np.zeros((len(starts), *first.coefficients.shape[1:]))
    is_first = middle < end
    is_second = middle > begin
    coefficients[is_first] += restarted(first, middle[is_first], starts[is_first])
    coefficients[is_second] += restarted(second, middle[is_second] - begin, starts[is_second] - begin)
    coefficients[is_first & is_second, 0] -= second.coefficients[0, 0]
    return Pieces(knots, coefficients)


def join_gaps(end: Array, start: Array) -> Array:
    """By how many times the tolerance of a join two values differ."""
    return np.abs(end - start) / (_JOIN_TOLERANCE * np.maximum(1.0, np.abs(end)))


def check_pieces(knots: Array, coefficients: Array, joints: int) -> None:
    """Raises InputError unless the arrays describe polynomials of so many joints over increasing times from 0."""
    if knots.ndim != 1 or len(knots) < 2 or coefficients.shape != (len(knots) - 1, DEGREE + 1, joints):
        raise InputError(
            f"coefficients: shape {coefficients.shape} does not fit {knots.size} knots and {joints} joints; "
            f"it must be ({max(knots.size - 1, 1)}, {DEGREE + 1}, {joints})"
        )
    if not (np.isfinite(knots).all() and np.isfinite(coefficients).all()):
        raise InputError("knots and coefficients: every number must be finite")
    if knots[0] != 0.0 or (knots[1:] < knots[:-1]).any():
        raise InputError("knots: they must start at 0 and must not decrease")


def check_continuous(pieces: Pieces, names: Sequence[str]) -> None:
    """Raises InputError where the position jumps between two pieces, or where a value is too large to be evaluated."""
    with np.errstate(all="ignore"):
        steps = np.diff(pieces.knots)
        ends = np.einsum("otc,tcn->otn", basis_many(steps), pieces.coefficients)
        jumps = join_gaps(ends[0, :-1], pieces.coefficients[1:, 0])
        largest = np.einsum("tc,tcn->tn", basis_many(steps)[0], np.abs(pieces.coefficients))
    if not (np.isfinite(ends).all() and np.isfinite(largest).all()):
        raise InputError("coefficients: the motion leaves the range of floating-point numbers")
    if (jumps > 1.0).any():
        k, i = divmod(int(jumps.argmax()), jumps.shape[1])
        raise InputError(f"coefficients: the position of {names[i]} jumps at {pieces.knots[k + 1]:.6g} s")


def basis(u: float) -> tuple[tuple[float, ...], ...]:
    """Three rows of six that turn the coefficients of a piece into q, v and a, a time u after it began."""
    u2 = u * u
    u3 = u**3
    u4 = u**4
    return (
        (1.0, u, u2, u3, u4, u**5),
        (0.0, 1.0, 2 * u, 3 * u2, 4 * u3, 5 * u4),
        (0.0, 0.0, 2.0, 6 * u, 12 * u2, 20 * u3),
    )


def basis_many(u: Array) -> Array:
    """`basis` at many times (T,): (3, T, 6)."""
    one = np.ones_like(u)
    zero = np.zeros_like(u)
    rows = [[entry + zero if isinstance(entry, np.ndarray) else entry * one for entry in row] for row in basis(u)]  # type: ignore[arg-type]
    return np.moveaxis(np.array(rows), 1, 2)
