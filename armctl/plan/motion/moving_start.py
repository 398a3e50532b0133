"""Motions that start while the arm moves: it comes to rest as fast as it can, and what follows begins before it rests."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import LimitError, PlanError
from armctl.core.limits import Limits
from armctl.core.pose import Pose
from armctl.core.trajectory import Setpoint
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import is_moving, limits_from, planning_arm, start_state
from armctl.plan.motion.given_duration import SAME_DURATION, lasting, require_long_enough
from armctl.plan.motion.timing.otg import JointState, ProfileSolver, at_rest, ending_at
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import each_inside, is_inside
from armctl.plan.motion.trajectory.piecewise import Pieces, joined, overlapped, sample

_OVERLAPS = 16  # shares of the stop's duration that are tried


def planned_from(
    arm: Arm,
    q_start: Pose | Setpoint | ArrayLike,
    plan: Callable[[Pose | ArrayLike], JointTrajectory],
    duration: float | None = None,
) -> JointTrajectory:
    """A motion that `plan` makes from rest, begun while the arm moves if the start is a setpoint in motion.

    It lasts as long as `duration` says, s, or is as short as possible.
    """
    if not isinstance(q_start, Setpoint):
        return lasting(arm, plan(q_start), duration)
    start = start_state(planning_arm(arm, 1.0), q_start)
    stop = stop_from(arm, start)
    if stop is None:
        return lasting(arm, plan(start.q), duration)
    motion = plan(arm.limits.clamp(stop(stop.duration).q))
    return begun_moving(arm, stop, motion) if duration is None else begun_moving_lasting(arm, stop, motion, duration)


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
    braking = _Braking.from_stop(arm, stop)
    for overlap in _overlaps(stop, motion):
        whole = braking.then(motion, overlap, accepts)
        if whole is not None:
            return whole
    pieces = joined([stop.pieces, motion.pieces])
    whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, slowed=motion.slowed, units=arm.units)
    if accepts is not None and not accepts(whole):
        raise PlanError("the arm cannot stop in time; start slower")
    return whole


def begun_moving_lasting(
    arm: Arm,
    stop: JointTrajectory,
    motion: JointTrajectory,
    duration: float,
    accepts: Callable[[JointTrajectory], bool] | None = None,
) -> JointTrajectory:
    """A stop and the motion that follows, which take so many seconds together: with less overlap, or a slower motion.

    Raises PlanError if the duration is too short, or no such motion keeps the limits.
    """
    require_long_enough(begun_moving(arm, stop, motion, accepts).duration, duration)
    braking = _Braking.from_stop(arm, stop)
    for overlap in (*_overlaps(stop, motion), max(0.0, stop.duration + motion.duration - duration)):
        after = duration - stop.duration + overlap
        if after >= motion.duration * (1 - SAME_DURATION):
            whole = braking.then(lasting(arm, motion, max(after, motion.duration)), overlap, accepts)
            if whole is not None:
                return whole
    least = stop.duration + motion.duration
    raise PlanError(f"duration: no motion of {duration:g} s from this moving start was found; give {least:.6g} s or more")


def _overlaps(stop: JointTrajectory, motion: JointTrajectory) -> list[float]:
    """The overlaps of a stop and a motion that are tried, s, the longest first."""
    longest = min(stop.duration, motion.duration)
    return [float(share * longest) for share in np.linspace(1.0, 0.0, _OVERLAPS, endpoint=False)]


class _Braking(NamedTuple):
    """A stop from a start in motion, whose first part may be beyond the limits as far as the start makes it unavoidable."""

    arm: Arm
    stop: JointTrajectory
    until: float  # s, when it is inside the limits
    limits: Limits  # that it keeps until then

    @classmethod
    def from_stop(cls, arm: Arm, stop: JointTrajectory) -> _Braking:
        return cls(arm, stop, _time_inside(stop), limits_from(arm.limits, stop(0.0)))

    def then(
        self, motion: JointTrajectory, overlap: float, accepts: Callable[[JointTrajectory], bool] | None
    ) -> JointTrajectory | None:
        """The stop and a motion with an overlap, s; None if they do not keep all limits together, or are not accepted."""
        arm = self.arm
        pieces = overlapped(self.stop.pieces, motion.pieces, overlap)
        is_braking = pieces.knots[1:] <= self.until
        limits = (self.limits, arm.limits)
        if not all(is_inside(part, limit) for part, limit in zip(_split(pieces, int(is_braking.sum())), limits, strict=True)):
            return None
        whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, slowed=motion.slowed, units=arm.units)
        return whole if check_torque(arm, whole).ok and (accepts is None or accepts(whole)) else None


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
