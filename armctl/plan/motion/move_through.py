"""move_through: one motion through many joint positions, without stopping at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array, matrix, vector
from armctl.model.arm.arm import Arm
from armctl.model.collision.moving_joints import MovingJoints
from armctl.plan.motion.checks import planning_arm, read_duration
from armctl.plan.motion.given_duration import SAME_DURATION, lasting
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.sections import Via, is_limited, pause, within_sections
from armctl.plan.motion.timing.end_limits import gentle_in_both_directions, room_to_stop, slowed_into
from armctl.plan.motion.timing.otg import slowed_to_bounds, straight_rest_to_rest
from armctl.plan.motion.timing.waypoint_path import Passage, along_smooth_paths, may_be_smooth, straight_runs
from armctl.plan.motion.timing.waypoint_timing import TimingCandidate, WaypointSearch
from armctl.plan.motion.torque_limits import slowed_relative_to, within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory, joined
from armctl.plan.motion.trajectory.limit_check import is_inside, piece_extremes
from armctl.plan.motion.trajectory.piecewise import standing

_GENTLE_SEARCHES = 2  # of motions that decelerate as gently as the ends of the ranges ask for
_SAME_WAYPOINT = 1e-9  # rad (m); closer waypoints count as one
_TOO_CLOSE = "move_through: rounding takes every motion through these waypoints outside the limits; place them farther apart"


def move_through(
    arm: Arm, waypoints: ArrayLike | Sequence[Via | ArrayLike], *, speed: float = 1.0, duration: float | None = None
) -> JointTrajectory:
    """The motion through every waypoint without stopping, at rest at the first and the last.

    Between waypoints each joint moves independently, jerk-limited and inside its position limits; the velocities and
    accelerations at the waypoints are optimized. If a motor would saturate, the motion is slower on the
    same path, and `slowed` contains the factor. It is never slower than `move_j` from waypoint to waypoint.

    Dense waypoints, as of a recording, determine the path; then the motion is about as fast as a smooth path through them
    permits, on a line as fast as `move_j`. Each one is passed exactly, so that noise in a recording costs time.

    Args:
        waypoints: (k, n) rad, at least two, each inside the limits; the first is the start. A `Via` instead of a row
            also contains speed, acceleration and payload of the section that ends at it, and a pause.
        speed: Fraction of the full speed, in (0, 1]; 0.5 takes twice as long.
        duration: s, how long it takes with its pauses, which last longer in proportion; as short as possible if left out.

    Raises:
        InputError: A wrong shape, a number that is not finite, or an arm without finite limits.
        LimitError: A position outside the limits.
        PlanError: A motor cannot hold the arm at some point of the path, or the duration is too short.
    """
    planning = planning_arm(arm, speed)
    seconds = read_duration(duration)
    vias = _vias(arm, waypoints)
    motions: list[JointTrajectory] = []
    begin = 0
    for k in range(1, len(vias)):
        if vias[k].dwell or k == len(vias) - 1:
            motions.append(_flowing(arm, planning.limits, vias[begin : k + 1], speed))
            if vias[k].dwell:
                motions.append(pause(arm, np.asarray(vias[k].q), vias[k].dwell))
            begin = k
    return lasting(arm, joined(motions), seconds)


def _vias(arm: Arm, waypoints: ArrayLike | Sequence[Via | ArrayLike]) -> list[Via]:
    items: list[Any] = list(waypoints) if isinstance(waypoints, (list, tuple)) else []
    if any(isinstance(each, Via) for each in items):
        vias = [each if isinstance(each, Via) else Via(each) for each in items]
        configurations = [vector(f"waypoints[{i}]", via.q, arm.n) for i, via in enumerate(vias)]
    else:
        configurations = list(matrix("waypoints", waypoints, arm.n))  # type: ignore[arg-type]
        vias = [Via(q) for q in configurations]
    if len(configurations) < 2:
        raise InputError(f"waypoints: expected at least 2, got {len(configurations)}; the first one is the start of the motion")
    pairs = enumerate(zip(vias, configurations, strict=True))
    return [replace(via, q=arm.checked(f"waypoints[{i}]", q)) for i, (via, q) in pairs]


def _flowing(arm: Arm, limits: Limits, vias: Sequence[Via], speed: float) -> JointTrajectory:
    """The motion through waypoints from rest to rest."""
    points = np.array([via.q for via in vias])
    apart = np.abs(np.diff(points, axis=0)).max(axis=1) > _SAME_WAYPOINT
    points = points[np.concatenate([[True], apart])]
    sections = [section for section, is_apart in zip(vias[1:], apart, strict=True) if is_apart]
    if len(points) == 1:
        return JointTrajectory(*standing(points[0]), arm.joint_names, arm.limits, units=arm.units)
    passage = _fastest_within(points, limits, is_smooth=may_be_smooth(points, limits))
    free = _trajectory(arm, passage)
    if any(map(is_limited, sections)):
        return within_sections(arm, free, passage.times[1:], sections)
    lines = points[straight_runs(points)]
    try:
        motion = within_torque(arm, free)
    except PlanError:
        return slowed_relative_to(arm, _stopping_at_each(arm, lines, speed), free)
    if motion is not free and motion.duration > (1 + SAME_DURATION) * _least_stopping_time(lines, limits):
        # Torque limits can slow the flowing motion down more than one that stops.
        motion = min(motion, _stopping_at_each(arm, lines, speed), key=lambda each: each.duration)
    return motion if motion is free else slowed_relative_to(arm, motion, free)


def _stopping_at_each(arm: Arm, points: Array, speed: float) -> JointTrajectory:
    """Straight moves from waypoint to waypoint, within the torque limits."""
    return joined([move_j(arm, start, goal, speed=speed) for start, goal in pairwise(points)])


def _least_stopping_time(points: Array, limits: Limits) -> float:
    """s, of straight moves from waypoint to waypoint without torque limits."""
    bounds = (limits.v_max, limits.a_max, limits.j_max)
    return sum(float(straight_rest_to_rest(start, goal, bounds).knots[-1]) for start, goal in pairwise(points))


def through_waypoints(arm: MovingJoints, points: Array) -> JointTrajectory:
    """As `move_through` without the torque limits, for a few checked points that differ from their neighbors."""
    return _trajectory(arm, _fastest_within(points, arm.limits, is_smooth=False))


def _trajectory(arm: MovingJoints, passage: Passage) -> JointTrajectory:
    return JointTrajectory(*passage.pieces, arm.joint_names, arm.limits, units=arm.units)


def _fastest_within(points: Array, limits: Limits, *, is_smooth: bool) -> Passage:
    """The fastest motion that is found inside all limits but those of the torque.

    Where it is faster than the ends of the ranges allow, one with gentler accelerations, or a slower one, replaces it.
    """
    passage = _fastest(WaypointSearch(points, limits.plain), is_smooth)
    if not limits.depends_on_position or is_inside(passage.pieces, limits):
        return passage
    room = room_to_stop(limits)  # beyond which only waypoints lead
    inside = replace(limits, q_min=np.minimum(room.q_min, points.min(axis=0)), q_max=np.maximum(room.q_max, points.max(axis=0)))
    low, high = map(inside.clamp, _span(passage))
    for _ in range(_GENTLE_SEARCHES):
        gentle = gentle_in_both_directions(limits, low, high)
        gentle = replace(gentle.plain, q_min=inside.q_min, q_max=inside.q_max)
        passage = _fastest(WaypointSearch(points, gentle), is_smooth)
        if is_inside(passage.pieces, limits):
            return passage
        lowest, highest = _span(passage)
        low = np.minimum(low, lowest)
        high = np.maximum(high, highest)
    pieces = slowed_into(passage.pieces, limits)
    return Passage(pieces, passage.times * (pieces.knots[-1] / passage.times[-1]))


def _span(passage: Passage) -> tuple[Array, Array]:
    """The lowest and the highest position of each joint, (n,) each."""
    positions = piece_extremes(passage.pieces.coefficients, np.diff(passage.pieces.knots), 0)[1]
    return positions.min(axis=(0, 2)), positions.max(axis=(0, 2))


def _fastest(search: WaypointSearch, is_smooth: bool) -> Passage:
    """The fastest motion that is found inside all limits but those of the torque.

    Through dense points the search gets stuck. If they may be on a smooth path, the path is timed, and the search also started
    near its motion.
    """
    stopping = search.stopping()
    found = [_within_limits(search, search.fastest(stopping))]
    if is_smooth:
        along_paths = [_inside(passage, search.limits) for passage in along_smooth_paths(search.q, search.limits)]
        found += along_paths
        nearest = _shortest(along_paths)
        if nearest is not None:
            found.append(_within_limits(search, search.fastest(stopping, nearest)))
    passage = _shortest(found) or _within_limits(search, stopping)
    if passage is None:
        raise PlanError(_TOO_CLOSE)
    return passage


def _shortest(passages: Sequence[Passage | None]) -> Passage | None:
    return min((each for each in passages if each is not None), key=lambda each: each.times[-1], default=None)


def _within_limits(search: WaypointSearch, candidate: TimingCandidate) -> Passage | None:
    """The motion of a candidate of the search; None if rounding takes it out of its limits."""
    try:
        return _inside(search.passage(candidate), search.limits)
    except PlanError:
        return None


def _inside(passage: Passage, limits: Limits) -> Passage | None:
    """A motion slowed down to its limits; None if rounding takes it out of them."""
    pieces = slowed_to_bounds(passage.pieces, (limits.v_max, limits.a_max, limits.j_max))
    if not is_inside(pieces, limits):
        return None
    return Passage(pieces, passage.times * (pieces.knots[-1] / passage.times[-1]))
