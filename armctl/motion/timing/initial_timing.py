"""A first motion along a path, which the solver of path timing then runs at another speed."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array

_INITIAL_INTERVALS = 120


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


class Timing(NamedTuple):
    """A motion along a path, sampled at the edges of equal intervals.

    Attributes:
        h: s, the length of an interval.
        intervals: How many there are.
        spline: scipy's spline of the length over time; None where the length is the time.
    """

    h: float
    intervals: int
    spline: object | None

    @property
    def edges(self) -> Array:
        """(intervals + 1,) s, the edges of the intervals."""
        return self.h * np.arange(self.intervals + 1.0)

    def at(self, u: Array) -> tuple[Array, Array, Array, Array]:
        """The length and three derivatives.

        Args:
            u: (T,) s, from 0 to the timing's last edge.

        Returns:
            s, s', s'' and s''', each (T,).
        """
        if self.spline is None:
            return u, np.ones_like(u), np.zeros_like(u), np.zeros_like(u)
        s = self.spline(u, 0)  # type: ignore[operator]
        s1 = self.spline(u, 1)  # type: ignore[operator]
        s2 = self.spline(u, 2)  # type: ignore[operator]
        s3 = self.spline(u, 3)  # type: ignore[operator]
        s[0], s1[0], s1[-1], s2[0], s2[-1] = np.zeros(5)
        return s, s1, s2, s3


def initial_timing(path: Path, limits: Limits) -> Timing:
    """From rest to rest, the joints together at an even speed in between: a path by a singularity needs that.

    Args:
        path: The path.
        limits: What the joints can do.

    Returns:
        The timing.
    """
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
    """The timing along a spline of degree five, at rest at both ends.

    Args:
        t: (k,) s.
        s: (k,) lengths.
        intervals: How many the timing has.

    Returns:
        The timing.
    """
    from scipy.interpolate import make_interp_spline

    rest = [(1, 0.0), (2, 0.0)]
    return Timing(float(t[-1]) / intervals, intervals, make_interp_spline(t, s, k=5, bc_type=(rest, rest)))
