"""The motion along a smooth path of the joints: as fast as velocity, acceleration, jerk, torque and the caps of tips allow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armctl.model.arm.arm import Arm
from armctl.plan.motion.path.joint_path import JointPath
from armctl.plan.motion.path.tip_caps import TipCaps
from armctl.plan.motion.timing.otg import slowed_to_bounds
from armctl.plan.motion.timing.path_timing import time_optimal
from armctl.plan.motion.torque_limits import within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import joints_of

_FINENESS = 2


def timed_along(
    arm: Arm, planning: Arm, path: JointPath, options: Mapping[str, Any], tips: tuple[str, ...] | None = None
) -> JointTrajectory:
    """The motion along a path; `planning` has the limits at its speed, the options are `PathOptions`, for the first tip."""
    limits = planning.limits
    speed = options.get("speed", 1.0)
    caps = TipCaps.from_path(arm, path, speed, options.get("tip_speed"), options.get("tip_angular_speed"), tips)
    pieces = time_optimal(path, limits, caps, fineness=_FINENESS)
    free = slowed_to_bounds(joints_of(pieces), limits.larger_sides)
    motion = within_torque(arm, JointTrajectory(*free, arm.joint_names, arm.limits, units=arm.units))
    return motion if caps is None else caps.kept(motion)
