"""move_through: one motion through many joint positions."""

from __future__ import annotations

from functools import reduce
from itertools import pairwise

from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import matrix
from armctl.errors import InputError
from armctl.motion.joint_trajectory import JointTrajectory
from armctl.motion.straight import move_j


def move_through(arm: Arm, waypoints: ArrayLike) -> JointTrajectory:
    """The motion through every waypoint, at rest at the first and the last.

    Args:
        arm: The arm.
        waypoints: (k, n) rad, at least two, each inside the limits.

    Returns:
        The motion.

    Raises:
        InputError: A wrong shape or a number that is not finite.
        LimitError: A position outside the limits.
    """
    rows = matrix("waypoints", waypoints, arm.n)
    if len(rows) < 2:
        raise InputError(f"waypoints: {len(rows)} given, at least 2 wanted (the first one is where the arm is)")
    points = [arm.limits.check(f"waypoints[{i}]", row, arm.joint_names) for i, row in enumerate(rows)]
    return reduce(JointTrajectory.then, [move_j(arm, a, b, straight=False) for a, b in pairwise(points)])
