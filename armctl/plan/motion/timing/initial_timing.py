"""A first motion along a path, which the solver of path timing then runs at another speed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.plan.motion.trajectory.limit_check import limit_excess

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_INITIAL_INTERVALS = 120
_BACKWARD_TOLERANCE = 1e-9  # of the mean speed: rounding, next to the rest at both ends
_BISECTIONS = 54  # halve an interval until rounding
_MIN_SPEED_SHARE = 1e-3  # of the mean speed, of a timing that is made to increase


class Path(Protocol):
    """A path of the joints, as a function of its length."""

    @property
    def length(self) -> float: ...  # in whatever unit the path is measured in

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq/ds, d2q/ds2 and d3q/ds3, each (T, n), at lengths (T,)."""
        ...


class Timing(NamedTuple):
    """A motion along a path, sampled at the edges of equal intervals."""

    h: float  # s, the length of an interval
    intervals: int  # how many there are
    spline: object | None  # scipy's spline of the length over time; None where the length is the time

    @property
    def edges(self) -> Array:
        """(intervals + 1,) s, the edges of the intervals."""
        return self.h * np.arange(self.intervals + 1.0)

    def at(self, u: Array) -> tuple[Array, Array, Array, Array]:
        """s, s', s'' and s''', each (T,), at times (T,) s up to the timing's last edge."""
        if self.spline is None:
            return u, np.ones_like(u), np.zeros_like(u), np.zeros_like(u)
        s = self.spline(u, 0)  # type: ignore[operator]
        s1 = self.spline(u, 1)  # type: ignore[operator]
        s2 = self.spline(u, 2)  # type: ignore[operator]
        s3 = self.spline(u, 3)  # type: ignore[operator]
        # The spline meets its ends to rounding only.
        is_start = u <= 0.0
        is_at_rest = is_start | (u >= self.h * self.intervals)
        s[is_start] = 0.0
        s1[is_at_rest] = 0.0
        s2[is_at_rest] = 0.0
        return s, s1, s2, s3

    def times_at(self, lengths: Array) -> Array:
        """(k,) s, when it reaches lengths."""
        if self.spline is None:
            return lengths
        edges = self.edges
        s = self.at(edges)[0]
        k = np.clip(np.searchsorted(s, lengths, side="right") - 1, 0, self.intervals - 1)
        return where_reached(self.spline, lengths, edges[k], edges[k + 1])  # type: ignore[arg-type]


def where_reached(function: Callable[[Array], Array], values: Array, low: Array, high: Array) -> Array:
    """Where an increasing function of (k,) numbers takes values (k,), between bounds (k,), by bisection."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        is_below = function(middle) < values
        low = np.where(is_below, middle, low)
        high = np.where(is_below, high, middle)
    return high


def initial_timing(path: Path, limits: Limits) -> Timing:
    """From rest to rest, the joints together at an even speed in between: a path by a singularity needs that."""
    from scipy.interpolate import CubicSpline

    s = np.linspace(0.0, path.length, 4 * _INITIAL_INTERVALS + 1)
    rate = np.linalg.norm(path.derivatives(s)[1] / limits.v_max, axis=1)
    rate += 1e-3 * rate.mean()
    way = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(s))])
    u = np.linspace(0.0, 1.0, _INITIAL_INTERVALS // 2 + 1)
    step = u**3 * (10 + u * (6 * u - 15))
    return smooth_timing(
        2 * float(way[-1]) * u, np.clip(CubicSpline(way, s)(way[-1] * step), 0.0, path.length), _INITIAL_INTERVALS
    )


def smooth_timing(t: Array, s: Array, intervals: int) -> Timing:
    """The timing along a spline of degree five through lengths (k,) at times (k,) s, at rest at both ends.

    The interpolating spline overshoots where the speed changes by orders of magnitude over a short distance, for example
    where a path leaves a singularity. There the arm would run backwards, even beyond the start of the path. In that case the
    lengths become the coefficients of the spline: a B-spline with increasing coefficients increases (de Boor, "A Practical
    Guide to Splines", 2001, chapter XI).
    """
    from scipy.interpolate import make_interp_spline

    rest = [(1, 0.0), (2, 0.0)]
    spline = make_interp_spline(t, s, k=5, bc_type=(rest, rest))
    if _runs_backwards(spline, s[-1] / t[-1]):
        spline = _increasing(spline.t, t, s)
    return Timing(float(t[-1]) / intervals, intervals, spline)


def _runs_backwards(spline: BSpline, mean_speed: float) -> bool:
    """Whether a spline decreases anywhere by more than rounding."""
    from scipy.interpolate import PPoly

    curve = PPoly.from_spline(spline)
    least = np.array([-_BACKWARD_TOLERANCE * mean_speed])
    return bool((limit_excess(curve.c[::-1].T[:, :, None], np.diff(curve.x), 1, least, np.array([np.inf])) > 0).any())


def _increasing(knots: Array, t: Array, s: Array) -> BSpline:
    """The spline of degree five, at rest at both ends, whose coefficients are the lengths at the averages of its knots."""
    from scipy.interpolate import BSpline

    averages = np.convolve(knots[1:-1], np.full(5, 0.2), mode="valid")
    lengths = np.maximum.accumulate(np.clip(s, 0.0, s[-1]))
    even = _MIN_SPEED_SHARE * s[-1] * t / t[-1]
    coefficients = np.interp(averages, t, (1 - _MIN_SPEED_SHARE) * lengths + even)
    coefficients[:3] = 0.0
    coefficients[-3:] = s[-1]
    return BSpline(knots, coefficients, 5)
