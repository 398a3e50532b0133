"""Pieces of polynomials in time, one row of coefficients a power: what every motion is made of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array

DEGREE = 5


class Pieces(NamedTuple):
    """Polynomials over time.

    Attributes:
        knots: (m + 1,) s, from 0.
        coefficients: (m, 6, n).
    """

    knots: Array
    coefficients: Array


def hermite(t: Array, q: Array, v: Array, a: Array) -> Pieces:
    """Pieces of degree five between states.

    Args:
        t: (m + 1,) s, increasing.
        q: (m + 1, n) rad.
        v: (m + 1, n) rad/s.
        a: (m + 1, n) rad/s^2.

    Returns:
        The pieces that have these positions, velocities and accelerations at these times.
    """
    h = np.diff(t)[:, None]
    v0, v1, a0, a1 = v[:-1] * h, v[1:] * h, a[:-1] * h * h, a[1:] * h * h
    d = q[1:] - q[:-1]
    c3 = 10 * d - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15 * d + 8 * v0 + 7 * v1 + 1.5 * a0 - a1
    c5 = 6 * d - 3 * (v0 + v1) - 0.5 * (a0 - a1)
    return Pieces(t, np.stack([q[:-1], v[:-1], a[:-1] / 2, c3 / h**3, c4 / h**4, c5 / h**5], axis=1))


def basis(u: float) -> tuple[tuple[float, ...], ...]:
    """Rows that turn the coefficients of a piece into q, v and a at a time u since it began.

    Args:
        u: s.

    Returns:
        Three rows of six.
    """
    u2, u3, u4 = u * u, u**3, u**4
    return (
        (1.0, u, u2, u3, u4, u**5),
        (0.0, 1.0, 2 * u, 3 * u2, 4 * u3, 5 * u4),
        (0.0, 0.0, 2.0, 6 * u, 12 * u2, 20 * u3),
    )


def basis_many(u: Array) -> Array:
    """`basis` at many times.

    Args:
        u: (T,) s.

    Returns:
        (3, T, 6).
    """
    one, zero = np.ones_like(u), np.zeros_like(u)
    rows = [[entry + zero if isinstance(entry, np.ndarray) else entry * one for entry in row] for row in basis(u)]  # type: ignore[arg-type]
    return np.moveaxis(np.array(rows), 1, 2)
