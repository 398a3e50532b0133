"""Checks of the arguments that every planner takes."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.limits import Limits
from armctl.core.trajectory import Setpoint
from armctl.core.validation import number, vector
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.timing.otg import JointState, unavoidable_bounds
from armctl.plan.motion.trajectory.limit_check import RATIO_TOLERANCE

_MAX_DURATION_S = 1e5


def planning_arm(arm: Arm, speed: float, *, is_signed: bool = False) -> Arm:
    """The arm with its limits at a fraction of the full speed; InputError if one is infinite.

    They are the same in both directions, unless the caller's motions have other limits in one direction than in the other.
    """
    check_arm(arm)
    for name in ("v_max", "a_max", "j_max"):
        bound = getattr(arm.limits, name)
        if not np.isfinite(bound).all():
            joint = arm.joint_names[int(np.isinf(bound).argmax())]
            raise InputError(f"{name}: {joint} has no limit, and without one there is no time-optimal motion; set a finite one")
    limits = arm.limits.at_speed(speed)
    limits = limits if is_signed else limits.symmetric
    return arm if limits is arm.limits else arm.with_limits(limits)


def read_duration(duration: float | None) -> float | None:
    """A caller's duration, s; None if there is none."""
    return None if duration is None else number("duration", duration, 1e-6, _MAX_DURATION_S)


def start_state(arm: Arm, q_start: ArrayLike | Setpoint) -> Setpoint:
    """A caller's start: at rest at joint positions, or in motion if it is a setpoint.

    LimitError if its positions are outside the limits. Velocity and acceleration may be beyond theirs, as measured ones are
    or after the limits have fallen: a motion first brakes into the limits.
    """
    if not isinstance(q_start, Setpoint):
        zero = np.zeros(arm.n)
        return Setpoint(arm.checked("q_start", q_start), zero, zero)
    q = arm.checked("q_start", q_start.q)
    return Setpoint(q, vector("q_start.v", q_start.v, arm.n), vector("q_start.a", q_start.a, arm.n))


def goal_state(arm: Arm, what: str, q_goal: ArrayLike | Setpoint) -> Setpoint:
    """A caller's goal, called `what`: at rest at joint positions, or in motion if it is a setpoint.

    LimitError if it is outside the limits. Its acceleration may lead the velocity out of them neither before nor after it.
    """
    zero = np.zeros(arm.n)
    if not isinstance(q_goal, Setpoint):
        return Setpoint(arm.checked(what, q_goal), zero, zero)
    q = arm.checked(what, q_goal.q)
    v = vector(f"{what}.v", q_goal.v, arm.n)
    a = vector(f"{what}.a", q_goal.a, arm.n)
    limits = arm.limits
    beside = a * np.abs(a) / (2 * limits.j_max)
    fastest = np.maximum(np.abs(v + beside), np.abs(v - beside))
    v_most, a_most, _ = limits.larger_sides
    for value, share, bound, unit in (
        (v, fastest / v_most, v_most, "/s"),
        (a, np.abs(a) / a_most, a_most, "/s^2"),
    ):
        i = int(share.argmax())
        if share[i] > 1 + RATIO_TOLERANCE:
            kind = "v" if value is v else "a"
            raise LimitError(
                f"{what}.{kind}: {arm.joint_names[i]} needs {100 * share[i]:.4g} % of its limit, {bound[i]:g} "
                f"{arm.units[i]}{unit}; give a slower goal"
            )
    _require_velocity_bounds(arm, what, Setpoint(q, v, a))
    return Setpoint(q, v, a)


def _require_velocity_bounds(arm: Arm, what: str, goal: Setpoint) -> None:
    """Refuses a goal that moves faster than its direction, or an end of its range, allows. Raises LimitError."""
    limits = arm.limits
    if limits.depends_on_sign or limits.depends_on_position:
        low, high = limits.velocity_bounds(goal.q)
        excess = np.maximum(goal.v - high, low - goal.v) * (goal.v != 0.0)
        i = int(excess.argmax())
        if excess[i] > RATIO_TOLERANCE * limits.v_max[i]:
            raise LimitError(
                f"{what}.v: {arm.joint_names[i]} has {goal.v[i]:g} {arm.units[i]}/s at {goal.q[i]:g} {arm.units[i]}, where "
                f"[{low[i]:g}, {high[i]:g}] {arm.units[i]}/s are allowed; give a slower goal"
            )


def is_moving(state: Setpoint) -> bool:
    """Whether a start or a goal is not at rest."""
    return bool(np.any(state.v) or np.any(state.a))


def limits_from(limits: Limits, start: Setpoint) -> Limits:
    """Limits that a motion from a start can keep: where the start leads beyond one, the least excess.

    While the motion brakes into the limits, these are what it is judged by.
    """
    if limits.depends_on_sign:
        return _signed_limits_from(limits, JointState(start.q, start.v, start.a))
    v_max, a_max, _ = unavoidable_bounds((limits.v_max, limits.a_max, limits.j_max), JointState(start.q, start.v, start.a))
    if (v_max == limits.v_max).all() and (a_max == limits.a_max).all():
        return limits
    return replace(limits, v_max=v_max, a_max=a_max)


def _signed_limits_from(limits: Limits, start: JointState) -> Limits:
    """`limits_from`, each direction by itself."""
    v = np.asarray(start.v)
    a = np.asarray(start.a)
    coasting = v + a * np.abs(a) / (2 * limits.j_max)
    return replace(
        limits,
        v_max=np.maximum(limits.v_max, np.maximum(v, coasting)),
        a_max=np.maximum(limits.a_max, a),
        v_min=np.minimum(limits.v_low, np.minimum(v, coasting)),
        a_min=np.minimum(limits.a_low, a),
    )
