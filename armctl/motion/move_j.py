"""move_j: joint to joint, exactly straight in joint space and time-optimal along the line."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.validation import Array, flag
from armctl.motion.checks import planning_arm, start_velocity
from armctl.motion.timing.otg import JointState, ProfileSolver, at_rest, solve_pieces
from armctl.motion.torque_limits import within_torque
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.motion.trajectory.piecewise import Pieces, standing
from armctl.robot.arm import Arm

_MAX_VELOCITY_OFF_LINE = 1e-6  # of the smallest speed limit


def move_j(
    arm: Arm,
    q_start: ArrayLike,
    q_goal: ArrayLike,
    *,
    speed: float = 1.0,
    v_start: ArrayLike | None = None,
    straight: bool = True,
) -> JointTrajectory:
    """The fastest jerk-limited motion from one joint position to another.

    A straight motion has one path parameter for all joints, with the tightest of their limits along the direction; ruckig
    (Berscheid and Kroeger, "Jerk-limited Real-time Trajectory Generation with Arbitrary Target States", RSS 2021) times it.
    If a motor would saturate, the motion is slowed down, and `slowed` contains the factor.

    Args:
        arm: The arm.
        q_start: (n,) rad, inside the limits.
        q_goal: (n,) rad, inside the limits.
        speed: Fraction of the full speed, in (0, 1]; 0.5 takes twice as long.
        v_start: (n,) rad/s, the velocity it starts with, along the line if the move is straight; left out, it starts at rest.
        straight: Whether the path is a straight line in joint space. Otherwise each joint moves independently in the time
            that the slowest needs.

    Returns:
        The motion; it ends at rest.

    Raises:
        InputError: A wrong length, a number that is not finite, or a start velocity that leads off the line.
        LimitError: A position or velocity outside the limits, or a start so fast that the motion would leave them.
        PlanError: A motor cannot hold the arm at some point of the path.
    """
    planning = planning_arm(arm, speed)
    start = arm.checked("q_start", q_start)
    goal = arm.checked("q_goal", q_goal)
    v = start_velocity(planning, v_start)
    if flag("straight", straight):
        pieces = _line(planning, start, goal, v)
    else:
        pieces = solve_pieces(ProfileSolver.of(planning.limits), JointState(start, v, np.zeros(arm.n)), at_rest(goal))
    motion = JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)
    if v.any() and not (check := motion.check_limits()).ok:
        raise LimitError(f"v_start: {check.violations[0]}; start slower, or stop before")
    return within_torque(arm, motion)


def _line(arm: Arm, start: Array, goal: Array, v: Array) -> Pieces:
    """The pieces of q(t) = start + s(t) (goal - start) / length, with length the longest way of a joint."""
    way = goal - start
    length = float(np.abs(way).max())
    if length == 0.0 and not v.any():
        return standing(start)
    direction = way / length if length else way
    speed = float(v @ direction) / float(direction @ direction) if length else 0.0
    if np.abs(v - speed * direction).max() > _MAX_VELOCITY_OFF_LINE * arm.limits.v_max.min():
        raise InputError("v_start: it leads off the straight line from q_start to q_goal; plan with straight=False")
    limits = arm.limits
    with np.errstate(divide="ignore"):
        v_max = np.array([(limits.v_max / np.abs(direction)).min()])
        a_max = np.array([(limits.a_max / np.abs(direction)).min()])
        j_max = np.array([(limits.j_max / np.abs(direction)).min()])
    zero = np.zeros(1)
    knots, s = solve_pieces(ProfileSolver(v_max, a_max, j_max), JointState(zero, zero + speed, zero), at_rest(zero + length))
    coefficients = s * direction
    coefficients[:, 0] += start
    return Pieces(knots, coefficients)
