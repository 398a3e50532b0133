"""Margins of one linear loop: its delay, gain and phase margins and its peak sensitivity."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import degrees, inf, log, nan, pi
from typing import NamedTuple

import numpy as np

from armctl.core.result import Verdict
from armctl.core.validation import Array, IntArray, frozen
from armctl.lab.loops.state_space import ComplexArray, StateSpace

_MIN_FREQUENCY = 0.3  # rad/s; most arms do nothing below it, and the grid of others begins lower
_SLOWEST = (0.1, 1e-3)  # of the slowest pole: where the dense grid begins, and below it one of an asymptote
_POINTS_PER_E = (25, 3)  # points per factor e, of these two
_MIN_CYCLE = 1e-8  # rad, the smallest turn in a period that rounding leaves exact
_GRID_POINTS = 400
_COARSE_POINTS = 70  # of `coarse_grid`
_MIN_RESONANCE = 0.5  # magnitude of a pole; others change little between two points of the grid
_NARROW = 0.1  # width of a resonance of the closed loop / its frequency, above which the grid is fine enough
_RESONANCE_WIDTHS = np.concatenate([-np.geomspace(10.0, 0.1, 12), [0.0], np.geomspace(0.1, 10.0, 12)])
_SECANT_STEPS = 12
_MAX_GAIN = 100.0  # a larger gain margin is reported as infinite, and one below its inverse as 0
_REAL = 1e-3  # rad, the angle up to which an eigenvalue is real; slow loops are not computed better


@dataclass(frozen=True, slots=True, eq=False)
class LoopMargins(Verdict):
    """Margins of the loop of an arm and a controller at one configuration. True if the closed loop is stable.

    Delay, gain and phase change in all joints at once. An unstable loop has margins of zero and an infinite peak sensitivity.

    Attributes:
        ok: Whether the closed loop is stable.
        delay_margin: s, the smallest additional delay that makes it unstable; infinite if there is none.
        lower_gain_margin: The largest factor below 1 that makes it unstable, as where a motor saturates; 0 below 0.01.
        upper_gain_margin: The smallest factor above 1 that makes it unstable; infinite above 100.
        phase_margin: rad, the smallest phase shift, lag or lead, that makes it unstable; infinite if there is none.
        peak_sensitivity: Ms, the largest sensitivity of any joint at any frequency, with the loops of the other joints closed.
        spectral_radius: The largest magnitude of an eigenvalue of the closed loop; below 1 if it is stable.
        reason: The reason if it is not ok; empty if it is.
    """

    ok: bool
    delay_margin: float
    lower_gain_margin: float
    upper_gain_margin: float
    phase_margin: float
    peak_sensitivity: float
    spectral_radius: float
    reason: str

    def __str__(self) -> str:
        if not self.ok:
            return self.reason
        lower = f"{self.lower_gain_margin:.3g} (lower) and " if self.lower_gain_margin > 0.0 else ""
        return (
            f"delay margin {1e3 * self.delay_margin:.3g} ms, gain margin {lower}{self.upper_gain_margin:.3g}, "
            f"phase margin {degrees(self.phase_margin):.3g} deg, Ms {self.peak_sensitivity:.3g}"
        )

    @property
    def gain_margin(self) -> float:
        """The factor on all torques that makes it unstable: the lower or the upper one, whichever is nearer to 1 as a ratio.

        NaN if it was not computed.
        """
        lower = self.lower_gain_margin
        return lower if lower * self.upper_gain_margin > 1.0 else self.upper_gain_margin


class GainCrossover(NamedTuple):
    """A frequency at which an eigenvalue of a loop transfer function has the magnitude 1.

    Attributes:
        frequency: rad/s.
        phase_margin: rad, above -pi and up to pi: the lag, or if it is negative the lead, that turns the eigenvalue to -1.
        delay_margin: s, the smallest additional delay that does so.
    """

    frequency: float
    phase_margin: float
    delay_margin: float


class PhaseCrossover(NamedTuple):
    """A frequency at which an eigenvalue of a loop transfer function is real and negative.

    Attributes:
        frequency: rad/s; 0 at rest, and pi / dt where the loop alternates at every tick.
        gain_margin: The factor on all torques that makes the eigenvalue -1.
    """

    frequency: float
    gain_margin: float


def frequency_grid(dt: float, points: int = _GRID_POINTS) -> Array:
    """(points,) rad/s, geometric, up to the Nyquist frequency of a control period dt in s."""
    return np.geomspace(_MIN_FREQUENCY, (1 - 1e-6) * pi / dt, points)


def loop_frequencies(loop: StateSpace, dt: float) -> Array:
    """(k,) rad/s, `frequency_grid` and what it leaves out of a loop: its slow poles and its narrow resonances."""
    return _frequencies(loop, dt, _closed_poles(loop))


def loop_margins(loop: StateSpace, dt: float) -> LoopMargins:
    """The margins of a loop transfer function L with negative feedback, and a control period dt in s.

    The loop is on the verge of instability where an eigenvalue of L(jw) is -1; see MacFarlane and Postlethwaite, "The
    generalized Nyquist stability criterion and multivariable root loci" (1977).
    """
    return _margins(loop, dt, True)


def robustness(loop: StateSpace, dt: float) -> LoopMargins:
    """As `loop_margins` without the gain margins, which are NaN here unless the closed loop is unstable."""
    return _margins(loop, dt, False)


def gain_crossovers(loop: StateSpace, dt: float) -> list[GainCrossover]:
    """All frequencies, ascending, at which an eigenvalue of a loop transfer function has the magnitude 1; stable or not."""
    frequencies, eigenvalues = _eigenvalue_curves(loop, dt)
    found = sorted(_unit_crossings(loop, dt, frequencies, eigenvalues), key=lambda each: each.frequency)
    return [GainCrossover(each.frequency, pi - (pi - each.lag) % (2 * pi), each.lag / each.frequency) for each in found]


def phase_crossovers(loop: StateSpace, dt: float) -> list[PhaseCrossover]:
    """All frequencies, ascending, at which an eigenvalue of a loop transfer function is real and negative; stable or not.

    Factors below 0.01 and above 100 are left out.
    """
    return sorted(_phase_crossovers(loop, dt, *_eigenvalue_curves(loop, dt)))


def _eigenvalue_curves(loop: StateSpace, dt: float) -> tuple[Array, ComplexArray]:
    frequencies = loop_frequencies(loop, dt)
    return frequencies, _complex_eigenvalues(loop.transfer(np.exp(1j * frequencies * dt)))


def _margins(loop: StateSpace, dt: float, has_gain: bool) -> LoopMargins:
    poles = _closed_poles(loop)
    radius = float(np.abs(poles).max())
    if not radius < 1.0:
        reason = f"the closed loop is unstable: an eigenvalue has the magnitude {radius:.4g}"
        return LoopMargins(
            ok=False,
            delay_margin=0.0,
            lower_gain_margin=1.0,
            upper_gain_margin=1.0,
            phase_margin=0.0,
            peak_sensitivity=inf,
            spectral_radius=radius,
            reason=reason,
        )
    frequencies = _frequencies(loop, dt, poles)
    transfer = loop.transfer(np.exp(1j * frequencies * dt))
    eigenvalues = _complex_eigenvalues(transfer)
    delay_margin = inf
    phase_margin = inf
    for crossing in _unit_crossings(loop, dt, frequencies, eigenvalues):
        lag = crossing.lag
        delay_margin = min(delay_margin, lag / crossing.frequency)
        phase_margin = min(phase_margin, lag, 2 * pi - lag)
    lower, upper = _gain_margins(loop, dt, frequencies, eigenvalues) if has_gain else (nan, nan)
    return LoopMargins(
        ok=True,
        delay_margin=float(delay_margin),
        lower_gain_margin=lower,
        upper_gain_margin=upper,
        phase_margin=float(phase_margin),
        peak_sensitivity=float(np.abs(np.diagonal(_sensitivity(transfer), axis1=1, axis2=2)).max()),
        spectral_radius=radius,
        reason="",
    )


def _frequencies(loop: StateSpace, dt: float, closed_poles: ComplexArray) -> Array:
    """As `loop_frequencies`. The resonances of both the open and the closed loop can be narrower than the grid."""
    frequencies = frequency_grid(dt)
    sizes = np.abs(closed_poles)
    rates = np.abs(np.log(closed_poles[sizes > _MIN_RESONANCE])) / dt
    slowest = max(float(rates.min(initial=inf)) if len(rates) else inf, _MIN_CYCLE / dt)
    for share, points in zip(_SLOWEST, _POINTS_PER_E, strict=True):
        first = share * slowest
        if first < frequencies[0]:
            count = 1 + int(points * log(frequencies[0] / first))
            frequencies = np.concatenate([np.geomspace(first, frequencies[0], count, endpoint=False), frequencies])
    open_poles = loop.poles()
    poles = np.concatenate([open_poles, closed_poles])
    is_resonance = (np.abs(poles) > _MIN_RESONANCE) & (poles.imag > 0.0)
    with np.errstate(divide="ignore"):
        is_resonance[len(open_poles) :] &= np.abs(np.log(sizes)) < _NARROW * np.angle(closed_poles)
    poles = poles[is_resonance]
    centers = np.angle(poles) / dt
    widths = np.maximum(np.abs(np.log(np.abs(poles))) / dt, 1e-6 * centers)
    around = (centers[:, None] + widths[:, None] * _RESONANCE_WIDTHS).ravel()
    inside = around[(around > frequencies[0]) & (around < frequencies[-1])]
    return np.asarray(np.union1d(frequencies, inside), dtype=np.float64)


@cache
def coarse_grid(dt: float) -> Array:
    """Frequencies, rad/s, of `coarse_margins`."""
    return frozen(frequency_grid(dt, _COARSE_POINTS))


class CoarseMargins(NamedTuple):
    """Margins of the n eigenvalues and joints of a loop, accurate to 1 %; zero and infinite if the closed loop is unstable."""

    delay: Array  # (n,) s, for the eigenvalues of the loop transfer function in the order of their magnitudes
    peak_sensitivity: Array  # (n,) of the joints, with the loops of the other joints closed
    decisive: IntArray  # indices of the frequencies that matter for any of the loops judged at once, also after small changes


def coarse_margins(loop: StateSpace, frequencies: Array, transfer: ComplexArray) -> CoarseMargins:
    """Margins from the loop transfer function (k, n, n) on `coarse_grid`: for searches."""
    n = transfer.shape[1]
    if not np.abs(_closed_poles(loop)).max() < 1.0:
        return CoarseMargins(np.zeros(n), np.full(n, inf), np.arange(len(frequencies)))
    return coarse_margins_of(frequencies, transfer)


def coarse_margins_of(frequencies: Array, transfer: ComplexArray) -> CoarseMargins:
    """As `coarse_margins` of a stable loop, for which the decisive frequencies are enough."""
    sensitivity = _sensitivity(transfer)
    eigenvalues = _eigenvalues(transfer, sensitivity)
    return _coarse_margins(frequencies, eigenvalues[None], np.diagonal(sensitivity, axis1=1, axis2=2)[None])[0]


def _eigenvalues(transfer: ComplexArray, sensitivity: ComplexArray) -> ComplexArray:
    """(k, n) of a loop transfer function, where some may cross the unit circle; elsewhere 0.5 for inside it, 2 for outside."""
    # An eigenvalue l of L is at most |L|, and 1 / (1 + l) one of the sensitivity S: |l| is above 1 if |S| is below 1/2.
    is_inside = np.linalg.norm(transfer, axis=(1, 2)) < 1.0
    is_outside = np.linalg.norm(sensitivity, axis=(1, 2)) < 0.5
    side = np.select([is_inside, is_outside], [-1.0, 1.0], 0.0)
    changes = np.diff(side) != 0.0
    near = (side == 0.0) | np.append(changes, False) | np.append(False, changes)
    eigenvalues = np.tile(2.0 ** side[:, None].astype(np.complex128), transfer.shape[1])
    eigenvalues[near] = np.linalg.eigvals(transfer[near])
    return eigenvalues


def coarse_margins_near(frequencies: Array, transfer: ComplexArray, changes: ComplexArray) -> list[CoarseMargins]:
    """As `coarse_margins_of` after each of small changes (m, k, n, n) of the transfer function, to first order."""
    eigenvalues, right = np.linalg.eig(transfer)
    turned = np.linalg.inv(right) @ changes @ right  # Stewart, Sun, Matrix Perturbation Theory (1990), IV.2.3
    sensitivity = _sensitivity(transfer)
    by_change = sensitivity @ changes @ sensitivity
    later = eigenvalues + np.diagonal(turned, axis1=2, axis2=3)
    sensitivities = np.diagonal(sensitivity - by_change, axis1=2, axis2=3)
    return _coarse_margins(frequencies, later, sensitivities)


def _coarse_margins(frequencies: Array, eigenvalues: ComplexArray, sensitivities: ComplexArray) -> list[CoarseMargins]:
    """Of m loops at once, from the eigenvalues of their transfer functions and the sensitivities of their joints, (m, k, n)."""
    count, _, n = eigenvalues.shape
    eigenvalues = np.take_along_axis(eigenvalues, np.abs(eigenvalues).argsort(axis=2), axis=2)
    size = np.log(np.abs(eigenvalues))
    loops, intervals, ranks = np.nonzero((size[:, 1:] > 0.0) != (size[:, :-1] > 0.0))
    # Eigenvalues of one rank are interpolated, magnitude and frequency geometrically.
    before = size[loops, intervals, ranks]
    share = before / (before - size[loops, intervals + 1, ranks])
    start = np.angle(eigenvalues[loops, intervals, ranks])
    turn = (np.angle(eigenvalues[loops, intervals + 1, ranks]) - start + pi) % (2 * pi) - pi
    w = frequencies[intervals] * (frequencies[intervals + 1] / frequencies[intervals]) ** share
    delay = np.full((count, n), inf)
    np.minimum.at(delay, (loops, ranks), (start + share * turn + pi) % (2 * pi) / w)
    peaks, near = _peaks(np.log(frequencies), np.log(np.abs(sensitivities)))
    decisive = np.unique(np.concatenate([intervals, intervals + 1, near.ravel()]))
    return [CoarseMargins(*each, decisive) for each in zip(delay, np.exp(peaks), strict=True)]


def _peaks(x: Array, y: Array) -> tuple[Array, IntArray]:
    """(m, n) the maxima of y (m, k, n) over x (k,), by parabolas through three points, and the (m, 3, n) points."""
    near = np.clip(y.argmax(axis=1), 1, len(x) - 2)[:, None] + np.array([[-1], [0], [1]])
    left, middle, right = np.take_along_axis(y, near, axis=1).swapaxes(0, 1)
    before, after = np.diff(x[near], axis=1).swapaxes(0, 1)
    slope = (middle - left) / before
    bend = np.minimum(((right - middle) / after - slope) / (before + after), -np.finfo(float).tiny)
    slope = slope + bend * before
    top = np.clip(-slope / (2 * bend), -before, after)
    return middle + (slope + bend * top) * top, near


def _sensitivity(transfer: ComplexArray) -> ComplexArray:
    """(..., n, n) of a loop transfer function; the diagonal has that of each joint with the loops of the others closed."""
    return np.asarray(np.linalg.inv(np.eye(transfer.shape[-1]) + transfer), dtype=np.complex128)


@dataclass(frozen=True, slots=True, eq=False)
class _Crossing:
    """A frequency, rad/s, at which an eigenvalue of the loop has the magnitude 1."""

    frequency: float
    eigenvalue: complex

    @property
    def lag(self) -> float:
        """rad, from 0 to 2 pi, that turns the eigenvalue to -1."""
        return float((np.angle(self.eigenvalue) + pi) % (2 * pi))


def _unit_crossings(loop: StateSpace, dt: float, frequencies: Array, eigenvalues: ComplexArray) -> list[_Crossing]:
    """All crossings of the unit circle. Sorted magnitudes are continuous, so eigenvalues need not be told apart on the way."""
    sizes = np.sort(np.log(np.abs(eigenvalues)), axis=1)
    outside = sizes > 0.0
    intervals, ranks = np.nonzero(outside[1:] != outside[:-1])
    if not len(ranks):
        return []
    low = np.log(frequencies[intervals])
    high = np.log(frequencies[intervals + 1])
    at_low = sizes[intervals, ranks]
    at_high = sizes[intervals + 1, ranks]
    rows = np.arange(len(ranks))
    middle = low
    for _ in range(_SECANT_STEPS):  # regula falsi of the Illinois kind (Dowell, Jarratt, BIT 11, 1971)
        middle = low + (high - low) * at_low / (at_low - at_high)
        values = np.sort(np.abs(np.linalg.eigvals(loop.transfer(np.exp(1j * np.exp(middle) * dt)))), axis=1)
        value = np.log(values[rows, ranks])
        is_low = (value > 0.0) == (at_low > 0.0)
        at_high = np.where(is_low, 0.5 * at_high, value)
        at_low = np.where(is_low, value, 0.5 * at_low)
        low = np.where(is_low, middle, low)
        high = np.where(is_low, high, middle)
    eigenvalues = _complex_eigenvalues(loop.transfer(np.exp(1j * np.exp(middle) * dt)))
    nearest = np.abs(np.abs(eigenvalues) - 1.0).argmin(axis=1)
    return [_Crossing(float(w), complex(e)) for w, e in zip(np.exp(middle), eigenvalues[rows, nearest], strict=True)]


def _gain_margins(loop: StateSpace, dt: float, frequencies: Array, eigenvalues: ComplexArray) -> tuple[float, float]:
    """The factors nearest to 1 on either side where an eigenvalue of the loop is real, -1 / factor.

    Crossings at frequencies of zero and pi / dt, where the loop is real, belong to them.
    """
    factors = np.array([each.gain_margin for each in _phase_crossovers(loop, dt, frequencies, eigenvalues)])
    return float(factors[factors < 1.0].max(initial=0.0)), float(factors[factors > 1.0].min(initial=inf))


def _phase_crossovers(loop: StateSpace, dt: float, frequencies: Array, eigenvalues: ComplexArray) -> list[PhaseCrossover]:
    ends = loop.transfer(np.array([-1.0 + 0.0j]))
    found = [_complex_eigenvalues(ends).ravel()]
    places = [np.full(len(found[0]), pi / dt)]
    at_rest = _at_rest(loop)
    if at_rest is not None:
        found.append(_complex_eigenvalues(at_rest))
        places.append(np.zeros(len(found[1])))
    between, values = _real_crossings(loop, dt, frequencies, eigenvalues)
    found.append(values)
    places.append(between)
    every = np.concatenate(found)
    is_real = (every.real < 0.0) & (np.abs(every.imag) < _REAL * np.abs(every.real))
    factors = -1 / every.real[is_real]
    where = np.concatenate(places)[is_real]
    crossovers = [PhaseCrossover(float(w), float(factor)) for w, factor in zip(where, factors, strict=True)]
    return [each for each in crossovers if 1 / _MAX_GAIN <= each.gain_margin <= _MAX_GAIN]


def _at_rest(loop: StateSpace) -> Array | None:
    """(n, n) the loop transfer function at a frequency of zero; None if it integrates."""
    try:
        return loop.C @ np.linalg.solve(np.eye(len(loop.A)) - loop.A, loop.B) + loop.D
    except np.linalg.LinAlgError:
        return None


def _real_crossings(loop: StateSpace, dt: float, frequencies: Array, eigenvalues: ComplexArray) -> tuple[Array, ComplexArray]:
    """(k,) frequencies at which eigenvalues of the loop cross the negative real axis within the largest gain, and these."""
    later = _followed(eigenvalues)
    start = eigenvalues[:-1]
    is_left = (start.real < 0.0) | (later.real < 0.0)
    is_near = (np.abs(start) * 2 * _MAX_GAIN > 1.0) & (np.abs(later) < 2 * _MAX_GAIN)
    intervals, columns = np.nonzero((start.imag > 0.0) != (later.imag > 0.0))
    kept = (is_left & is_near)[intervals, columns]
    intervals = intervals[kept]
    low = np.log(frequencies[intervals])
    high = np.log(frequencies[intervals + 1])
    at_low = start[intervals, columns[kept]]
    at_high = later[intervals, columns[kept]]
    weight_low = np.sin(np.angle(at_low))
    weight_high = np.sin(np.angle(at_high))
    middle = low
    middle_value = at_low
    for _ in range(_SECANT_STEPS if len(intervals) else 0):  # as in `_unit_crossings`
        share = weight_low / (weight_low - weight_high)
        middle = low + (high - low) * share
        values = np.linalg.eigvals(loop.transfer(np.exp(1j * np.exp(middle) * dt)))
        expected = at_low + (at_high - at_low) * share
        nearest = np.abs(values - expected[:, None]).argmin(axis=1)
        middle_value = values[np.arange(len(values)), nearest]
        height = np.sin(np.angle(middle_value))
        is_low = (height > 0.0) == (weight_low > 0.0)
        weight_high = np.where(is_low, 0.5 * weight_high, height)
        weight_low = np.where(is_low, height, 0.5 * weight_low)
        low = np.where(is_low, middle, low)
        high = np.where(is_low, high, middle)
        at_low = np.where(is_low, middle_value, at_low)
        at_high = np.where(is_low, at_high, middle_value)
    return np.exp(middle), np.asarray(middle_value, dtype=np.complex128)


def _followed(eigenvalues: ComplexArray) -> ComplexArray:
    """(k - 1, n) the eigenvalue at the next frequency that continues each of (k, n), the nearest pairs first."""
    start = eigenvalues[:-1]
    later = eigenvalues[1:]
    distance = np.abs(start[:, :, None] - later[:, None]) / (np.abs(start)[:, :, None] + np.abs(later)[:, None])
    found = np.empty_like(start)
    rows = np.arange(len(start))
    for _ in range(start.shape[1]):
        before, after = np.divmod(distance.reshape(len(start), -1).argmin(axis=1), start.shape[1])
        found[rows, before] = later[rows, after]
        distance[rows, before] = inf
        distance[rows, :, after] = inf
    return found


def _closed_poles(loop: StateSpace) -> ComplexArray:
    C = np.linalg.solve(np.eye(len(loop.D)) + loop.D, loop.C) if loop.D.any() else loop.C
    return _complex_eigenvalues(loop.A - loop.B @ C)


def _complex_eigenvalues(matrices: Array | ComplexArray) -> ComplexArray:
    return np.asarray(np.linalg.eigvals(matrices), dtype=np.complex128)
