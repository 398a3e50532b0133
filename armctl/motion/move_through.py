"""move_through: one motion through many joint positions, without stopping at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.collision.interface import MovingJoints
from armctl.core.errors import InputError, PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array, matrix, vector
from armctl.motion.checks import planning_arm
from armctl.motion.move_j import move_j
from armctl.motion.sections import Via, is_limited, pause, within_sections
from armctl.motion.timing.otg import slowed_to_bounds
from armctl.motion.timing.waypoint_timing import Candidate, WaypointSearch
from armctl.motion.torque_limits import slowed_relative_to, within_torque
from armctl.motion.trajectory.joint_trajectory import JointTrajectory, joined
from armctl.motion.trajectory.limit_check import is_inside
from armctl.motion.trajectory.piecewise import standing
from armctl.robot.arm import Arm

_SAME_DURATION = 1e-9  # relative
_SAME_WAYPOINT = 1e-9  # rad (m); closer waypoints count as one
_TOO_CLOSE = "move_through: rounding takes every motion through these waypoints outside the limits; place them farther apart"


def move_through(arm: Arm, waypoints: ArrayLike | Sequence[Via | ArrayLike], *, speed: float = 1.0) -> JointTrajectory:
    """The motion through every waypoint without stopping, at rest at the first and the last.

    Between waypoints each joint moves independently, jerk-limited and inside its position limits; the velocities and
    accelerations at the waypoints are optimized. If a motor would saturate, the motion is slower on the
    same path, and `slowed` contains the factor. It is never slower than `move_j` from waypoint to waypoint.

    Args:
        waypoints: (k, n) rad, at least two, each inside the limits; the first is the start. A `Via` instead of a row
            also contains speed, acceleration and payload of the section that ends at it, and a pause.
        speed: Fraction of the full speed, in (0, 1]; 0.5 takes twice as long.

    Raises:
        InputError: A wrong shape, a number that is not finite, or an arm without finite limits.
        LimitError: A position outside the limits.
        PlanError: A motor cannot hold the arm at some point of the path.
    """
    planning = planning_arm(arm, speed)
    vias = _vias(arm, waypoints)
    motions: list[JointTrajectory] = []
    begin = 0
    for k in range(1, len(vias)):
        if vias[k].dwell or k == len(vias) - 1:
            motions.append(_flowing(arm, planning.limits, vias[begin : k + 1], speed))
            if vias[k].dwell:
                motions.append(pause(arm, np.asarray(vias[k].q), vias[k].dwell))
            begin = k
    return joined(motions)


def _vias(arm: Arm, waypoints: ArrayLike | Sequence[Via | ArrayLike]) -> list[Via]:
    items: list[Any] = list(waypoints) if isinstance(waypoints, (list, tuple)) else []
    if any(isinstance(each, Via) for each in items):
        vias = [each if isinstance(each, Via) else Via(each) for each in items]
        rows = [vector(f"waypoints[{i}]", via.q, arm.n) for i, via in enumerate(vias)]
    else:
        rows = list(matrix("waypoints", waypoints, arm.n))  # type: ignore[arg-type]
        vias = [Via(row) for row in rows]
    if len(rows) < 2:
        raise InputError(f"waypoints: expected at least 2, got {len(rows)}; the first one is the start of the motion")
    return [replace(via, q=arm.checked(f"waypoints[{i}]", row)) for i, (via, row) in enumerate(zip(vias, rows, strict=True))]


def _flowing(arm: Arm, limits: Limits, vias: Sequence[Via], speed: float) -> JointTrajectory:
    """The motion through waypoints from rest to rest."""
    points = np.array([via.q for via in vias])
    apart = np.abs(np.diff(points, axis=0)).max(axis=1) > _SAME_WAYPOINT
    points = points[np.concatenate([[True], apart])]
    sections = [section for section, is_apart in zip(vias[1:], apart, strict=True) if is_apart]
    if len(points) == 1:
        return JointTrajectory(*standing(points[0]), arm.joint_names, arm.limits, units=arm.units)
    search = WaypointSearch(points, limits)
    stopping = search.stopping()
    candidate = search.fastest(stopping)
    free = _timed(arm, limits, search, candidate)
    if free is None:
        candidate = stopping
        free = _timed(arm, limits, search, stopping)
    if free is None:
        raise PlanError(_TOO_CLOSE)
    if any(map(is_limited, sections)):
        ends = np.cumsum(candidate.durations)
        return within_sections(arm, free, ends * (free.duration / ends[-1]), sections)
    try:
        motion = within_torque(arm, free)
    except PlanError:
        return slowed_relative_to(arm, _stopping_at_each(arm, points, speed), free)
    if motion.duration > (1 + _SAME_DURATION) * stopping.durations.sum():
        # Torque limits can slow the flowing motion down more than one that stops.
        motion = min(motion, _stopping_at_each(arm, points, speed), key=lambda each: each.duration)
    return motion if motion is free else slowed_relative_to(arm, motion, free)


def _stopping_at_each(arm: Arm, points: Array, speed: float) -> JointTrajectory:
    """Straight moves from waypoint to waypoint, within the torque limits."""
    return joined([move_j(arm, start, goal, speed=speed) for start, goal in pairwise(points)])


def through_waypoints(arm: MovingJoints, points: Array) -> JointTrajectory:
    """As `move_through` without the torque limits, for checked points that differ from their neighbors."""
    search = WaypointSearch(points, arm.limits)
    stopping = search.stopping()
    motion = _timed(arm, arm.limits, search, search.fastest(stopping)) or _timed(arm, arm.limits, search, stopping)
    if motion is None:
        raise PlanError(_TOO_CLOSE)
    return motion


def _timed(arm: MovingJoints, limits: Limits, search: WaypointSearch, candidate: Candidate) -> JointTrajectory | None:
    """The motion of a candidate within all limits but those of the torque; None if rounding takes it out of them."""
    try:
        pieces = search.pieces(candidate)
    except PlanError:
        return None
    pieces = slowed_to_bounds(pieces, (limits.v_max, limits.a_max, limits.j_max))
    if not is_inside(pieces, limits):
        return None
    return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)
