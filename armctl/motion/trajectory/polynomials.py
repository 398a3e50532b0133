"""Polynomials on [0, 1], many at once: values, derivatives, and where they are greatest and least. No loop over pieces."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array

_BISECTIONS = 46


def value(p: Array, x: Array) -> Array:
    """Polynomials at points.

    Args:
        p: (..., d + 1) coefficients, constant first.
        x: (..., k) points.

    Returns:
        (..., k).
    """
    out = np.broadcast_to(p[..., -1:], x.shape)
    for k in range(p.shape[-1] - 2, -1, -1):
        out = out * x + p[..., k : k + 1]
    return out


def derivative(p: Array) -> Array:
    """The derivatives of polynomials.

    Args:
        p: (..., d + 1) coefficients, constant first.

    Returns:
        (..., max(d, 1)) coefficients.
    """
    if p.shape[-1] == 1:
        return np.zeros_like(p)
    return p[..., 1:] * np.arange(1, p.shape[-1])


def extremes(p: Array) -> tuple[Array, Array]:
    """The points where polynomials may be greatest or least on [0, 1], and their values there.

    Args:
        p: (..., d + 1) coefficients, constant first.

    Returns:
        Places and values, each (..., k): both ends and every turning point between them.
    """
    inner = _roots(_trimmed(derivative(p)))
    ends = np.broadcast_to(np.array([0.0, 1.0]), (*p.shape[:-1], 2))
    points = np.concatenate([ends, inner], axis=-1)
    return points, value(p, points)


def _roots(p: Array) -> Array:
    """d numbers in [0, 1] for each polynomial of degree d, its roots in [0, 1] among them; the rest is harmless.

    Between two neighbouring turning points a polynomial is monotone and has at most one root, which bisection finds.
    """
    degree = p.shape[-1] - 1
    if degree == 0:
        return np.empty((*p.shape[:-1], 0))
    if degree <= 2:
        return _closed_form(p)
    turns = np.sort(_roots(derivative(p)), axis=-1)
    ends = np.zeros((*p.shape[:-1], 1))
    low = np.concatenate([ends, turns], axis=-1)
    high = np.concatenate([turns, ends + 1.0], axis=-1)
    sign = value(p, low) > 0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = (value(p, middle) > 0) == sign
        low = np.where(same, middle, low)
        high = np.where(same, high, middle)
    return 0.5 * (low + high)


def _closed_form(p: Array) -> Array:
    """`_roots` of degrees 1 and 2, without the cancellation of the schoolbook formula."""
    with np.errstate(all="ignore"):
        if p.shape[-1] == 2:
            x = -p[..., :1] / p[..., 1:]
        else:
            c = p[..., 0]
            b = p[..., 1]
            a = p[..., 2]
            root = np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))
            half = -0.5 * (b + np.where(b < 0, -root, root))
            x = np.stack([half / a, c / half], axis=-1)
    return np.clip(np.nan_to_num(x), 0.0, 1.0)


def _trimmed(p: Array) -> Array:
    """Without the highest coefficients where they are zero in every polynomial."""
    degree = p.shape[-1] - 1
    while degree > 0 and not p[..., degree].any():
        degree -= 1
    return p[..., : degree + 1]
