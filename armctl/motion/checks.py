"""Checks of the arguments that every planner takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.validation import Array, vector
from armctl.robot.arm import Arm, check_arm

_LIMIT_ROUNDING = 1e-9  # of a limit


def planning_arm(arm: Arm, speed: float) -> Arm:
    """The arm with its limits at a fraction of the full speed.

    Raises InputError if it is not an arm, if a limit on speed, acceleration or jerk is infinite, or if speed is outside (0, 1].
    """
    check_arm(arm)
    for name in ("v_max", "a_max", "j_max"):
        bound = getattr(arm.limits, name)
        if not np.isfinite(bound).all():
            joint = arm.joint_names[int(np.isinf(bound).argmax())]
            raise InputError(f"{name}: {joint} has no limit, and without one there is no time-optimal motion; set a finite one")
    limits = arm.limits.at_speed(speed)
    return arm if limits is arm.limits else arm.with_limits(limits)


def start_velocity(arm: Arm, v_start: ArrayLike | None) -> Array:
    """A caller's start velocity (n,), zero if None.

    Raises InputError for a wrong length or a number that is not finite, and LimitError if a joint is faster than its limit.
    """
    if v_start is None:
        return np.zeros(arm.n)
    v = vector("v_start", v_start, arm.n)
    too_fast = np.abs(v) > arm.limits.v_max * (1 + _LIMIT_ROUNDING)
    if too_fast.any():
        i = int(too_fast.argmax())
        name = arm.joint_names[i]
        unit = arm.units[i]
        raise LimitError(f"v_start: {name}: {v[i]:g} {unit}/s is outside +-{arm.limits.v_max[i]:g} {unit}/s")
    return v


def require_feasible_start(arm: Arm, v: Array, a: Array) -> None:
    """Refuses a start from which a joint would have to exceed its speed or acceleration. Raises LimitError."""
    limits = arm.limits
    names = arm.joint_names
    units = arm.units
    over = np.abs(a) > limits.a_max * (1 + _LIMIT_ROUNDING)
    if over.any():
        i = int(over.argmax())
        raise LimitError(f"a_start: {names[i]}: {a[i]:g} {units[i]}/s^2 is outside +-{limits.a_max[i]:g} {units[i]}/s^2")
    later = np.abs(v + a * np.abs(a) / (2 * limits.j_max))
    over = later > limits.v_max * (1 + _LIMIT_ROUNDING)
    if over.any():
        i = int(over.argmax())
        raise LimitError(
            f"v_start: {names[i]}: with this acceleration its speed comes to {later[i]:g} {units[i]}/s, "
            f"more than its limit {limits.v_max[i]:g} {units[i]}/s; start slower"
        )
