"""Collision-free paths of straight lines in joint space, each of them proved over its whole length.

RRT-Connect: J. J. Kuffner, S. M. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000; with
the dynamic domain of A. Yershova et al., "Dynamic-domain RRTs", ICRA 2005. Shortcuts: R. Geraerts, M. H. Overmars, "Creating
high-quality paths for motion planning", IJRR 26 (2007). Samples are counted and seeded; no clock decides.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from armctl._core import Hit, RrtConnect
from armctl.collision.checker import CollisionChecker
from armctl.collision.clearance import PiecewiseTrajectory
from armctl.collision.interface import KeptAxis
from armctl.core.limits import Limits
from armctl.core.validation import Array

CLEARANCE_M = 2e-3
MAX_SAMPLES = 20_000
_SAMPLES_PER_CALL = 256  # between two calls of the core the program can be interrupted
_SHORTCUTS = 100
_MIN_GAIN = 1e-3  # of the path's length: less is no gain
_MAX_IDLE_SHORTCUTS = 25  # in a row without a gain


class FreeSpace(NamedTuple):
    """What a motion must keep, and the checker that proves it."""

    checker: CollisionChecker  # what may not be touched
    clearance: float = CLEARANCE_M  # m, from everything
    keep: KeptAxis | None = None  # an axis of the tip that keeps its direction

    def line_is_free(self, start: Array, end: Array) -> bool:
        """Whether a straight line between two configurations is proved."""
        return self.checker.line_hit(start, end, self.clearance, self.keep) is None

    def motion_hit(self, motion: PiecewiseTrajectory) -> Hit | None:
        """Where a motion is not known to keep it; None if it is proved."""
        return self.checker.motion_hit(motion.knots, motion.coefficients, self.clearance, self.keep)


class FreePath(NamedTuple):
    """A path."""

    points: Array  # (k, n) rad; every line between neighbors is proved free
    samples: int  # how many random configurations it took


def find_path(space: FreeSpace, start: Array, goals: Array, limits: Limits, rng: np.random.Generator) -> FreePath | None:
    """A path from a configuration (n,) to any of some others (g, n), all of them free; None after `MAX_SAMPLES` samples."""
    for goal in goals:
        if space.line_is_free(start, goal):
            return FreePath(np.array([start, goal]), 0)
    low, high = _sampling_bounds(limits, np.vstack([start, goals]))
    capacity = len(goals) + 2 * MAX_SAMPLES + 2
    trees = RrtConnect(space.checker.proof(space.keep), space.clearance, start, goals, low, high, capacity)
    taken = 0
    while taken < MAX_SAMPLES:
        samples = rng.uniform(low, high, (min(_SAMPLES_PER_CALL, MAX_SAMPLES - taken), len(start)))
        taken += trees.grow(samples)
        path = trees.path()
        if path:
            return FreePath(np.array(path), taken)
    return None


def shorten(space: FreeSpace, path: Array, rng: np.random.Generator) -> Array:
    """The path (k, n) without the points that it does not need, and with random shortcuts: (l, n) with the same ends."""
    points = list(path)
    for point in itertools.count():
        if point + 2 >= len(points):
            break
        farthest = len(points) - 1
        while farthest > point + 1 and not space.line_is_free(points[point], points[farthest]):
            farthest -= 1
        del points[point + 1 : farthest]
    idle = 0
    for shares in np.sort(rng.uniform(size=(_SHORTCUTS, 2))):
        if len(points) < 3 or idle > _MAX_IDLE_SHORTCUTS:
            break
        idle = 0 if _take_shortcut(space, points, shares) else idle + 1
    return np.array(points)


def _take_shortcut(space: FreeSpace, points: list[Array], shares: Array) -> bool:
    """Goes straight between two places on a path, given by their shares of its length; returns whether it can."""
    lengths = [_distance(a, b) for a, b in itertools.pairwise(points)]
    total = sum(lengths)
    low, high = (shares * total).tolist()
    first, begin = _place_on(points, lengths, low)
    last, end = _place_on(points, lengths, high)
    gain = high - low - _distance(begin, end)
    if first == last or gain < _MIN_GAIN * total or not space.line_is_free(begin, end):
        return False
    points[first + 1 : last + 1] = [begin, end]
    point = max(first - 1, 0)
    while point < first + 4 and point + 2 < len(points):
        if space.line_is_free(points[point], points[point + 2]):
            del points[point + 1]
        else:
            point += 1
    return True


def _place_on(points: list[Array], lengths: list[float], distance: float) -> tuple[int, Array]:
    """The number of the line of a path at a distance from its start, and the configuration there."""
    line = 0
    passed = 0.0
    while line + 2 < len(points) and passed + lengths[line] <= distance:
        passed += lengths[line]
        line += 1
    share = (distance - passed) / lengths[line] if lengths[line] > 0.0 else 0.0
    return line, points[line] + share * (points[line + 1] - points[line])


def _distance(first: Array, second: Array) -> float:
    """rad; not by BLAS, whose last bits depend on the machine."""
    return math.sqrt(sum(((second - first) ** 2).tolist()))


def _sampling_bounds(limits: Limits, ends: Array) -> tuple[Array, Array]:
    """Where samples are drawn: the limits, and half a turn around the ends (k, n) where a joint has wide ones or none."""
    low = np.maximum(limits.q_min, ends.min(axis=0) - np.pi)
    high = np.minimum(limits.q_max, ends.max(axis=0) + np.pi)
    return low, high
