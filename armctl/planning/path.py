"""Collision-free paths of straight lines in joint space, each of them proved over its whole length.

RRT-Connect: J. J. Kuffner, S. M. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000; with
the dynamic domain of A. Yershova et al., "Dynamic-domain RRTs", ICRA 2005. Shortcuts: R. Geraerts, M. H. Overmars, "Creating
high-quality paths for motion planning", IJRR 26 (2007). Samples are counted and seeded; no clock decides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armctl.collision.interface import KeptAxis
from armctl.core.validation import Array, IntArray

if TYPE_CHECKING:
    from armctl.collision.checker import CollisionChecker

_FROM_START = 0
_FROM_GOALS = 1
_SAMPLES_PER_CALL = 256  # between two calls of the kernel the program can be interrupted
_SHORTCUTS = 100


class FreePath(NamedTuple):
    """A path.

    Attributes:
        points: (k, n) rad; every line between neighbors is proved free.
        samples: How many random configurations it took.
    """

    points: Array
    samples: int


class _Trees(NamedTuple):
    """Configurations joined by proved lines, roots first: the tree of the start and that of the goals.

    Attributes:
        nodes: (2, capacity, n) rad.
        parents: (2, capacity), -1 for a root.
        domains: (2, capacity) rad, from how far each node takes samples.
        sizes: (2,).
    """

    nodes: Array
    parents: IntArray
    domains: Array
    sizes: IntArray

    @classmethod
    def rooted(cls, start: Array, goals: Array, capacity: int) -> _Trees:
        """The trees of a start and of goals."""
        nodes = np.empty((2, len(goals) + capacity, len(start)))
        nodes[_FROM_START, 0] = start
        nodes[_FROM_GOALS, : len(goals)] = goals
        return cls(
            nodes=nodes,
            parents=np.full(nodes.shape[:2], -1),
            domains=np.full(nodes.shape[:2], np.inf),
            sizes=np.array([1, len(goals)]),
        )

    def branch(self, side: int, node: int) -> list[Array]:
        """The configurations from a node to its root."""
        points = []
        while node >= 0:
            points.append(self.nodes[side, node].copy())
            node = int(self.parents[side, node])
        return points


def find_path(
    checker: CollisionChecker,
    start: Array,
    goals: Array,
    low: Array,
    high: Array,
    clearance: float,
    rng: np.random.Generator,
    max_samples: int,
    keep: KeptAxis | None = None,
) -> FreePath | None:
    """A path from a configuration to any of some others.

    Args:
        checker: What may not be touched.
        start: (n,) rad, free.
        goals: (g, n) rad, free.
        low: (n,) rad, from where samples are drawn.
        high: (n,) rad.
        clearance: m that every edge keeps.
        rng: The generator.
        max_samples: After so many it gives up.
        keep: An axis that keeps its direction.

    Returns:
        The path, or None.
    """
    for goal in goals:
        if checker.line_hit(start, goal, clearance, keep) is None:
            return FreePath(np.array([start, goal]), 0)
    from armctl.planning import kernel  # loads numba

    trees = _Trees.rooted(start, goals, 2 * max_samples + 2)
    trial = np.empty(len(start))
    turns = np.empty((len(start), 3))
    rows = (checker.line_rows(keep), checker.scene_rows)
    side = _FROM_START
    taken = 0
    while taken < max_samples:
        samples = rng.uniform(low, high, (min(_SAMPLES_PER_CALL, max_samples - taken), len(start)))
        used, first, second, side = kernel.grow(samples, low, high, side, clearance, *trees, trial, turns, *rows)
        taken += used
        if first >= 0:
            branches = trees.branch(_FROM_START, first)[::-1] + trees.branch(_FROM_GOALS, second)[1:]
            return FreePath(np.array(branches), taken)  # both branches end at the meeting point
    return None


def shorten(
    checker: CollisionChecker, path: Array, clearance: float, rng: np.random.Generator, keep: KeptAxis | None = None
) -> Array:
    """Drops points that a path does not need, then tries random shortcuts.

    Args:
        checker: What may not be touched.
        path: (k, n) rad.
        clearance: m that every line keeps.
        rng: The generator.
        keep: An axis that keeps its direction.

    Returns:
        (l, n) rad, with the same ends.
    """
    from armctl.planning import kernel  # loads numba

    count, joints = path.shape
    points = np.empty((count + _SHORTCUTS + 1, joints))  # a shortcut adds one point at most
    points[:count] = path
    ends = np.empty((2, joints))
    rows = (checker.line_rows(keep), checker.scene_rows)
    count = kernel.drop_needless_points(points, count, clearance, *rows)
    places = rng.uniform(size=(_SHORTCUTS, 2))
    count = kernel.take_shortcuts(points, count, places, ends[0], ends[1], clearance, *rows)
    return points[:count].copy()


def sampling_bounds(q_min: Array, q_max: Array, ends: Array) -> tuple[Array, Array]:
    """Where samples are drawn: the limits, and half a turn around the ends where a joint has wide ones or none.

    Args:
        q_min: (n,) rad.
        q_max: (n,) rad.
        ends: (k, n) rad, start and goals.

    Returns:
        Low and high, each (n,) rad.
    """
    low = np.maximum(q_min, ends.min(axis=0) - np.pi)
    high = np.minimum(q_max, ends.max(axis=0) + np.pi)
    return low, high
