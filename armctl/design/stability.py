"""Margins of one linear loop: its delay, gain and phase margins and its peak sensitivity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from math import inf, pi
from typing import NamedTuple

import numpy as np

from armctl.core.result import Verdict
from armctl.core.validation import Array, IntArray, frozen
from armctl.design.state_space import ComplexArray, StateSpace

_MIN_FREQUENCY = 0.3  # rad/s; below it, arms do not move
_GRID_POINTS = 400
_COARSE_POINTS = 70  # of `coarse_grid`
_BISECTIONS = 40
_MIN_RESONANCE = 0.5  # magnitude of a pole; others change little between two points of the grid
_RESONANCE_WIDTHS = np.concatenate([-np.geomspace(10.0, 0.1, 12), [0.0], np.geomspace(0.1, 10.0, 12)])
_SECANT_STEPS = 12
_MAX_GAIN = 100.0  # a larger gain margin is reported as infinite
_GAIN_STEPS = 60  # between 1 and the largest gain, geometric


@dataclass(frozen=True, slots=True, eq=False)
class LoopMargins(Verdict):
    """Margins of the loop of an arm and a controller at one configuration. True if the closed loop is stable.

    Delay, gain and phase change in all joints at once. An unstable loop has margins of zero and an infinite peak sensitivity.

    Attributes:
        ok: Whether the closed loop is stable.
        delay_margin: s, the smallest additional delay that makes it unstable; infinite if there is none.
        gain_margin: The smallest factor above 1 on all torques that makes it unstable; infinite above 100.
        phase_margin: rad, the smallest phase shift, lag or lead, that makes it unstable; infinite if there is none.
        peak_sensitivity: Ms, the largest sensitivity of any joint at any frequency, with the loops of the other joints closed.
        spectral_radius: The largest magnitude of an eigenvalue of the closed loop; below 1 if it is stable.
        reason: The reason if it is not ok; empty if it is.
    """

    ok: bool
    delay_margin: float
    gain_margin: float
    phase_margin: float
    peak_sensitivity: float
    spectral_radius: float
    reason: str


def frequency_grid(dt: float, points: int = _GRID_POINTS) -> Array:
    """(points,) rad/s, geometric, up to the Nyquist frequency of a control period dt in s."""
    return np.geomspace(_MIN_FREQUENCY, (1 - 1e-6) * pi / dt, points)


def loop_margins(loop: StateSpace, dt: float) -> LoopMargins:
    """The margins of a strictly proper loop transfer function L with negative feedback, and a control period dt in s.

    The loop is on the verge of instability where an eigenvalue of L(jw) is -1; see MacFarlane and Postlethwaite, "The
    generalized Nyquist stability criterion and multivariable root loci" (1977).
    """
    found = robustness(loop, dt)
    return replace(found, gain_margin=_gain_margin(loop)) if found else found


def robustness(loop: StateSpace, dt: float) -> LoopMargins:
    """As `loop_margins` without the gain margin, which takes longest and is infinite here."""
    radius = _spectral_radius(loop, 1.0)
    if not radius < 1.0:
        reason = f"the closed loop is unstable: an eigenvalue has the magnitude {radius:.4g}"
        return LoopMargins(False, 0.0, 1.0, 0.0, inf, radius, reason)
    frequencies = _with_resonances(frequency_grid(dt), loop, dt)
    transfer = loop.transfer(np.exp(1j * frequencies * dt))
    crossings = _unit_crossings(loop, dt, frequencies, transfer)
    delay_margin = inf
    phase_margin = inf
    for crossing in crossings:
        lag = (np.angle(crossing.eigenvalue) + pi) % (2 * pi)
        delay_margin = min(delay_margin, lag / crossing.frequency)
        phase_margin = min(phase_margin, lag, 2 * pi - lag)
    return LoopMargins(
        ok=True,
        delay_margin=float(delay_margin),
        gain_margin=inf,
        phase_margin=float(phase_margin),
        peak_sensitivity=float(np.abs(np.diagonal(_sensitivity(transfer), axis1=1, axis2=2)).max()),
        spectral_radius=radius,
        reason="",
    )


def _with_resonances(frequencies: Array, loop: StateSpace, dt: float) -> Array:
    """Frequencies, and those of the resonances of the open loop, which can be narrower than a grid."""
    poles = np.linalg.eigvals(loop.A)
    poles = poles[(np.abs(poles) > _MIN_RESONANCE) & (poles.imag > 0.0)]
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
    if not _spectral_radius(loop, 1.0) < 1.0:
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


def _unit_crossings(loop: StateSpace, dt: float, frequencies: Array, transfer: ComplexArray) -> list[_Crossing]:
    """All crossings of the unit circle. Sorted magnitudes are continuous, so eigenvalues need not be told apart on the way."""
    sizes = np.sort(np.log(np.abs(np.linalg.eigvals(transfer))), axis=1)
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
    eigenvalues = np.linalg.eigvals(loop.transfer(np.exp(1j * np.exp(middle) * dt)))
    nearest = np.abs(np.abs(eigenvalues) - 1.0).argmin(axis=1)
    return [_Crossing(float(w), complex(e)) for w, e in zip(np.exp(middle), eigenvalues[rows, nearest], strict=True)]


def _gain_margin(loop: StateSpace) -> float:
    gains = np.geomspace(1.0, _MAX_GAIN, _GAIN_STEPS + 1)
    for low, high in pairwise(gains.tolist()):
        if _spectral_radius(loop, high) < 1.0:
            continue
        for _ in range(_BISECTIONS // 2):
            middle = 0.5 * (low + high)
            if _spectral_radius(loop, middle) < 1.0:
                low = middle
            else:
                high = middle
        return float(low)
    return inf


def _spectral_radius(loop: StateSpace, gain: float) -> float:
    return float(np.abs(np.linalg.eigvals(loop.A - gain * loop.B @ loop.C)).max())
