"""The bounds on the speed along a path that can become active, as the compiled solver takes them."""

from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array, BoolArray, IntArray


class TorqueRows(NamedTuple):
    """Bounds of the form low <= alpha b'/2 + beta b + delta sqrt(b) <= high, each (T, r)."""

    alpha: Array  # of the change of the squared path speed
    beta: Array  # of the squared path speed
    delta: Array  # of the path speed
    low: Array  # less than 0
    high: Array  # greater than 0


class PathPoints(NamedTuple):
    """Both ends of each piece, where the speed is bounded."""

    interval: IntArray  # (P,) the interval
    node: IntArray  # (P,) the node
    is_first: BoolArray  # (P,) whether no point before it is at the same node
    value: Array  # (P, 3) the weights of the interval's coefficients in b
    slope: Array  # (P, 3) in b'
    curvature: Array  # (3,) in b''


def points_of(h: float, interval: IntArray, begin: Array, end: Array) -> PathPoints:
    """The points of pieces that lie in intervals (K,) of length h, from one share of their length to another, (K,) each."""
    x = np.column_stack([begin, end]).ravel()
    is_first = np.arange(len(x)) % 2 == 0
    is_first[-1] = True
    return PathPoints(
        interval=np.repeat(interval, 2).astype(np.int64),
        node=(np.arange(len(x)) + 1) // 2,
        is_first=is_first,
        value=np.column_stack([0.5 * (1 - x) * (1 - x), 0.5 + x * (1 - x), 0.5 * x * x]),
        slope=np.column_stack([(x - 1) / h, (1 - 2 * x) / h, x / h]),
        curvature=np.array([1 / (h * h), -2 / (h * h), 1 / (h * h)]),
    )


def speed_bounds(
    points: PathPoints, rows: TorqueRows, derivatives: tuple[Array, Array, Array], b_max: Array, j_max: Array
) -> dict[str, Array | IntArray]:
    """The arguments of the compiled solver, for N nodes.

    `derivatives` are the first and second of the joints at the nodes, (N, n), and the third at the points, (P, n). `b_max`
    (N,) are the greatest squares of the path speed.
    """
    slope = _max_slope(rows, b_max)
    return {
        "interval": points.interval,
        "weights": points.value,
        "b_max": np.where(points.is_first, b_max[points.node], 0.0),
        **_force_bounds(points, rows, b_max, slope),
        **_jerk_bounds(points, derivatives, b_max, slope, j_max),
    }


def _max_slope(rows: TorqueRows, b_max: Array) -> Array:
    """(N,) a bound on |b'| at the nodes, from the row that bounds it most."""
    side = np.abs(0.5 * rows.alpha)
    rest = np.maximum(rows.high, -rows.low) + np.abs(rows.beta) * b_max[:, None] + np.abs(rows.delta) * np.sqrt(b_max)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.fmin.reduce(np.where(side > 0, rest / side, np.inf), axis=1)


def _force_bounds(points: PathPoints, rows: TorqueRows, b_max: Array, max_slope: Array) -> dict[str, Array | IntArray]:
    """The rows that can become active."""
    side = 0.5 * rows.alpha
    others = np.abs(rows.beta) * b_max[:, None] + np.abs(rows.delta) * np.sqrt(b_max)[:, None]
    with np.errstate(invalid="ignore"):
        largest = np.where(side == 0, others, np.abs(side) * max_slope[:, None] + others)
    is_active = ~(largest < np.minimum(rows.high, -rows.low))[points.node] & points.is_first[:, None]
    point, row = np.nonzero(is_active)
    at = (points.node[point], row)
    return {
        "force_end": np.cumsum(is_active.sum(axis=1)),
        "force_weights": side[at][:, None] * points.slope[point] + rows.beta[at][:, None] * points.value[point],
        "damping": rows.delta[at],
        "low": rows.low[at],
        "high": rows.high[at],
    }


def _jerk_bounds(
    points: PathPoints, derivatives: tuple[Array, Array, Array], b_max: Array, max_slope: Array, j_max: Array
) -> dict[str, Array | IntArray]:
    """The joints whose jerk can become active; of the third derivatives (P, n) each point has its own."""
    q1 = derivatives[0][points.node]
    q2 = derivatives[1][points.node]
    q3 = derivatives[2]
    b = b_max[points.node, None]
    most = j_max[points.node]
    side = 0.5 * np.abs(q1)
    with np.errstate(divide="ignore", invalid="ignore"):
        others = np.sqrt(b) * (np.abs(q3) * b + 1.5 * np.abs(q2) * max_slope[points.node, None])
        max_curvature = np.fmin.reduce(np.where(side > 0, (most + others) / side, np.inf), axis=1)  # a bound on |b''| w
        largest = np.where(side == 0, others, side * max_curvature[:, None] + others)
    is_active = ~(largest < most)
    point, joint = np.nonzero(is_active)
    at = (point, joint)
    weights = (
        q3[at][:, None] * points.value[point]
        + (1.5 * q2[at])[:, None] * points.slope[point]
        + (0.5 * q1[at])[:, None] * points.curvature
    )
    return {"jerk_end": np.cumsum(is_active.sum(axis=1)), "jerk_weights": weights, "j_max": most[at]}
