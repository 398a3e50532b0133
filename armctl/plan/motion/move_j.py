"""move_j: joint to joint, exactly straight in joint space and time-optimal along the line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.limits import Limits
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, flag
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import goal_state, is_moving, limits_from, planning_arm, start_state
from armctl.plan.motion.moving_start import stop_from
from armctl.plan.motion.timing.otg import LONGER, JointState, ProfileSolver, solve_pieces
from armctl.plan.motion.torque_limits import check_torque, slowed_relative_to, within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import POSITION_TOLERANCE, piece_extremes
from armctl.plan.motion.trajectory.piecewise import Pieces, standing

# Shares of the limits of acceleration and jerk that are tried where a motor would saturate in a motion that starts moving: it
# cannot be slowed down on its path, since its first speed is given.
_GENTLER = (0.5, 0.25)
_MAX_OFF_LINE = 1e-6  # of the smallest limit of speed or acceleration


def move_j(
    arm: Arm, q_start: ArrayLike | Setpoint, q_goal: ArrayLike | Setpoint, *, speed: float = 1.0, straight: bool = True
) -> JointTrajectory:
    """The fastest jerk-limited motion from one joint position to another, at rest there or in motion.

    A straight motion has one path parameter for all joints, with the tightest of their limits along the direction; ruckig
    (Berscheid and Kroeger, "Jerk-limited Real-time Trajectory Generation with Arbitrary Target States", RSS 2021) times it.
    If a motor would saturate, the motion is slowed down, and `slowed` contains the factor. A motion that starts or ends moving
    takes a half or a quarter of the limits of acceleration and jerk then.

    Args:
        q_start: (n,) rad, inside the limits; or a setpoint, if it starts while the arm moves, along the line if it is straight.
            A velocity or acceleration beyond its limit is first reduced to the limit as fast as the others allow.
        q_goal: (n,) rad, inside the limits; or a setpoint with the velocity and acceleration that the arm has at the goal, as
            on a conveyor, and from which it can stop inside its limits.
        speed: Fraction of the full speed, in (0, 1]; 0.5 takes twice as long.
        straight: Whether the path is a straight line in joint space. Otherwise each joint moves independently in the time
            that the slowest needs.

    Raises:
        InputError: A wrong length, a number that is not finite, or a setpoint that leads off the line.
        LimitError: A start or goal outside the position limits, a goal outside the others, or one of both so fast that the
            motion would leave them.
        PlanError: A motor cannot hold the arm at some point of the path, or saturates in every motion from a moving start.
    """
    planning = planning_arm(arm, speed)
    start = start_state(planning, q_start)
    goal = goal_state(planning, "q_goal", q_goal)
    is_straight = flag("straight", straight)

    def planned(share: float, shortest: float = 0.0) -> JointTrajectory:
        gentle = replace(planning.limits, a_max=share * planning.limits.a_max, j_max=share * planning.limits.j_max)
        pieces = _line(gentle, start, goal, shortest) if is_straight else _each_joint(gentle, start, goal, shortest)
        return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)

    motion = planned(1.0)
    if not (is_moving(start) or is_moving(goal)):
        return within_torque(arm, motion)
    limits = limits_from(arm.limits, start)
    if is_moving(goal):
        stop_from(arm, goal, "q_goal")
        fastest = motion.duration
        for factor in LONGER[1:]:
            if motion.check_limits(limits).ok:
                break
            motion = planned(1.0, factor * fastest)
    if not (check := motion.check_limits(limits)).ok:
        what = "q_goal" if is_moving(goal) else "q_start"
        raise LimitError(f"{what}: {check.violations[0]}; {'end' if is_moving(goal) else 'start'} slower, or stop before")
    if check_torque(arm, motion).ok:
        return motion
    for share in _GENTLER:
        gentler = planned(share)
        if gentler.check_limits(limits).ok and check_torque(arm, gentler).ok:
            return slowed_relative_to(arm, gentler, motion)
    return within_torque(arm, motion)


def _each_joint(limits: Limits, start: Setpoint, goal: Setpoint, shortest: float) -> Pieces:
    """The pieces of the fastest motion in which each joint moves by itself and all arrive together."""
    solver = ProfileSolver.from_limits(limits)
    return solve_pieces(solver, JointState(*start[:3]), JointState(*goal[:3]), shortest=shortest)


def _line(limits: Limits, start: Setpoint, goal: Setpoint, shortest: float) -> Pieces:
    """The pieces of q(t) = start + s(t) (goal - start) / length, with length the longest way of a joint."""
    way = goal.q - start.q
    length = float(np.abs(way).max())
    if length == 0.0 and not is_moving(start) and not is_moving(goal):
        return standing(goal.q)
    direction = way / length if length else way
    first, start_is_off = _on_line(start, direction, limits)
    last, goal_is_off = _on_line(goal, direction, limits)
    if length == 0.0 or start_is_off or goal_is_off:
        # The direction of a way of a few roundings is no direction. So short a motion is straight however the joints move.
        pieces = _each_joint(limits, start, goal, shortest)
        off_goal = piece_extremes(pieces.coefficients, np.diff(pieces.knots), 0)[1] - goal.q[:, None]
        if np.abs(off_goal).max() <= POSITION_TOLERANCE:
            return pieces
        if goal_is_off and not start_is_off:
            raise InputError("q_goal: its velocity leads off the straight line from q_start; plan with straight=False")
        raise InputError("q_start: its motion leads off the straight line to q_goal; plan with straight=False")
    with np.errstate(divide="ignore"):
        v_max = np.array([(limits.v_max / np.abs(direction)).min()])
        a_max = np.array([(limits.a_max / np.abs(direction)).min()])
        j_max = np.array([(limits.j_max / np.abs(direction)).min()])
    knots, s = solve_pieces(ProfileSolver(v_max, a_max, j_max), first, last._replace(q=np.array([length])), shortest=shortest)
    coefficients = s * direction
    coefficients[:, 0] += start.q
    return Pieces(knots, coefficients)


def _on_line(state: Setpoint, direction: Array, limits: Limits) -> tuple[JointState, bool]:
    """A start's or goal's motion along a line, from 0, each (1,), and whether it leads off the line."""
    speed = _along(state.v, direction)
    acceleration = _along(state.a, direction)
    velocity_off_line = np.abs(state.v - speed * direction).max() / limits.v_max.min()
    acceleration_off_line = np.abs(state.a - acceleration * direction).max() / limits.a_max.min()
    is_off = bool(max(velocity_off_line, acceleration_off_line) > _MAX_OFF_LINE)
    zero = np.zeros(1)
    return JointState(zero, zero + speed, zero + acceleration), is_off


def _along(rate: Array, direction: Array) -> float:
    """How fast a point moves along a direction; 0 if there is none."""
    squared = float(direction @ direction)
    return float(rate @ direction) / squared if squared else 0.0
