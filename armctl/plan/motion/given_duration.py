"""Motions that take a given time, as to be synchronized with a machine; never shorter than the limits allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.model.arm.arm import Arm
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

SAME_DURATION = 1e-9  # relative


def lasting(arm: Arm, motion: JointTrajectory, duration: float | None) -> JointTrajectory:
    """The fastest motion from rest to rest as slow as a duration says, s, on the same path; the motion itself for None.

    Raises PlanError if the duration is too short, or a motor cannot hold the arm so long where it passes.
    """
    if duration is None:
        return motion
    require_long_enough(motion.duration, duration)
    if motion.duration == 0.0:
        return replace(motion, knots=np.array([0.0, duration]))
    if abs(duration - motion.duration) <= SAME_DURATION * duration:
        return motion
    slower = motion.scaled(motion.duration / duration)
    if check_torque(arm, motion).ok and not (check := check_torque(arm, slower)).ok:
        raise PlanError(f"duration: at {duration:g} s, {check}; a faster motion only passes there, give less time")
    return slower


def require_long_enough(shortest: float, duration: float) -> None:
    """Refuses a duration, s, that is less than the shortest one. Raises PlanError."""
    if duration < shortest * (1 - SAME_DURATION):
        raise PlanError(
            f"duration: {duration:g} s is too short, the motion takes at least {shortest:.6g} s; give more, or leave it out"
        )
