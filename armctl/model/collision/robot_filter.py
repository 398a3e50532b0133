"""robot_filter: the points of a picture that are not on the robot itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.shapes import Points
from armctl.core.validation import Array, number, vector
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.collision.checkers import checkable
from armctl.model.mjmodel.queries import is_below, robot_roots

_MAX_MARGIN_M = 1.0


def robot_filter(arm: Arm, q: ArrayLike, points: ArrayLike, margin: float = 0.02) -> Array:
    """The points that are not on the robot, by the distance from its own collision geometry.

    A depth camera that sees the arm sees its links as well; without them, the points are what is around it.

    Args:
        arm: The arm; its base and its fingers, which are where they are at home, belong to it.
        q: (n,) rad, where the arm is.
        points: (N, 3) m, in the frame of the world.
        margin: m; nearer points are on the robot. It has to cover the errors of the camera.

    Returns:
        (K, 3) m, the other points.

    Raises:
        InputError: Points that are not finite, none, or all of them on the robot, as if they were in another frame.
        ModelError: A link of the arm has no collision shape, so that its points are unknown.
    """
    check_arm(arm)
    margin = number("margin", margin, 0.0, _MAX_MARGIN_M)
    given = Points(points).points
    q = vector("q", q, arm.n)
    checker = checkable(arm)
    roots = robot_roots(arm.model, arm.joint_map.joints)
    owners = arm.model.geom_bodyid[checker.geometry.geom_ids].tolist()
    own = np.flatnonzero([any(is_below(arm.model, owner, root) for root in roots) for owner in owners])
    kept = ~checker.near_points(q, own, given, margin)
    if not kept.any():
        raise InputError(
            f"points: all {len(given)} are on the robot, within {1e3 * margin:g} mm; are they in the frame of the world? "
            "points @ T_world_camera.rotation.T + T_world_camera.position are"
        )
    return given[kept]
