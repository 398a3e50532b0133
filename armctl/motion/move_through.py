"""move_through: one motion through many joint positions, without stopping at them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.limits import Limits
from armctl.core.validation import Array, matrix
from armctl.motion.checks import planning_arm
from armctl.motion.timing.otg import Moving, Profiles
from armctl.motion.timing.waypoint_timing import Candidate, WaypointSearch
from armctl.motion.torque_limits import within_torque
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.motion.trajectory.piecewise import Pieces, joined, standing
from armctl.robot.arm import Arm

_SAME = 1e-9  # rad, between two waypoints that are met as one


def move_through(arm: Arm, waypoints: ArrayLike, *, speed: float = 1.0) -> JointTrajectory:
    """The motion through every waypoint without stopping, at rest at the first and the last.

    Between waypoints each joint takes its own way, jerk-limited and inside its position limits; the velocities and
    accelerations at the waypoints are those that a search finds fastest. It is never slower than stopping at each. Where a
    motor would saturate it goes slower, and its `slowed` says so.

    Args:
        arm: The arm.
        waypoints: (k, n) rad, at least two, each inside the limits; the first is where the arm is.
        speed: Fraction of the full speed, in (0, 1]; 0.5 takes twice as long.

    Returns:
        The motion.

    Raises:
        InputError: A wrong shape, a number that is not finite, or an arm without finite limits.
        LimitError: A position outside the limits.
        PlanError: A motor cannot hold the arm on the way, however slowly it moves.
    """
    planning = planning_arm(arm, speed)
    rows = matrix("waypoints", waypoints, arm.n)
    if len(rows) < 2:
        raise InputError(f"waypoints: {len(rows)} given, at least 2 wanted (the first one is where the arm is)")
    points = np.array([arm.checked(f"waypoints[{i}]", row) for i, row in enumerate(rows)])
    apart = np.abs(np.diff(points, axis=0)).max(axis=1) > _SAME
    points = points[np.concatenate([[True], apart])]
    if len(points) == 1:
        return _motion(arm, standing(points[0]))
    search = WaypointSearch(points, planning.limits)
    stopping = search.at_rest()
    motion = within_torque(arm, _motion(arm, _pieces(planning.limits, points, search.fastest(stopping))))
    if motion.duration > stopping.durations.sum():  # torque limits can slow this motion more than the one that stops
        stops = within_torque(arm, _motion(arm, _pieces(planning.limits, points, stopping)))
        motion = min(motion, stops, key=lambda one: one.duration)
    return motion


def _motion(arm: Arm, pieces: Pieces) -> JointTrajectory:
    return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)


def _pieces(limits: Limits, points: Array, found: Candidate) -> Pieces:
    """The motion with the velocities and accelerations at the waypoints that a search found."""
    profiles = Profiles.of(limits)
    states = [Moving(*state) for state in zip(points, found.v, found.a, strict=True)]
    return joined([profiles.solve(a, b) for a, b in pairwise(states)])
