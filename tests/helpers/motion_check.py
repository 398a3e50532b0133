"""Whether a motion keeps its limits, checked without the code that planned it.

The extremes of each polynomial piece come from the roots of its derivative, the eigenvalues of its companion matrix. A piece
lies between its least and greatest Bernstein coefficients; one that is inside its bounds by that alone needs no roots. Then
the samples of the motion, 1 ms apart, must not differ by more than the limits allow.
"""

from __future__ import annotations

from math import comb

import numpy as np

import armctl
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

POSITION_TOLERANCE = 1e-9  # rad (m)
RATIO_TOLERANCE = 1e-6
DIFFERENCE_TOLERANCE = 1e-3  # of a difference of samples, which the rounding of times limits
SAMPLE_INTERVAL_S = 1e-3
MAX_SAMPLES = 20_000
NEGLIGIBLE = 1e-15  # a leading coefficient of this share of the others changes no value by more than rounding
NEWTON_STEPS = 4  # an eigenvalue is inexact where the leading coefficient is small
EPS = np.finfo(float).eps


def violation(motion: JointTrajectory, limits: armctl.Limits) -> str:
    """What the motion violates, or nothing.

    Args:
        motion: The motion.
        limits: The limits of its joints.

    Returns:
        The worst violation of the first quantity that violates its limits, in words.
    """
    h = np.diff(motion.knots)
    lasting = h > 0 if (h > 0).any() else np.arange(len(h)) == 0
    c = np.moveaxis(motion.coefficients[lasting], 1, 2)
    derivatives = [unit_polynomials(c, h[lasting], order) for order in range(4)]
    outside = excess(derivatives[0], limits.q_min, limits.q_max, POSITION_TOLERANCE)
    if outside > POSITION_TOLERANCE:
        return f"position by {outside:g}"
    bounds = (limits.v_max, limits.a_max, limits.j_max)
    for order, bound in enumerate(bounds, start=1):
        one = np.ones(motion.n)
        outside = excess(derivatives[order] / bound[:, None], -one, one, RATIO_TOLERANCE)
        if outside > RATIO_TOLERANCE:
            return f"derivative {order} by a factor of 1 + {outside:g}"
    rounding = [8 * EPS * np.abs(p).sum(axis=2).max(axis=0) for p in derivatives[:3]]
    return too_different(motion, bounds, rounding) or jumps(motion)


def unit_polynomials(c: np.ndarray, h: np.ndarray, order: int) -> np.ndarray:
    """A derivative of polynomials in time, as polynomials in the share of their piece.

    Args:
        c: (m, n, d + 1) coefficients, constant first.
        h: (m,) s, the lengths of the pieces.
        order: Which derivative.

    Returns:
        (m, n, d + 1 - order) coefficients, constant first.
    """
    factors = [np.prod(np.arange(i - order + 1, i + 1)) for i in range(order, c.shape[2])]
    return c[:, :, order:] * factors * h[:, None, None] ** np.arange(c.shape[2] - order)


def excess(p: np.ndarray, low: np.ndarray, high: np.ndarray, tolerance: float) -> float:
    """How far polynomials leave their bounds on [0, 1]; at most the tolerance where none leaves them by more.

    Args:
        p: (m, n, d + 1) coefficients, constant first.
        low: (n,).
        high: (n,).
        tolerance: By which they may leave their bounds.

    Returns:
        The distance, of the units of p.
    """
    degree = p.shape[2] - 1
    bernstein = p @ np.array([[comb(j, i) / comb(degree, i) for j in range(degree + 1)] for i in range(degree + 1)])
    if not np.isfinite(bernstein).all():
        return np.inf
    hull = np.maximum(bernstein.max(axis=2) - high, low - bernstein.min(axis=2))
    piece, joint = np.nonzero(hull > tolerance)
    if not len(piece):
        return float(hull.max())
    found = extremes(p[piece, joint])
    return float(np.maximum(found.max(axis=1) - high[joint], low[joint] - found.min(axis=1)).max())


def extremes(p: np.ndarray) -> np.ndarray:
    """The values of polynomials (K, d + 1) at both ends of [0, 1] and at their turning points between them, (K, 2 d)."""
    slope = p[:, 1:] * np.arange(1, p.shape[1])
    bend = slope[:, 1:] * np.arange(1, slope.shape[1])
    turns = np.clip(roots(slope), 0.0, 1.0)
    polished = turns
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(NEWTON_STEPS):
            polished = np.clip(np.nan_to_num(polished - values(slope, polished) / values(bend, polished)), 0.0, 1.0)
    return values(p, np.column_stack([np.zeros(len(p)), np.ones(len(p)), turns, polished]))


def values(p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Polynomials (K, d + 1), constant first, at points (K, k)."""
    total = np.zeros_like(x)
    for k in range(p.shape[1] - 1, -1, -1):
        total = total * x + p[:, k : k + 1]
    return total


def roots(p: np.ndarray) -> np.ndarray:
    """The real parts of the roots of polynomials (K, d + 1), constant first, (K, d); 0 for a root that is not there."""
    found = np.zeros((len(p), p.shape[1] - 1))
    largest = np.abs(p).max(axis=1, initial=0.0)
    matters = np.abs(p) > NEGLIGIBLE * largest[:, None]
    degrees = np.where(matters.any(axis=1), p.shape[1] - 1 - np.argmax(matters[:, ::-1], axis=1), 0)
    for degree in range(1, p.shape[1]):
        rows = np.flatnonzero(degrees == degree)
        companion = np.zeros((len(rows), degree, degree))
        companion[:, range(1, degree), range(degree - 1)] = 1.0
        companion[:, :, -1] = -p[rows, :degree] / p[rows, degree : degree + 1]
        found[rows, :degree] = np.linalg.eigvals(companion).real
    return found


def too_different(motion: JointTrajectory, bounds: tuple[np.ndarray, ...], rounding: list[np.ndarray]) -> str:
    """Which samples differ by more than the limits allow within their 1 ms, or nothing.

    All samples of a motion of at most 20 s are compared; of a longer one those around its knots, and others spread evenly.
    """
    count = int(np.ceil(motion.duration / SAMPLE_INTERVAL_S))
    if count <= MAX_SAMPLES:
        samples = motion.sample(SAMPLE_INTERVAL_S * np.arange(count))[:3]
        differences = [np.abs(np.diff(x, axis=0)) for x in samples]
    else:
        at_knots = np.floor(motion.knots[:, None] / SAMPLE_INTERVAL_S) + np.arange(-2, 2)
        spread = np.linspace(0, count - 2, MAX_SAMPLES // 10).astype(int)
        first = np.unique(np.clip(np.concatenate([at_knots.ravel(), spread]), 0, count - 2))
        before = motion.sample(SAMPLE_INTERVAL_S * first)
        after = motion.sample(SAMPLE_INTERVAL_S * (first + 1))
        differences = [np.abs(b - a) for a, b in zip(before[:3], after[:3], strict=True)]
    for order, (step, bound, error) in enumerate(zip(differences, bounds, rounding, strict=True), start=1):
        if (step > (1 + DIFFERENCE_TOLERANCE) * SAMPLE_INTERVAL_S * bound + error).any():
            return f"derivative {order} by differences"
    return ""


def jumps(motion: JointTrajectory) -> str:
    """Where the position jumps at a knot by more than rounding, or nothing."""
    h = np.diff(motion.knots)
    ends = np.einsum("mp,mpn->mn", h[:, None] ** np.arange(6), motion.coefficients)
    size = np.maximum(1.0, np.abs(motion.coefficients[:, 0]).max())
    jump = np.abs(ends[:-1] - motion.coefficients[1:, 0]).max() if len(h) > 1 else 0.0
    return f"position jumps by {jump:g}" if jump > 1e-12 * size else ""
