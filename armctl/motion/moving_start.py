"""Motions that start while the arm moves: it comes to rest as fast as it can, and what follows begins before it rests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError, PlanError
from armctl.core.pose import Pose
from armctl.core.validation import Array, vector
from armctl.motion.checks import planning_arm, require_feasible_start, start_velocity
from armctl.motion.timing.otg import JointState, ProfileSolver, at_rest, ending_at
from armctl.motion.torque_limits import check_torque
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.motion.trajectory.limit_check import is_inside
from armctl.motion.trajectory.overlap import overlapped
from armctl.motion.trajectory.piecewise import joined, sample
from armctl.robot.arm import Arm

_OVERLAPS = 16  # shares of the stop's duration that are tried


def planned_from(
    arm: Arm,
    q_start: Pose | ArrayLike,
    v_start: ArrayLike | None,
    a_start: ArrayLike | None,
    plan: Callable[[Pose | ArrayLike], JointTrajectory],
) -> JointTrajectory:
    """A planned motion, which starts while the arm moves if a velocity or an acceleration is given.

    Args:
        arm: The arm.
        q_start: (n,) rad, where it is; or a pose, from which it starts at rest.
        v_start: (n,) rad/s; None for zero.
        a_start: (n,) rad/s^2; None for zero.
        plan: The motion from rest.

    Returns:
        The motion.

    Raises:
        InputError: A moving start at a pose, or as for `stop_from`.
        LimitError: As for `stop_from`.
        PlanError: As for `plan`.
    """
    if v_start is None and a_start is None:
        return plan(q_start)
    if isinstance(q_start, Pose):
        raise InputError("q_start: a moving start needs joint positions, not a pose")
    planning_arm(arm, 1.0)
    q = arm.checked("q_start", q_start)
    stop = stop_from(arm, q, v_start, a_start)
    if stop is None:
        return plan(q)
    return begun_moving(arm, stop, plan(arm.limits.clamp(stop(stop.duration).q)))


def stop_from(arm: Arm, q: Array, v_start: ArrayLike | None, a_start: ArrayLike | None) -> JointTrajectory | None:
    """The fastest stop from a moving start; None if it is at rest.

    Args:
        arm: The arm, with the limits of the motion.
        q: (n,) rad, checked.
        v_start: (n,) rad/s, as a caller gave it; None for zero.
        a_start: (n,) rad/s^2, likewise.

    Returns:
        The stop.

    Raises:
        InputError: A wrong length or a number that is not finite.
        LimitError: A start outside the limits, or so fast that no stop inside them is possible.
    """
    v = start_velocity(arm, v_start)
    a = np.zeros(arm.n) if a_start is None else vector("a_start", a_start, arm.n)
    if not v.any() and not a.any():
        return None
    require_feasible_start(arm, v, a)
    start = JointState(q, v, a)
    profile = ProfileSolver.of(arm.limits).stop(start)
    if profile is None:
        raise PlanError("no stop inside the limits was found from this start; start slower")
    pieces = profile.pieces(start)
    pieces = ending_at(pieces, at_rest(sample(pieces, pieces.knots[-1:]).q[0])).corrected
    if not is_inside(pieces, arm.limits):
        raise LimitError("v_start: the arm cannot stop inside its position limits from this start; start slower")
    return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)


def begun_moving(
    arm: Arm, stop: JointTrajectory, motion: JointTrajectory, accepts: Callable[[JointTrajectory], bool] | None = None
) -> JointTrajectory:
    """A stop and the motion that follows from where it ends, with the largest overlap that keeps all limits.

    Args:
        arm: The arm.
        stop: The stop.
        motion: What follows, within all limits.
        accepts: Whether the whole is accepted; None for always.

    Returns:
        The whole.

    Raises:
        PlanError: Not even the stop with the motion after it is accepted.
    """
    longest = min(stop.duration, motion.duration)
    for share in np.linspace(1.0, 0.0, _OVERLAPS, endpoint=False):
        pieces = overlapped(stop.pieces, motion.pieces, share * longest)
        if is_inside(pieces, arm.limits):
            whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, motion.slowed, arm.units)
            if check_torque(arm, whole).ok and (accepts is None or accepts(whole)):
                return whole
    pieces = joined([stop.pieces, motion.pieces])
    whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, motion.slowed, arm.units)
    if accepts is not None and not accepts(whole):
        raise PlanError("the arm cannot stop in time; start slower")
    return whole
