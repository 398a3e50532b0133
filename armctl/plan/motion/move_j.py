"""move_j: joint to joint, exactly straight in joint space and time-optimal along the line."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError, PlanError
from armctl.core.limits import Limits
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, choice, flag
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import goal_state, is_moving, limits_from, planning_arm, read_duration, start_state
from armctl.plan.motion.given_duration import SAME_DURATION, lasting, require_long_enough
from armctl.plan.motion.moving_start import stop_from
from armctl.plan.motion.timing.end_limits import gentle_limits, slowed_into
from armctl.plan.motion.timing.otg import LONGER, JointState, ProfileSolver, solve_pieces
from armctl.plan.motion.timing.teaching_profiles import quintic, trapezoid
from armctl.plan.motion.torque_limits import MAX_STRETCHES, check_torque, slowed_relative_to, stretch_for, within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import POSITION_TOLERANCE, is_inside, piece_extremes
from armctl.plan.motion.trajectory.piecewise import Pieces, standing

# Shares of the limits of acceleration and jerk that are tried where a motor would saturate in a motion that starts moving: it
# cannot be slowed down on its path, since its first speed is given.
_GENTLER = (0.5, 0.25)
_PROFILES = {"trapezoid": trapezoid, "quintic": quintic}
_MAX_OFF_LINE = 1e-6  # of the smallest limit of speed or acceleration


def move_j(
    arm: Arm,
    q_start: ArrayLike | Setpoint,
    q_goal: ArrayLike | Setpoint,
    *,
    speed: float = 1.0,
    straight: bool = True,
    duration: float | None = None,
    profile: str = "jerk-limited",
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
        duration: s, how long it takes, as to be synchronized with a machine; as short as possible if left out.
        profile: Of the speed along a line from rest to rest: "jerk-limited", or for comparison the "trapezoid" or the "quintic"
            polynomial of textbooks, whose jerk has no limit: `check_limits` shows by how much it is exceeded.

    Raises:
        InputError: A wrong length, a number that is not finite, or a setpoint that leads off the line.
        LimitError: A start or goal outside the position limits, a goal outside the others, or one of both so fast that the
            motion would leave them.
        PlanError: A motor cannot hold the arm at some point of the path, or saturates in every motion from a moving start; or
            the duration is too short.
    """
    planning = planning_arm(arm, speed, is_signed=True)
    start = start_state(planning, q_start)
    move = _Move(arm, planning.limits, start, goal_state(planning, "q_goal", q_goal), flag("straight", straight))
    seconds = read_duration(duration)
    if choice("profile", profile, ("jerk-limited", *_PROFILES)) != "jerk-limited":
        return lasting(arm, move.of_textbooks(profile), seconds)
    if move.moves:
        return move.in_motion() if seconds is None else move.in_motion_lasting(seconds)
    motion = within_torque(arm, move.planned())
    return motion if seconds is None else lasting(arm, motion, seconds)


class _Move(NamedTuple):
    """A motion from one state to another: the limits are those at a fraction of the full speed."""

    arm: Arm
    limits: Limits
    start: Setpoint
    goal: Setpoint
    is_straight: bool

    @property
    def moves(self) -> bool:
        """Whether it starts or ends in motion."""
        return is_moving(self.start) or is_moving(self.goal)

    def planned(self, share: float = 1.0, shortest: float = 0.0) -> JointTrajectory:
        """The fastest one that lasts at least so many seconds, with a share of the limits of acceleration and jerk."""
        limits = self.limits
        gentle = replace(limits, a_max=share * limits.a_max, j_max=share * limits.j_max)
        if np.isfinite(limits.a_min).any():
            gentle = replace(gentle, a_min=share * limits.a_min)
        plan = _line if self.is_straight else _each_joint
        pieces = plan(gentle, self.start, self.goal, shortest)
        if limits.depends_on_position and not is_inside(pieces, limits_from(limits, self.start)):
            pieces = plan(self._stopping_gently(gentle), self.start, self.goal, shortest)
            pieces = pieces if self.moves else slowed_into(pieces, limits)
        return JointTrajectory(*pieces, self.arm.joint_names, self.arm.limits, units=self.arm.units)

    def _stopping_gently(self, limits: Limits) -> Limits:
        """The limits with which joints decelerate so much that the ends of their ranges allow their velocities."""
        low = np.minimum(self.start.q, self.goal.q)
        high = np.maximum(self.start.q, self.goal.q)
        return gentle_limits(limits, low, high, up=self.goal.q > self.start.q, down=self.goal.q < self.start.q)

    def of_textbooks(self, profile: str) -> JointTrajectory:
        """One from rest to rest whose jerk is not limited, slowed down as a whole where a motor would saturate."""
        if self.moves or not self.is_straight:
            raise InputError(f"profile: {profile!r} is for straight moves from rest to rest; leave it out for others")
        arm = self.arm
        symmetric = self.limits.symmetric
        pieces = _PROFILES[profile](self.start.q, self.goal.q, (symmetric.v_max, symmetric.a_max, symmetric.j_max))
        pieces = slowed_into(pieces, self.limits)
        free = JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)
        motion = free
        for _ in range(MAX_STRETCHES):
            check = check_torque(arm, motion)
            if check.ok:
                return slowed_relative_to(arm, motion, free)
            motion = motion.scaled(1 / stretch_for(check.ratio))
        raise PlanError(f"{check_torque(arm, motion)}, however slowly the arm moves; take a lighter payload or another path")

    def in_motion(self) -> JointTrajectory:
        """The fastest one that starts or ends in motion. Raises LimitError or PlanError if there is none inside the limits."""
        arm = self.arm
        limits = limits_from(arm.limits, self.start)
        motion = self.planned()
        if is_moving(self.goal):
            stop_from(arm, self.goal, "q_goal")
            fastest = motion.duration
            for factor in LONGER[1:]:
                if is_inside(motion.pieces, limits):
                    break
                motion = self.planned(1.0, factor * fastest)
        if not is_inside(motion.pieces, limits):
            what = "q_goal" if is_moving(self.goal) else "q_start"
            slower = "end slower" if is_moving(self.goal) else "start slower"
            raise LimitError(f"{what}: {motion.check_limits(limits).violations[0]}; {slower}, or stop before")
        if check_torque(arm, motion).ok:
            return motion
        for share in _GENTLER:
            gentler = self.planned(share)
            if is_inside(gentler.pieces, limits) and check_torque(arm, gentler).ok:
                return slowed_relative_to(arm, gentler, motion)
        return within_torque(arm, motion)

    def in_motion_lasting(self, duration: float) -> JointTrajectory:
        """The one that starts or ends in motion and lasts so many seconds. Raises LimitError or PlanError if there is none."""
        require_long_enough(self.in_motion().duration, duration)
        motion = self.planned(1.0, duration)
        if motion.duration > duration * (1 + SAME_DURATION):
            raise PlanError(
                f"duration: no motion between these states in motion takes {duration:g} s, the next longer one takes "
                f"{motion.duration:.6g} s; give this time, or leave it out"
            )
        if not (check := motion.check_limits(limits_from(self.arm.limits, self.start))).ok:
            raise PlanError(f"duration: in {duration:g} s, {check.violations[0]}; give less time, or leave it out")
        if not (torque := check_torque(self.arm, motion)).ok:
            raise PlanError(f"duration: in {duration:g} s, {torque}; give another time, or leave it out")
        return motion


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
        v_max = np.array([(np.where(direction < 0.0, -limits.v_low, limits.v_max) / np.abs(direction)).min()])
        a_max = np.array([(np.where(direction < 0.0, -limits.a_low, limits.a_max) / np.abs(direction)).min()])
        j_max = np.array([(limits.j_max / np.abs(direction)).min()])
        lows = None
        if limits.depends_on_sign:
            v_min = np.array([-(np.where(direction < 0.0, limits.v_max, -limits.v_low) / np.abs(direction)).min()])
            lows = v_min, np.array([-(np.where(direction < 0.0, limits.a_max, -limits.a_low) / np.abs(direction)).min()])
    solver = ProfileSolver(v_max, a_max, j_max, lows)
    knots, s = solve_pieces(solver, first, last._replace(q=np.array([length])), shortest=shortest)
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
