"""move_through: one motion through many joint positions, without stopping at them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, matrix
from armctl.motion.timing.otg import Moving, Profiles
from armctl.motion.timing.waypoint_timing import Candidate, WaypointSearch
from armctl.motion.torque_limits import within_torque
from armctl.motion.trajectory.checks import require_bounds
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.robot.arm import Arm

_SAME = 1e-9  # rad, between two waypoints that are met as one


def move_through(arm: Arm, waypoints: ArrayLike) -> JointTrajectory:
    """The motion through every waypoint without stopping, at rest at the first and the last.

    Between waypoints each joint takes its own way, jerk-limited and inside its position limits; the velocities and
    accelerations at the waypoints are those that a search finds fastest. It is never slower than stopping at each. Where a
    motor would saturate it goes slower, and its `slowed` says so.

    Args:
        arm: The arm.
        waypoints: (k, n) rad, at least two, each inside the limits; the first is where the arm is.

    Returns:
        The motion.

    Raises:
        InputError: A wrong shape, a number that is not finite, or an arm without finite limits.
        LimitError: A position outside the limits.
        PlanError: A motor cannot hold the arm on the way, however slowly it moves.
    """
    require_bounds(arm)
    rows = matrix("waypoints", waypoints, arm.n)
    if len(rows) < 2:
        raise InputError(f"waypoints: {len(rows)} given, at least 2 wanted (the first one is where the arm is)")
    points = np.array([arm.checked(f"waypoints[{i}]", row) for i, row in enumerate(rows)])
    apart = np.abs(np.diff(points, axis=0)).max(axis=1) > _SAME
    points = points[np.concatenate([[True], apart])]
    if len(points) == 1:
        return JointTrajectory.standing(arm.joint_names, arm.limits, arm.units, points[0])
    search = WaypointSearch(points, arm.limits)
    stopping = search.at_rest()
    motion = within_torque(arm, _motion(arm, points, search.fastest(stopping)))
    if motion.duration > stopping.durations.sum():  # the motors slow one more than the other
        motion = min(motion, within_torque(arm, _motion(arm, points, stopping)), key=lambda one: one.duration)
    return motion


def _motion(arm: Arm, points: Array, found: Candidate) -> JointTrajectory:
    """The motion that a search found."""
    profiles = Profiles.of(arm.limits)
    states = [Moving(*state) for state in zip(points, found.v, found.a, strict=True)]
    return JointTrajectory.joined(
        [JointTrajectory(*profiles.solve(a, b), arm.joint_names, arm.limits, units=arm.units) for a, b in pairwise(states)]
    )
