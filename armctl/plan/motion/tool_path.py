"""Tool paths: hundreds of points that the tip passes, each with the freedom of a region."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, PlanError
from armctl.core.pose import Pose, computed_pose
from armctl.core.region import Region, RegionPart, cone_parts, frames_along, read_surface
from armctl.core.units import length_text
from armctl.core.validation import Array, IntArray, array, choice, shown
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.plan.motion.checks import planning_arm
from armctl.plan.motion.path.joint_path import SPLINE_DEGREE, JointPath
from armctl.plan.motion.path.path_segments import Turn
from armctl.plan.motion.path.region_path import RegionPath, joint_path_through, nominal_poses, region_path
from armctl.plan.motion.timed_along import FINE, timed_along
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import is_inside
from armctl.plan.motion.trajectory.piecewise import standing

ToolPoints = Any  # Region | Sequence[Pose] | ArrayLike: the type ArrayLike includes Sequence
_MAX_POINTS = 20_000
_MAX_GAP_M = 0.01  # between two points: farther ones are joined by a line
_MAX_GAP_RAD = 0.05
_GROWTH = 4  # so many times more points are joined, as long as the tip strays between them
_FINEST = 16  # times the points, at most
_STRAY_SHARE = 0.05  # of the way between two points, that the tip may be beside it
_STRAY_M = 1e-4  # that it may be in any case
_LIMIT_ROOM = 1e-4  # of the range of a joint
_CROSSING = 0.75  # of the spacing: two parts of a path that cross at right angles have points nearer than 0.71 of it
_CUBIC = 3  # the degree of a spline through a few points
_APART = 10  # points, between two that may be near each other


def tool_path(
    arm: Arm,
    q_start: ArrayLike | None,
    path: ToolPoints,
    normals: ArrayLike | None,
    free: str | None,
    cone: float,
    options: Mapping[str, Any],
) -> JointTrajectory:
    """The motion of `move_path` along points with the freedom of a region; the options are its own."""
    check_one_tip(arm)
    planning = planning_arm(arm, options.get("speed", 1.0))
    parts = read_tool_path(path, normals, free, cone)
    _require_no_crossing(parts)
    start = None if q_start is None else arm.checked("q_start", q_start)
    regions, q = _through(arm, parts, start)
    motion = _motion(arm, planning, regions, q, options)
    if is_inside(motion.pieces, arm.limits):
        return motion
    # Between points the spline leaves a limit at which many of them are: there is room beside narrower limits.
    room = _LIMIT_ROOM * (arm.limits.q_max - arm.limits.q_min)
    room = np.where(np.isfinite(room), room, 0.0)
    narrow = arm.with_limits(replace(arm.limits, q_min=arm.limits.q_min + room, q_max=arm.limits.q_max - room))
    start = None if start is None else narrow.limits.clamp(start)
    regions, q = _through(narrow, parts, start)
    motion = _motion(arm, planning, regions, q, options)
    if is_inside(motion.pieces, arm.limits):
        return motion
    raise PlanError(f"path: {motion.check_limits().violations[0]}; start in another configuration, or widen the cone")


def _through(arm: Arm, parts: list[RegionPart], start: Array | None) -> tuple[RegionPath, Array]:
    """The regions, and the configurations (N, n) of a joint path through them on which the tip stays on its way."""
    factor = 1
    while True:
        regions = region_path(*_dense(parts, factor))
        q = joint_path_through(arm, regions, start)
        strays = _strays(arm, regions.lengths, q)
        if not strays.any():
            return regions, q
        factor *= _GROWTH
        if factor > _FINEST or _GROWTH * len(q) > _MAX_POINTS:
            break
    worst = int(strays.argmax())
    x, y, z = arm.fk(q[worst]).position
    raise PlanError(
        f"point {regions.given[worst]} of {len(parts)}, at [{x:.3f}, {y:.3f}, {z:.3f}] m: the joints then move so fast that "
        f"the tip would be {length_text(float(strays[worst]))} beside its way; widen the cone, give more points, or "
        "divide the path"
    )


def _strays(arm: Arm, lengths: Array, q: Array) -> Array:
    """(N - 1,) m, how far the tip is beside its way in the middle between two points; 0 where it is near enough.

    Its way is the spline through the points that is made as that of the joints, and has the same waves at a corner.
    """
    if len(q) < 2:
        return np.zeros(0)
    middles = 0.5 * (lengths[1:] + lengths[:-1])
    at = arm.fk_many(q)[0]
    joints = np.asarray(_joint_path(lengths, q).spline(middles))  # type: ignore[operator]
    expected = np.asarray(_joint_path(lengths, at).spline(middles))  # type: ignore[operator]
    beside = np.linalg.norm(arm.fk_many(joints)[0] - expected, axis=1)
    near = np.maximum(_STRAY_SHARE * np.linalg.norm(np.diff(at, axis=0), axis=1), _STRAY_M)
    return np.where(beside > near, beside, 0.0)


def _motion(arm: Arm, planning: Arm, regions: RegionPath, q: Array, options: Mapping[str, Any]) -> JointTrajectory:
    if len(q) == 1:
        return JointTrajectory(*standing(q[0]), arm.joint_names, arm.limits, units=arm.units)
    return timed_along(arm, planning.limits, _joint_path(regions.lengths, q), options, fineness=FINE).motion


def _dense(parts: list[RegionPart], factor: int) -> tuple[list[RegionPart], IntArray]:
    """The regions, with others on lines between those that are far apart, and the numbers of the given ones before each.

    With a factor above 1 there are so many times more between two points.
    """
    rows = nominal_poses(parts)
    moved = np.linalg.norm(np.diff(rows[:, 3], axis=0), axis=1)
    turned = np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=(1, 2)) / math.sqrt(2.0)
    pieces = np.maximum(1, np.ceil(np.maximum(moved / _MAX_GAP_M, turned / _MAX_GAP_RAD))).astype(np.int64)
    pieces = np.where(moved + turned > 0.0, factor * pieces, pieces)
    if pieces.sum() > _MAX_POINTS:
        raise InputError(f"path: {len(parts)} points are {moved.sum():.3g} m long; at most {_MAX_POINTS * _MAX_GAP_M:g} m")
    dense: list[RegionPart] = []
    given: list[int] = []
    for k, count in enumerate(pieces.tolist()):
        dense.append(parts[k])
        given += [k] * count
        if count == 1:
            continue
        begin = parts[k].frame
        end = parts[k + 1].frame
        turn = Turn.between(begin.rotation, end.rotation)
        for j in range(1, count):
            position = begin.position + (j / count) * (end.position - begin.position)
            dense.append(replace(parts[k], frame=computed_pose(position, turn.at(j / count))))
    return [*dense, parts[-1]], np.array([*given, len(parts) - 1])


def read_tool_path(path: ToolPoints, normals: ArrayLike | None, free: str | None, cone: float) -> list[RegionPart]:
    """The regions of a tool path, one for each point: poses, points with normals, or the parts of a region."""
    if isinstance(path, Region):
        if normals is not None or free is not None or cone:
            raise InputError("free: the parts of a region have their own freedom; leave normals, free and cone out")
        parts = list(path.parts)
    elif normals is not None:
        axis = choice("free", "z" if free is None else free, "xyz")
        points, directions = read_surface(array("path", path, 2), normals)
        frames = frames_along(-directions, axis)
        parts = cone_parts([computed_pose(p, R) for p, R in zip(points, frames, strict=True)], axis, cone)
    else:
        poses = list(path) if isinstance(path, Iterable) and not isinstance(path, str) else []
        for pose in poses:
            if not isinstance(pose, Pose):
                raise InputError(f"path: {shown(pose)} is not a Pose; points need `normals`, the directions out of the surface")
        parts = cone_parts(poses, free, cone)
    if not parts:
        raise InputError("path: it is empty; give at least one pose, or points with normals")
    if len(parts) > _MAX_POINTS:
        raise InputError(f"path: {len(parts)} points, at most {_MAX_POINTS}; take fewer, or divide it")
    return parts


def _require_no_crossing(parts: list[RegionPart]) -> None:
    """Refuses a path that comes back to a point on it, except at its ends. Raises InputError."""
    from scipy.spatial import KDTree

    points = nominal_poses(parts)[:, 3]
    if len(points) < 2 * _APART:
        return
    spacing = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    if spacing == 0.0:
        return
    pairs = KDTree(points).query_pairs(_CROSSING * spacing, output_type="ndarray")
    last = len(points) - 1
    for i, j in pairs.tolist():
        low = min(i, j)
        high = max(i, j)
        is_closed = low < _APART and high > last - _APART  # it ends where it begins
        between = points[low : high + 1] - points[low]
        has_left = float(np.linalg.norm(between, axis=1).max()) > 2 * spacing
        if high - low > _APART and has_left and not is_closed:
            x, y, z = points[low]
            raise InputError(
                f"path: it crosses itself at [{x:.3f}, {y:.3f}, {z:.3f}] m, points {low} and {high}; divide it into two paths"
            )


def _joint_path(lengths: Array, q: Array) -> JointPath:
    if len(q) > SPLINE_DEGREE:
        return JointPath.through(lengths, q)
    if len(q) > _CUBIC:
        return JointPath.through(lengths, q, _CUBIC)
    shares = np.linspace(0.0, lengths[-1], 13)  # a straight way has points for a spline
    return JointPath.through(shares, np.column_stack([np.interp(shares, lengths, column) for column in q.T]))
