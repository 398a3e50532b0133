"""Checks of the arguments that every planner takes."""

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, vector
from armctl.robot.arm import Arm, check_arm

_LIMIT_ROUNDING = 1e-9  # of a limit


def planning_arm(arm: Arm, speed: float) -> Arm:
    """The arm with its limits at a fraction of the full speed; InputError if one is infinite."""
    check_arm(arm)
    for name in ("v_max", "a_max", "j_max"):
        bound = getattr(arm.limits, name)
        if not np.isfinite(bound).all():
            joint = arm.joint_names[int(np.isinf(bound).argmax())]
            raise InputError(f"{name}: {joint} has no limit, and without one there is no time-optimal motion; set a finite one")
    limits = arm.limits.at_speed(speed)
    return arm if limits is arm.limits else arm.with_limits(limits)


def start_state(arm: Arm, q_start: ArrayLike | Setpoint) -> Setpoint:
    """A caller's start: at rest at joint positions, or in motion if it is a setpoint.

    LimitError outside the limits, also if the acceleration would take a joint beyond its greatest speed.
    """
    if not isinstance(q_start, Setpoint):
        zero = np.zeros(arm.n)
        return Setpoint(arm.checked("q_start", q_start), zero, zero)
    q = arm.checked("q_start", q_start.q)
    v = vector("q_start.v", q_start.v, arm.n)
    a = vector("q_start.a", q_start.a, arm.n)
    limits = arm.limits
    _require_within(arm, "q_start.v", v, limits.v_max, "/s")
    _require_within(arm, "q_start.a", a, limits.a_max, "/s^2")
    later = np.abs(v + a * np.abs(a) / (2 * limits.j_max))
    over = later > limits.v_max * (1 + _LIMIT_ROUNDING)
    if over.any():
        i = int(over.argmax())
        raise LimitError(
            f"q_start.v: {arm.joint_names[i]}: with this acceleration its speed comes to {later[i]:g} {arm.units[i]}/s, "
            f"more than its limit {limits.v_max[i]:g} {arm.units[i]}/s; start slower"
        )
    return Setpoint(q, v, a)


def _require_within(arm: Arm, what: str, values: Array, bounds: Array, per: str) -> None:
    over = np.abs(values) > bounds * (1 + _LIMIT_ROUNDING)
    if over.any():
        i = int(over.argmax())
        unit = arm.units[i] + per
        raise LimitError(f"{what}: {arm.joint_names[i]}: {values[i]:g} {unit} is outside +-{bounds[i]:g} {unit}")
