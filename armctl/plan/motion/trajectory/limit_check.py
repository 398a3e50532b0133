"""The exact extremes of piecewise polynomials, compared with an arm's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from armctl.core.limits import Limits
from armctl.core.result import Verdict
from armctl.core.validation import Array, BoolArray
from armctl.plan.motion.trajectory.piecewise import Pieces, basis_many, sample
from armctl.plan.motion.trajectory.polynomials import hull_of, on_unit_interval, polynomial_extremes
from armctl.plan.motion.trajectory.velocity_bounds import velocity_peaks

RATIO_TOLERANCE = 1e-6  # relative, of velocity, acceleration and jerk
POSITION_TOLERANCE = 1e-9  # rad (m); not relative, because a joint's stop does not grow with its range
REST_SPEED = 1e-6  # rad/s; a slower end of a trajectory counts as at rest
_JUMP_TOLERANCE = 1e-3  # of the limit of the acceleration
QUANTITIES = ("position", "velocity", "acceleration", "jerk")
_VELOCITY = QUANTITIES.index("velocity")
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
        ratio: The share of the limit; more than 1 is outside. A velocity limit that depends on the position is reported where
            it is exceeded, with the limit at that position. A position has ratio 1 at a limit and 0 midway between
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
    scale = _scale(low, high, order)
    excess = np.maximum(values - high[:, None], low[:, None] - values)  # how far outside, negative inside
    near_ends = _near_ends(pieces, limits) if order == _VELOCITY and limits.depends_on_position else {}
    for i in np.flatnonzero(np.isfinite(high) | np.isfinite(low)):
        k = int(excess[i].argmax())
        value = float(values[i, k])
        above = value - high[i] >= low[i] - value
        peak = Peak(
            quantity=QUANTITIES[order],
            joint=joint_names[i],
            time=float(times[i, k]),
            value=value,
            bound=float(high[i] if above else low[i]),
            unit=units[i] + _PER_TIME[order],
            ratio=max(0.0, 1.0 + float(excess[i, k] / scale[i])),
        )
        yield replace(peak, **near_ends[int(i)]) if i in near_ends else peak


def _near_ends(pieces: Pieces, limits: Limits) -> dict[int, dict[str, float]]:
    """For joints that are faster than an end of their range allows: time, value, bound and ratio where they are so most."""
    peaks = velocity_peaks(pieces.coefficients, np.diff(pieces.knots), limits)
    found: dict[int, dict[str, float]] = {}
    for k in np.argsort(peaks.excess):
        bound = float(peaks.bound[k])
        value = float(peaks.value[k])
        joint = int(peaks.joint[k])
        if peaks.excess[k] > RATIO_TOLERANCE * limits.v_max[joint]:
            time = float(pieces.knots[peaks.piece[k]] + peaks.time[k])
            found[joint] = {"time": time, "value": value, "bound": bound, "ratio": value / bound if bound else math.inf}
    return found


def _scale(low: Array, high: Array, order: int) -> Array:
    """(n,) what excesses are shares of: half the range of a position, and else the smaller bound; 1 without one."""
    half = 0.5 * (high - low) if order == 0 else np.minimum(high, -low)
    return np.where(np.isfinite(half) & (half > 0), half, 1.0)


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
        tolerance = POSITION_TOLERANCE if order == 0 else RATIO_TOLERANCE * _scale(low, high, order)
        inside &= (limit_excess(coefficients, steps, order, low, high) <= tolerance).all(axis=1)
    if limits.depends_on_position:
        peaks = velocity_peaks(coefficients, steps, limits)
        inside[peaks.piece[peaks.excess > RATIO_TOLERANCE * limits.v_max[peaks.joint]]] = False
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
    places, values = polynomial_extremes(np.moveaxis(on_unit_interval(coefficients, steps, order), 0, 1))
    return places * steps[:, None, None], values


def limit_excess(coefficients: Array, steps: Array, order: int, low: Array, high: Array) -> Array:
    """How far a derivative of piecewise polynomials (m, d + 1, n) of the time since a piece began leaves its bounds.

    (m, n): exact where it is greater than 0, else any number of at most 0. `steps` (m,) s are the lengths of the pieces;
    the bounds are (m, n) or (n,). Most pieces are inside their bounds by their Bernstein coefficients alone; of the others
    the extremes are computed.
    """
    p = on_unit_interval(coefficients, steps, order)
    hull = hull_of(p)
    excess = np.maximum(hull.max(axis=0) - high, low - hull.min(axis=0))
    doubtful = excess > 0
    if doubtful.any():
        low = np.broadcast_to(low, excess.shape)
        high = np.broadcast_to(high, excess.shape)
        values = polynomial_extremes(p[:, doubtful].T[:, :, None])[1][:, 0]
        excess[doubtful] = np.maximum(values.max(axis=1) - high[doubtful], low[doubtful] - values.min(axis=1))
    return excess


def _bounds(limits: Limits, order: int) -> tuple[Array, Array]:
    if order == 0:
        return limits.q_min, limits.q_max
    high = (limits.v_max, limits.a_max, limits.j_max)[order - 1]
    low = (limits.v_low, limits.a_low, -limits.j_max)[order - 1]
    return low, high
