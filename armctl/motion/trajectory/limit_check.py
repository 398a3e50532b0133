"""The true extremes of piecewise polynomials, and what they say about an arm's limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armctl.core.trajectory import Limits
from armctl.core.validation import Array
from armctl.motion.trajectory import polynomials

RATIO_TOLERANCE = 1e-6
QUANTITIES = ("position", "velocity", "acceleration", "jerk")
_PER_TIME = ("", "/s", "/s^2", "/s^3")


def piece_extremes(coefficients: Array, steps: Array, order: int) -> tuple[Array, Array]:
    """Where a derivative may be extreme in each piece, and its values there.

    Args:
        coefficients: (m, d, n), of powers of the time since a piece began.
        steps: (m,) s, the lengths of the pieces.
        order: Which derivative; 0 is the position.

    Returns:
        Times since the piece began, s, and values, each (m, n, k).
    """
    scale = steps[:, None] ** np.arange(coefficients.shape[1])
    p = np.moveaxis(coefficients * scale[:, :, None], 1, 2)
    for _ in range(order):
        p = polynomials.derivative(p)
    with np.errstate(divide="ignore"):
        per_time = np.where(steps > 0, 1 / steps, 0.0) ** order
    places, values = polynomials.extremes(p)
    return places * steps[:, None, None], values * per_time[:, None, None]


@dataclass(frozen=True)
class Peak:
    """The extreme of one quantity of one joint.

    Attributes:
        quantity: "position", "velocity", "acceleration" or "jerk".
        joint: Which joint.
        time: s, when.
        value: In the unit.
        bound: The limit it is held against.
        unit: Such as "rad/s^2", or "m/s^2" for a slide joint.
        ratio: How much of the limit it uses; more than 1 is outside. For a position 1 is at a limit and 0 midway between them.
    """

    quantity: str
    joint: str
    time: float
    value: float
    bound: float
    unit: str
    ratio: float

    def __str__(self) -> str:
        return (
            f"{self.joint}: {self.quantity} {self.value:.6g} {self.unit} at {self.time:.4f} s, "
            f"limit {self.bound:.6g} {self.unit} ({100 * self.ratio:.4g} %)"
        )


@dataclass(frozen=True)
class LimitCheck:
    """What a motion makes of an arm's limits.

    Attributes:
        ok: Whether it stays inside all of them.
        peaks: The extreme of each quantity and joint, four for each joint; quantities without a limit are left out.
    """

    ok: bool
    peaks: tuple[Peak, ...]

    @property
    def worst(self) -> Peak:
        """The one that uses most of its limit."""
        return max(self.peaks, key=lambda peak: peak.ratio)

    @property
    def violations(self) -> tuple[Peak, ...]:
        """Those outside, the worst first."""
        outside = [peak for peak in self.peaks if peak.ratio > 1 + RATIO_TOLERANCE]
        return tuple(sorted(outside, key=lambda peak: -peak.ratio))

    def __str__(self) -> str:
        if self.ok:
            return f"inside all limits; the most is {self.worst}" if self.peaks else "inside all limits: there are none"
        return "outside the limits: " + "; ".join(map(str, self.violations))


def check_limits(
    knots: Array, coefficients: Array, limits: Limits, joint_names: tuple[str, ...], units: tuple[str, ...]
) -> LimitCheck:
    """The extremes of piecewise polynomials held against limits.

    Args:
        knots: (m + 1,) s.
        coefficients: (m, 6, n).
        limits: What the joints can do.
        joint_names: Their names.
        units: What each is measured in, "rad" or "m".

    Returns:
        The check.
    """
    peaks: list[Peak] = []
    steps = np.diff(knots)
    for order, quantity in enumerate(QUANTITIES):
        times, values = piece_extremes(coefficients, steps, order)
        times = np.moveaxis(times + knots[:-1, None, None], 1, 0).reshape(len(joint_names), -1)
        values = np.moveaxis(values, 1, 0).reshape(len(joint_names), -1)
        low, high = _bounds(limits, order)
        half = 0.5 * (high - low)
        with np.errstate(invalid="ignore"):
            middle = np.where(np.isfinite(half), low + half, 0.0)
            ratios = np.where(half[:, None] > 0, np.abs(values - middle[:, None]) / half[:, None], 0.0)
        for i in np.flatnonzero(np.isfinite(half) & (half > 0)):
            k = int(ratios[i].argmax())
            bound = high[i] if values[i, k] > middle[i] else low[i]
            at = float(times[i, k]), float(values[i, k]), float(bound)
            peaks.append(Peak(quantity, joint_names[i], *at, units[i] + _PER_TIME[order], float(ratios[i, k])))
    return LimitCheck(all(peak.ratio <= 1 + RATIO_TOLERANCE for peak in peaks), tuple(peaks))


def _bounds(limits: Limits, order: int) -> tuple[Array, Array]:
    if order == 0:
        return limits.q_min, limits.q_max
    high = (limits.v_max, limits.a_max, limits.j_max)[order - 1]
    return -high, high
