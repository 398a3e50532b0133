"""The exact extremes of piecewise polynomials, compared with an arm's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from armctl.core.limits import Limits
from armctl.core.result import Verdict
from armctl.core.validation import Array, BoolArray, frozen
from armctl.plan.motion.trajectory.piecewise import Pieces, basis_many, sample

RATIO_TOLERANCE = 1e-6  # relative, of velocity, acceleration and jerk
POSITION_TOLERANCE = 1e-9  # rad (m); not relative, because a joint's stop does not grow with its range
REST_SPEED = 1e-6  # rad/s; a slower end of a trajectory counts as at rest
_JUMP_TOLERANCE = 1e-3  # of the limit of the acceleration
_ROOT_STEPS = 11  # of Newton's method between two turning points
QUANTITIES = ("position", "velocity", "acceleration", "jerk")
_JERK = QUANTITIES.index("jerk")
_PER_TIME = ("", "/s", "/s^2", "/s^3")


@dataclass(frozen=True)
class Peak:
    """The extreme of one quantity of one joint.

    Attributes:
        quantity: "position", "velocity", "acceleration" or "jerk".
        time: s, when it occurs.
        value: The value, in `unit`.
        bound: The limit that it is compared with.
        unit: For example "rad/s^2", or "m/s^2" for a slide joint.
        ratio: The share of the limit; more than 1 is outside. A position has ratio 1 at a limit and 0 midway between
            the two limits; with one limit only, the ratio grows by 1 for each rad (m).
    """

    quantity: str
    joint: str
    time: float
    value: float
    bound: float
    unit: str
    ratio: float

    @property
    def ok(self) -> bool:
        """Whether it is inside the limit: positions to 1e-9 rad (m), the others to 1e-6 of the limit."""
        if self.quantity == "position":
            return self.ratio <= 1.0 or abs(self.value - self.bound) <= POSITION_TOLERANCE
        return self.ratio <= 1 + RATIO_TOLERANCE

    @property
    def reason(self) -> str:
        """Which limit is exceeded; empty if `ok`."""
        return "" if self.ok else str(self)

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        return (
            f"{self.joint}: {self.quantity} {self.value:.6g} {self.unit} at {self.time:.4f} s, "
            f"limit {self.bound:.6g} {self.unit} ({100 * self.ratio:.4g} %)"
        )


@dataclass(frozen=True)
class LimitCheck(Verdict):
    """Whether a motion keeps position, velocity, acceleration and jerk limits. True if it does.

    Attributes:
        ok: Whether it stays inside all of them.
        peaks: The extreme of each quantity and joint, four for each joint; quantities without a limit are left out.
        ends_moving: Which joint moves fastest at the end, in words; empty if the motion ends at rest. The limits hold until
            there; what follows must go on from that speed.
    """

    ok: bool
    peaks: tuple[Peak, ...]
    ends_moving: str = ""

    @property
    def worst(self) -> Peak:
        """The peak that uses most of its limit."""
        return max(self.peaks, key=lambda peak: peak.ratio)

    @property
    def violations(self) -> tuple[Peak, ...]:
        """The peaks outside their limits, the worst first."""
        outside = [peak for peak in self.peaks if not peak.ok]
        return tuple(sorted(outside, key=lambda peak: -peak.ratio))

    @property
    def reason(self) -> str:
        """The worst violation, in words; empty if there is none."""
        outside = list(self.violations)
        if not outside:
            return ""
        more = f" (and {len(outside) - 1} more)" if len(outside) > 1 else ""
        return f"outside the limits: {outside[0]}{more}"

    def __str__(self) -> str:
        if not self.ok:
            return self.reason
        inside = f"inside all limits; the largest share is {self.worst}" if self.peaks else "inside all limits: there are none"
        return f"{inside}; it does not end at rest: {self.ends_moving}" if self.ends_moving else inside


def check_limits(pieces: Pieces, limits: Limits, joint_names: tuple[str, ...], units: tuple[str, ...]) -> LimitCheck:
    """The extremes of piecewise polynomials compared with limits."""
    peaks = [peak for order in range(len(QUANTITIES)) for peak in _peaks(pieces, limits, order, joint_names, units)]
    v = np.abs(sample(pieces, pieces.knots[-1:]).v[0])
    i = int(v.argmax())
    ends_moving = f"{joint_names[i]} moves at {v[i]:.3g} {units[i]}/s" if v[i] > REST_SPEED else ""
    return LimitCheck(all(peak.ok for peak in peaks), tuple(peaks), ends_moving)


def _peaks(pieces: Pieces, limits: Limits, order: int, joint_names: tuple[str, ...], units: tuple[str, ...]) -> Iterator[Peak]:
    """The worst extreme of one derivative of every joint that has a limit of it."""
    n = pieces.coefficients.shape[2]
    all_times, all_values = piece_extremes(pieces.coefficients, np.diff(pieces.knots), order)
    times = np.moveaxis(all_times + pieces.knots[:-1, None, None], 1, 0).reshape(n, -1)
    values = np.moveaxis(all_values, 1, 0).reshape(n, -1)
    if order == _JERK and (jumps := _acceleration_jumps(pieces, limits)).any():
        times = np.concatenate([times, np.tile(pieces.knots[1:-1], (n, 1))], axis=1)
        values = np.concatenate([values, jumps], axis=1)
    low, high = _bounds(limits, order)
    half = 0.5 * (high - low)
    scale = np.where(np.isfinite(half) & (half > 0), half, 1.0)
    excess = np.maximum(values - high[:, None], low[:, None] - values)  # how far outside, negative inside
    for i in np.flatnonzero(np.isfinite(high) | np.isfinite(low)):
        k = int(excess[i].argmax())
        value = float(values[i, k])
        above = value - high[i] >= low[i] - value
        yield Peak(
            quantity=QUANTITIES[order],
            joint=joint_names[i],
            time=float(times[i, k]),
            value=value,
            bound=float(high[i] if above else low[i]),
            unit=units[i] + _PER_TIME[order],
            ratio=max(0.0, 1.0 + float(excess[i, k] / scale[i])),
        )


def _acceleration_jumps(pieces: Pieces, limits: Limits) -> Array:
    """(n, m - 1) rad/s^3, the jerk at the inner knots: infinite where the acceleration jumps, else 0."""
    ends = np.einsum("tc,tcn->tn", basis_many(np.diff(pieces.knots)[:-1])[2], pieces.coefficients[:-1])
    jumps = 2 * pieces.coefficients[1:, 2] - ends
    scale = np.where(np.isfinite(limits.a_max), limits.a_max, np.abs(ends).max(initial=0.0))
    return np.where(np.abs(jumps) > _JUMP_TOLERANCE * scale, np.copysign(np.inf, jumps), 0.0).T


def has_continuous_acceleration(pieces: Pieces, limits: Limits) -> bool:
    """Whether the acceleration does not jump from piece to piece, by more than rounding."""
    return not _acceleration_jumps(pieces, limits).any()


def is_inside(pieces: Pieces, limits: Limits) -> bool:
    """`check_limits(...).ok`, without the report, for motions whose acceleration does not jump."""
    return bool(each_inside(pieces.coefficients, np.diff(pieces.knots), limits).all())


def each_inside(coefficients: Array, steps: Array, limits: Limits) -> BoolArray:
    """(m,) whether each of some polynomials (m, 6, n) keeps the limits during the first so many seconds (m,)."""
    inside = np.ones(len(steps), dtype=bool)
    for order in range(len(QUANTITIES)):
        low, high = _bounds(limits, order)
        half = 0.5 * (high - low)
        is_relative = np.isfinite(half) & (half > 0)
        tolerance = POSITION_TOLERANCE if order == 0 else RATIO_TOLERANCE * np.where(is_relative, half, 1.0)
        inside &= (limit_excess(coefficients, steps, order, low, high) <= tolerance).all(axis=1)
    return inside


def stretch_needed(pieces: Pieces, bounds: tuple[Array, Array, Array]) -> float:
    """By which factor a move must be slowed down to keep limits on velocity, acceleration and jerk; 1 if it does."""
    steps = np.diff(pieces.knots)
    factor = 1.0
    for order, bound in enumerate(bounds, start=1):
        peak = np.abs(piece_extremes(pieces.coefficients, steps, order)[1]).max(axis=(0, 2))
        factor = max(factor, float((peak / bound).max()) ** (1 / order))
    return factor


def piece_extremes(coefficients: Array, steps: Array, order: int) -> tuple[Array, Array]:
    """Where a derivative may be extreme in each piece, s since it began, and its values there, each (m, n, k)."""
    places, values = polynomial_extremes(np.moveaxis(_on_unit_interval(coefficients, steps, order), 0, 1))
    return places * steps[:, None, None], values


def _on_unit_interval(coefficients: Array, steps: Array, order: int) -> Array:
    """A derivative of each piece as a function of the share of the piece, (d + 1 - order, m, n)."""
    p = coefficients.swapaxes(0, 1)
    for _ in range(order):
        p = _derivative(p)
    return p * steps[:, None] ** np.arange(len(p))[:, None, None]


def polynomial_extremes(polynomials: Array) -> tuple[Array, Array]:
    """Where polynomials (m, d + 1, n), constant first, may be extreme on [0, 1], and their values there.

    Each (m, n, k): both ends and every turning point between them; the point 0 may be repeated.
    """
    m, count, n = polynomials.shape
    p = np.moveaxis(polynomials, 1, 0)
    used = np.flatnonzero(p.any(axis=(1, 2)))  # powers that any of the polynomials has
    turning_points = max(0, (int(used[-1]) if len(used) else 0) - 1)
    places = np.zeros((max(2, count), m, n))
    places[1] = 1.0
    with np.errstate(all="ignore"):
        if turning_points:
            places[2 : 2 + turning_points] = _roots(_derivative(p)[: turning_points + 1])
        values = _evaluated(p, places)
    return np.moveaxis(places, 0, 2), np.moveaxis(values, 0, 2)


def _evaluated(p: Array, x: Array) -> Array:
    """Polynomials (d + 1, m, n), constant first, at points (k, m, n), by Horner's scheme."""
    value = np.broadcast_to(p[-1], x.shape)
    for c in p[-2::-1]:
        value = value * x + c
    return value


def _derivative(p: Array) -> Array:
    return p[1:] * np.arange(1.0, len(p))[:, None, None]


def _roots(p: Array) -> Array:
    """Numbers in [0, 1], (d, m, n), the roots in [0, 1] of polynomials (d + 1, m, n) among them."""
    if len(p) == 2:
        return _clamped(-p[:1] / p[1:])
    if len(p) == 3:  # without the cancellation of the schoolbook formula
        c, b, a = p
        root = np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))
        half = -0.5 * (b + np.where(b < 0, -root, root))
        return _clamped(np.stack([half / a, c / half]))
    # Between two neighbouring turning points a polynomial is monotone and has at most one root: by Newton's method, with a
    # bisection where a step leaves what is known to contain the root.
    slope = _derivative(p)
    turns = np.sort(_roots(slope), axis=0)
    low = np.concatenate([np.zeros_like(turns[:1]), turns])
    high = np.concatenate([turns, np.ones_like(turns[:1])])
    is_positive = _evaluated(p, low) > 0
    roots = 0.5 * (low + high)
    crosses = is_positive != (_evaluated(p, high) > 0)
    _, piece, joint = np.nonzero(crosses)
    p = p[:, piece, joint]
    slope = slope[:, piece, joint]
    low = low[crosses]
    high = high[crosses]
    is_positive = is_positive[crosses]
    x = roots[crosses]
    for _ in range(_ROOT_STEPS):
        value = _evaluated(p, x)
        is_before = (value > 0) == is_positive
        low = np.where(is_before, x, low)
        high = np.where(is_before, high, x)
        newton = x - value / _evaluated(slope, x)
        x = np.where((low <= newton) & (newton <= high), newton, 0.5 * (low + high))
    roots[crosses] = x
    return roots


def _clamped(x: Array) -> Array:
    """Numbers in [0, 1]; 0 in place of NaN, which is a division of zero by zero."""
    return np.where(np.isnan(x), 0.0, np.minimum(np.maximum(x, 0.0), 1.0))


def limit_excess(coefficients: Array, steps: Array, order: int, low: Array, high: Array) -> Array:
    """How far a derivative of piecewise polynomials (m, d + 1, n) of the time since a piece began leaves its bounds.

    (m, n): exact where it is greater than 0, else any number of at most 0. `steps` (m,) s are the lengths of the pieces;
    the bounds are (m, n) or (n,). A polynomial on an interval lies between the least and the greatest of its Bernstein
    coefficients (Farouki, "The Bernstein polynomial basis: a centennial retrospective", Computer Aided Geometric Design 29(6),
    2012). Most pieces are inside their bounds by that alone; of the others the extremes are computed.
    """
    p = _on_unit_interval(coefficients, steps, order)
    hull = np.tensordot(_bernstein_basis(len(p) - 1), p, 1)
    excess = np.maximum(hull.max(axis=0) - high, low - hull.min(axis=0))
    doubtful = excess > 0
    if doubtful.any():
        low = np.broadcast_to(low, excess.shape)
        high = np.broadcast_to(high, excess.shape)
        values = polynomial_extremes(p[:, doubtful].T[:, :, None])[1][:, 0]
        excess[doubtful] = np.maximum(values.max(axis=1) - high[doubtful], low[doubtful] - values.min(axis=1))
    return excess


@lru_cache(maxsize=32)
def _bernstein_basis(degree: int) -> Array:
    """The Bernstein coefficients of each power, (degree + 1, degree + 1)."""
    powers = range(degree + 1)
    return frozen(np.array([[math.comb(i, k) / math.comb(degree, k) for k in powers] for i in powers]))


def _bounds(limits: Limits, order: int) -> tuple[Array, Array]:
    if order == 0:
        return limits.q_min, limits.q_max
    high = (limits.v_max, limits.a_max, limits.j_max)[order - 1]
    return -high, high
