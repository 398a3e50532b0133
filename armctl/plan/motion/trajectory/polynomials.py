"""Extremes of many polynomials at once, on [0, 1]."""

import math
from functools import lru_cache

import numpy as np

from armctl.core.validation import Array, frozen

_ROOT_STEPS = 11  # of Newton's method between two turning points


def on_unit_interval(coefficients: Array, steps: Array, order: int) -> Array:
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


def hull_of(p: Array) -> Array:
    """The Bernstein coefficients of polynomials (d + 1, ...), constant first; on [0, 1] the values lie between them.

    Farouki, "The Bernstein polynomial basis: a centennial retrospective", Computer Aided Geometric Design 29(6), 2012.
    """
    return np.tensordot(_bernstein_basis(len(p) - 1), p, 1)


@lru_cache(maxsize=32)
def _bernstein_basis(degree: int) -> Array:
    """The Bernstein coefficients of each power, (degree + 1, degree + 1)."""
    powers = range(degree + 1)
    return frozen(np.array([[math.comb(i, k) / math.comb(degree, k) for k in powers] for i in powers]))
