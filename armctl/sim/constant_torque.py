"""ConstantTorque: a controller for open-loop runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import State
from armctl.core.errors import LimitError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, vector
from armctl.robot.arm import Arm

_CONTROL_TOLERANCE = 1e-9  # relative, for controls at a limit of their motor


class ConstantTorque:
    """A controller that returns the same torque, (n,) N m, at every tick, for open-loop runs."""

    name = "constant"

    def __init__(self, tau: Array):
        self.tau = tau

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque, (n,) N m."""
        return self.tau


def constant_controls(arm: Arm, ctrl: ArrayLike) -> ConstantTorque:
    """Constant controls (n,) of an arm's motors; LimitError for one outside its motor's range."""
    checked = vector("ctrl", ctrl, arm.n)
    bound = arm.limits.tau_max / np.abs(arm.gear)
    outside = np.abs(checked) > bound * (1 + _CONTROL_TOLERANCE)
    if outside.any():
        i = int(outside.argmax())
        raise LimitError(f"ctrl: {arm.joint_names[i]}: {checked[i]:g} is outside [{-bound[i]:g}, {bound[i]:g}]")
    return ConstantTorque(checked * arm.gear)
