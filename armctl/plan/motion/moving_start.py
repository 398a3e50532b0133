"""Motions that start while the arm moves: it comes to rest as fast as it can, and what follows begins before it rests."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import LimitError, PlanError
from armctl.core.pose import Pose
from armctl.core.trajectory import Setpoint
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import is_moving, limits_from, planning_arm, start_state
from armctl.plan.motion.timing.otg import JointState, ProfileSolver, at_rest, ending_at
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import each_inside, is_inside
from armctl.plan.motion.trajectory.piecewise import Pieces, joined, overlapped, sample

_OVERLAPS = 16  # shares of the stop's duration that are tried


def planned_from(
    arm: Arm, q_start: Pose | Setpoint | ArrayLike, plan: Callable[[Pose | ArrayLike], JointTrajectory]
) -> JointTrajectory:
    """A motion that `plan` makes from rest, begun while the arm moves if the start is a setpoint in motion."""
    if not isinstance(q_start, Setpoint):
        return plan(q_start)
    start = start_state(planning_arm(arm, 1.0), q_start)
    stop = stop_from(arm, start)
    if stop is None:
        return plan(start.q)
    return begun_moving(arm, stop, plan(arm.limits.clamp(stop(stop.duration).q)))


def stop_from(arm: Arm, start: Setpoint, what: str = "q_start") -> JointTrajectory | None:
    """The fastest stop from a state that an argument, called `what`, gives; None if it is at rest."""
    if not is_moving(start):
        return None
    state = JointState(start.q, start.v, start.a)
    profile = ProfileSolver.from_limits(arm.limits).stop(state)
    if profile is None:
        raise PlanError("no stop inside the limits was found from this start; start slower")
    pieces = profile.pieces(state)
    pieces = ending_at(pieces, at_rest(sample(pieces, pieces.knots[-1:]).q[0])).corrected
    if not is_inside(pieces, limits_from(arm.limits, start)):
        slower = "from this start; start slower" if what == "q_start" else "after this goal; end slower"
        raise LimitError(f"{what}: the arm cannot stop inside its position limits {slower}")
    return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)


def begun_moving(
    arm: Arm, stop: JointTrajectory, motion: JointTrajectory, accepts: Callable[[JointTrajectory], bool] | None = None
) -> JointTrajectory:
    """A stop and the motion that follows from where it ends, with the largest overlap that keeps all limits and is accepted.

    Raises PlanError if not even the stop with the motion after it is accepted.
    """
    longest = min(stop.duration, motion.duration)
    braked = _time_inside(stop)
    while_braking = limits_from(arm.limits, stop(0.0))
    for share in np.linspace(1.0, 0.0, _OVERLAPS, endpoint=False):
        pieces = overlapped(stop.pieces, motion.pieces, share * longest)
        is_braking = pieces.knots[1:] <= braked
        limits = (while_braking, arm.limits)
        if all(is_inside(part, limit) for part, limit in zip(_split(pieces, int(is_braking.sum())), limits, strict=True)):
            whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, slowed=motion.slowed, units=arm.units)
            if check_torque(arm, whole).ok and (accepts is None or accepts(whole)):
                return whole
    pieces = joined([stop.pieces, motion.pieces])
    whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, slowed=motion.slowed, units=arm.units)
    if accepts is not None and not accepts(whole):
        raise PlanError("the arm cannot stop in time; start slower")
    return whole


def _time_inside(stop: JointTrajectory) -> float:
    """From when on a stop is inside the limits, s; 0 if its start is."""
    outside = np.flatnonzero(~each_inside(stop.coefficients, np.diff(stop.knots), stop.limits))
    return float(stop.knots[outside[-1] + 1]) if len(outside) else 0.0


def _split(pieces: Pieces, count: int) -> tuple[Pieces, Pieces]:
    """The first pieces of a motion, and the others; each with its times from 0."""
    knots = pieces.knots
    return (
        Pieces(knots[: count + 1], pieces.coefficients[:count]),
        Pieces(knots[count:] - knots[count], pieces.coefficients[count:]),
    )
