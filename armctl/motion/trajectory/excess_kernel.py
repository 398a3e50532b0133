"""How far piecewise polynomials leave their bounds, compiled.

A polynomial on an interval lies between the least and the greatest of its Bernstein coefficients (Farouki, "The Bernstein
polynomial basis: a centennial retrospective", Computer Aided Geometric Design 29(6), 2012). Most pieces are inside their bounds
by that alone. The others are halved, by de Casteljau's rule, until no part can exceed what has been found at the ends of parts.
"""

from __future__ import annotations

import numpy as np

from armctl.core.jit import njit

MAX_PARTS = 64  # of a piece that wait to be halved: halving one leaves one more
MAX_HALVINGS = 400
ROUNDING = 1e-14  # relative to the largest coefficient


@njit
def _hull(b, degree, low, high):
    """A bound on how far a polynomial leaves [low, high], by its Bernstein coefficients."""
    most = max(b[0] - high, low - b[0])
    for i in range(1, degree + 1):
        most = max(most, b[i] - high, low - b[i])
    return most


@njit
def _halve(b, degree, right):
    """Replaces a polynomial's Bernstein coefficients by those of its left half, `right` by those of its right half."""
    right[degree] = b[degree]
    for level in range(1, degree + 1):
        for i in range(degree, level - 1, -1):
            b[i] = 0.5 * (b[i] + b[i - 1])
        right[degree - level] = b[degree]


@njit
def _excess(parts, degree, low, high):
    """How far the polynomial in parts[0] leaves [low, high]; at most 0 where it does not."""
    most = _hull(parts[0], degree, low, high)
    if most <= 0.0:
        return most
    size = 0.0
    for i in range(degree + 1):
        size = max(size, abs(parts[0, i]))
    found = max(parts[0, 0] - high, low - parts[0, 0], parts[0, degree] - high, low - parts[0, degree])
    threshold = max(found, 0.0) + ROUNDING * size
    count = 1 if most > threshold else 0
    for _ in range(MAX_HALVINGS):
        if count == 0:
            break
        count -= 1
        _halve(parts[count], degree, parts[count + 1])
        middle = parts[count, degree]
        found = max(found, middle - high, low - middle)
        threshold = max(found, 0.0) + ROUNDING * size
        keeps_left = _hull(parts[count], degree, low, high) > threshold
        keeps_right = _hull(parts[count + 1], degree, low, high) > threshold
        if keeps_right and not keeps_left:
            for i in range(degree + 1):
                parts[count, i] = parts[count + 1, i]
        count += int(keeps_left) + int(keeps_right)
        if count >= MAX_PARTS - 1:
            break
    if count:  # parts are left that may exceed it: the bound is not exact
        for k in range(count):
            found = max(found, _hull(parts[k], degree, low, high))
    return found


@njit
def excess(coefficients, steps, order, low, high):
    """How far a derivative of each joint leaves its bounds in each piece.

    `coefficients` (m, d + 1, n) are of powers of the time since a piece began, `steps` (m,) the lengths of the pieces, `low`
    and `high` (m, n) the bounds. Returns (m, n): exact where it is greater than 0, else any number of at most 0.
    """
    pieces, count, n = coefficients.shape
    degree = count - 1 - order
    out = np.empty((pieces, n))
    parts = np.empty((MAX_PARTS + 1, degree + 1))
    powers = np.empty(degree + 1)
    weights = np.zeros((degree + 1, degree + 1))  # from powers to the Bernstein basis: C(i, k) / C(degree, k)
    factors = np.empty(degree + 1)  # of the derivative
    for k in range(degree + 1):
        factors[k] = 1.0
        for r in range(order):
            factors[k] *= k + 1 + r
        weight = 1.0
        for i in range(k, degree + 1):
            weights[i, k] = weight
            weight *= (i + 1) / (i + 1 - k)
        for i in range(k, degree + 1):
            weights[i, k] /= weights[degree, k] if i < degree else 1.0
        weights[degree, k] = 1.0
    for p in range(pieces):
        for i in range(n):
            power = 1.0
            for k in range(degree + 1):
                powers[k] = factors[k] * coefficients[p, k + order, i] * power
                power *= steps[p]
            for r in range(degree + 1):
                total = 0.0
                for k in range(r + 1):
                    total += weights[r, k] * powers[k]
                parts[0, r] = total
            out[p, i] = _excess(parts, degree, low[p, i], high[p, i])
    return out
