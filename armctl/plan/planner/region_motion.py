"""The smooth motion along a path whose tip stays in a region, which may be thin: a plane, an arc.

Random shortcuts lead along the region in steps, each brought back into it. Then the path is smoothed: each of its dense points
goes to the mean of its neighbors and back into the region, as an elastic band (S. Quinlan, O. Khatib, "Elastic bands:
connecting path planning and control", ICRA 1993). A spline through them is timed, and the motion is proved like any other.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from armctl._core import RrtConnect
from armctl.core.errors import PlanError
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.path.joint_path import JointPath
from armctl.plan.motion.timed_along import FINE, timed_along
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.free_space import FreeSpace

_SPACING_SHARE = 0.5  # of the longest line in the region: dense points are so far apart
_MAX_SPACING = 0.05  # rad (m)
_MIN_LINES = 12  # between dense points
_SHORTCUTS = 60
_MIN_GAIN = 0.01  # of the length of a path: less is no gain
_SMOOTHINGS = (64, 32, 16, 8, 4, 2, 1, 0)  # how often each point goes to the mean of its neighbors, tried in turn


def motion_in_region(space: FreeSpace, arm: Arm, points: Array, rng: np.random.Generator) -> JointTrajectory | None:
    """A smooth motion along a path (k, n) of proved lines that is proved free and in the region; None if there is none."""
    limits = arm.limits
    ends = (points[0], np.ascontiguousarray(points[-1:]))
    walker = RrtConnect(space.checker.proof(space.keep), space.clearance, *ends, limits.q_min, limits.q_max, len(points) + 2)
    spacing = min(_SPACING_SHARE * walker.step, _MAX_SPACING)
    q = _shortened(walker, _dense(points, spacing), spacing, rng)
    for rounds in _SMOOTHINGS:
        smooth = _smoothed(walker, q, rounds)
        if smooth is None or not _is_free(space, smooth):
            continue
        motion = _timed(arm, smooth)
        if motion is not None and space.motion_hit(motion) is None:
            return motion
    return None


def _dense(points: Array, spacing: float) -> Array:
    """The same path with points that are evenly spaced on each of its lines."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    spacing = min(spacing, float(lengths.sum()) / _MIN_LINES)
    rows = [points[:1]]
    for start, end, length in zip(points[:-1], points[1:], lengths.tolist(), strict=True):
        if length > 0.0:
            count = max(1, math.ceil(length / spacing))
            rows.append(start + np.linspace(0.0, 1.0, count + 1)[1:, None] * (end - start))
    return np.vstack(rows)


def _shortened(walker: RrtConnect, q: Array, spacing: float, rng: np.random.Generator) -> Array:
    """The path with random shortcuts along the region."""
    for shares in np.sort(rng.uniform(size=(_SHORTCUTS, 2))):
        lengths = np.append(0.0, np.linalg.norm(np.diff(q, axis=0), axis=1).cumsum())
        first, last = np.searchsorted(lengths, shares * lengths[-1]).tolist()
        before = float(lengths[last] - lengths[first])
        if before - math.dist(q[last], q[first]) < _MIN_GAIN * lengths[-1]:
            continue
        way = walker.way(np.ascontiguousarray(q[first]), np.ascontiguousarray(q[last]))
        if not way:
            continue
        between = np.array(way)
        gain = before - float(np.linalg.norm(np.diff(between, axis=0), axis=1).sum())
        if gain > _MIN_GAIN * lengths[-1]:
            q = _dense(np.vstack([q[:first], between, q[last + 1 :]]), spacing)
    return q


def _smoothed(walker: RrtConnect, q: Array, rounds: int) -> Array | None:
    """The path (k, n) after some rounds of smoothing within the region; None if it gets stuck outside."""
    smooth = q.copy()
    for _ in range(rounds):
        inner = np.ascontiguousarray(0.25 * (smooth[:-2] + 2.0 * smooth[1:-1] + smooth[2:]))
        if not walker.project(inner):
            return None
        smooth[1:-1] = inner
    return smooth


def _is_free(space: FreeSpace, q: Array) -> bool:
    return all(space.line_is_free(start, end) for start, end in pairwise(q))


def _timed(arm: Arm, q: Array) -> JointTrajectory | None:
    """The fastest motion along a spline through dense points; None if the limits leave none."""
    lengths = np.append(0.0, np.linalg.norm(np.diff(q, axis=0), axis=1).cumsum())
    try:
        motion = timed_along(arm, arm.limits, JointPath.through(lengths, q), {}, fineness=FINE).motion
    except PlanError:  # a motor cannot hold the arm on the way
        return None
    return motion if motion.check_limits().ok else None
