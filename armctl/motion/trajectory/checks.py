"""What every planner asks of its inputs, in one place and before anything else sees them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.validation import Array, vector
from armctl.robot.arm import Arm, check_arm


def require_bounds(arm: Arm) -> None:
    """Refuses what is no arm, and an arm without finite speed, acceleration and jerk limits.

    Args:
        arm: The arm.

    Raises:
        InputError: It is no arm, or a limit is infinite, so a time-optimal motion does not exist.
    """
    check_arm(arm)
    for name in ("v_max", "a_max", "j_max"):
        bound = getattr(arm.limits, name)
        if not np.isfinite(bound).all():
            joint = arm.joint_names[int(np.isinf(bound).argmax())]
            raise InputError(
                f"{name}: {joint} has no limit, and without one no time-optimal motion exists; give it a finite one"
            )


def start_velocity(arm: Arm, v_start: ArrayLike | None) -> Array:
    """A caller's start velocity, checked.

    Args:
        arm: The arm.
        v_start: (n,) rad/s, or None for rest.

    Returns:
        (n,) rad/s.

    Raises:
        InputError: A wrong length or a number that is not finite.
        LimitError: Faster than a joint may be.
    """
    if v_start is None:
        return np.zeros(arm.n)
    v = vector("v_start", v_start, arm.n)
    too_fast = np.abs(v) > arm.limits.v_max
    if too_fast.any():
        i = int(too_fast.argmax())
        name, unit = arm.joint_names[i], arm.units[i]
        raise LimitError(f"v_start: {name}: {v[i]:g} {unit}/s is outside +-{arm.limits.v_max[i]:g} {unit}/s")
    return v
