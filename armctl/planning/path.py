"""Collision-free paths of straight lines in joint space, each of them proved over its whole length.

RRT-Connect: J. J. Kuffner, S. M. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000; with
the dynamic domain of A. Yershova et al., "Dynamic-domain RRTs", ICRA 2005. Shortcuts: R. Geraerts, M. H. Overmars, "Creating
high-quality paths for motion planning", IJRR 26 (2007). Samples are counted and seeded; no clock decides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armctl.core.validation import Array, IntArray

if TYPE_CHECKING:
    from armctl.collision.checker import CollisionChecker

STEP = 1.0  # rad (m): the longest edge of a tree
_DOMAIN = 4.0  # rad: a node whose extension failed takes samples from this distance only
_MIN_DOMAIN = 1.0  # rad; smaller domains starve a tree of few nodes
_DOMAIN_RATE = 1e-4  # by which a domain shrinks with each failure and grows with each success
_SHORTCUTS = 100
_IDLE_SHORTCUTS = 25  # in a row without a gain: then it stops
_MIN_GAIN = 1e-3  # of the path's length: less is no gain
_SAME = 1e-10  # rad


class FreePath(NamedTuple):
    """A path.

    Attributes:
        points: (k, n) rad; every line between neighbors is proved free.
        samples: How many random configurations it took.
    """

    points: Array
    samples: int


class _Tree:
    """Configurations joined by proved lines, with the roots first."""

    def __init__(self, roots: Array, capacity: int):
        count = len(roots)
        self.q = np.empty((count + capacity, roots.shape[1]))
        self.q[:count] = roots
        self.parent: IntArray = np.full(count + capacity, -1)
        self.domain = np.full(count + capacity, np.inf)
        self.size = count

    def add(self, q: Array, parent: int) -> int:
        self.q[self.size] = q
        self.parent[self.size] = parent
        self.size += 1
        return self.size - 1

    def nearest(self, q: Array) -> tuple[int, float]:
        """The nearest node and its distance, rad."""
        offset = self.q[: self.size] - q
        squares = np.einsum("ij,ij->i", offset, offset)
        best = int(squares.argmin())
        return best, float(np.sqrt(squares[best]))

    def branch(self, node: int) -> list[Array]:
        """The configurations from a node to its root."""
        points = []
        while node >= 0:
            points.append(self.q[node].copy())
            node = int(self.parent[node])
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

    Returns:
        The path, or None.
    """
    for goal in goals:
        if checker.line_hit(start, goal, clearance) is None:
            return FreePath(np.array([start, goal]), 0)
    capacity = 2 * max_samples + 2
    growing = _Tree(start[None], capacity)
    other = _Tree(goals, capacity)
    begins_at_start = True
    for sample in range(1, max_samples + 1):
        if growing.size > other.size:
            growing, other = other, growing
            begins_at_start = not begins_at_start
        added = _extend(checker, growing, rng.uniform(low, high), clearance)
        if added < 0:
            continue
        met = _connect(checker, other, growing.q[added], clearance)
        if met >= 0:
            first = growing.branch(added)[::-1]
            second = other.branch(met)
            points = first + second[1:]  # both branches end at the meeting point
            return FreePath(np.array(points if begins_at_start else points[::-1]), sample)
        growing, other = other, growing
        begins_at_start = not begins_at_start
    return None


def _extend(checker: CollisionChecker, tree: _Tree, sample: Array, clearance: float) -> int:
    """Grows a tree by one edge towards a sample; -1 if the edge is not free."""
    near, distance = tree.nearest(sample)
    if distance > tree.domain[near] or distance < _SAME:
        return -1
    q = tree.q[near] + min(1.0, STEP / distance) * (sample - tree.q[near])
    domain = tree.domain[near]
    if not _is_free_edge(checker, tree.q[near], q, clearance):
        tree.domain[near] = _DOMAIN if np.isinf(domain) else max(_MIN_DOMAIN, domain * (1.0 - _DOMAIN_RATE))
        return -1
    tree.domain[near] = domain * (1.0 + _DOMAIN_RATE)
    return tree.add(q, near)


def _connect(checker: CollisionChecker, tree: _Tree, q: Array, clearance: float) -> int:
    """Grows a tree in steps until it meets a configuration; the node there, or -1 if something is in the way."""
    node, distance = tree.nearest(q)
    origin = tree.q[node].copy()
    steps = max(1, int(np.ceil(distance / STEP)))
    for step in range(1, steps + 1):
        reached = q if step == steps else origin + (step / steps) * (q - origin)
        if tree.size == len(tree.q) or not _is_free_edge(checker, tree.q[node], reached, clearance):
            return -1
        node = tree.add(reached, node)
    return node


def _is_free_edge(checker: CollisionChecker, start: Array, end: Array, clearance: float) -> bool:
    """The end point is checked first: it decides most edges at a hundredth of the cost."""
    return checker.hit(end, clearance) < 0 and checker.line_hit(start, end, clearance) is None


def shorten(checker: CollisionChecker, path: Array, clearance: float, rng: np.random.Generator) -> Array:
    """Drops points that a path does not need, then tries random shortcuts.

    Args:
        checker: What may not be touched.
        path: (k, n) rad.
        clearance: m that every line keeps.
        rng: The generator.

    Returns:
        (l, n) rad, with the same ends.
    """
    points = _without_needless_points(checker, list(path), clearance)
    idle = 0
    for _ in range(_SHORTCUTS):
        if len(points) < 3 or idle > _IDLE_SHORTCUTS:
            break
        shortcut = _shortcut(checker, points, np.sort(rng.uniform(size=2)), clearance)
        if shortcut is None:
            idle += 1
        else:
            idle = 0
            points = shortcut
    return np.array(points)


def _without_needless_points(checker: CollisionChecker, points: list[Array], clearance: float) -> list[Array]:
    """From each point straight to the farthest one that can be reached."""
    kept = [points[0]]
    at = 0
    while at < len(points) - 1:
        reachable = (
            k for k in range(len(points) - 1, at + 1, -1) if checker.line_hit(points[at], points[k], clearance) is None
        )
        at = next(reachable, at + 1)
        kept.append(points[at])
    return kept


def _shortcut(checker: CollisionChecker, points: list[Array], ends: Array, clearance: float) -> list[Array] | None:
    """A path that goes straight between two places, given as shares of the length; None if it is not shorter or not free."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    marks = np.concatenate([[0.0], np.cumsum(lengths)])
    places = ends * marks[-1]
    first, last = np.clip(np.searchsorted(marks, places, side="right") - 1, 0, len(lengths) - 1)
    if first == last:
        return None
    shares = (places - marks[[first, last]]) / lengths[[first, last]]
    begin = points[first] + shares[0] * (points[first + 1] - points[first])
    end = points[last] + shares[1] * (points[last + 1] - points[last])
    gain = places[1] - places[0] - float(np.linalg.norm(end - begin))
    if gain < _MIN_GAIN * marks[-1] or checker.line_hit(begin, end, clearance) is not None:
        return None
    joined = [*points[: first + 1], begin, end, *points[last + 1 :]]
    k = max(first - 1, 0)
    while k < min(first + 4, len(joined) - 2):
        if checker.line_hit(joined[k], joined[k + 2], clearance) is None:
            del joined[k + 1]
        else:
            k += 1
    return joined


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
