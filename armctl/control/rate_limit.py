"""TorqueRateLimit: bounds how fast the torques of another controller change."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.controller_around import ControllerAround
from armctl.control.gain_attribute import Gain, joint_gain
from armctl.control.interface import Controller
from armctl.core.validation import Array
from armctl.robot.arm import Arm


class TorqueRateLimit(ControllerAround):
    """A controller with limited torque rates, as the interfaces of many arms require.

    The first torque of a run is not limited.

    Attributes:
        tau_rate_max: (n,) N m/s.
    """

    tau_rate_max: Gain[Array] = joint_gain()

    def __init__(self, arm: Arm, controller: Controller, tau_rate_max: ArrayLike):
        """A controller with limited torque rates.

        Args:
            controller: The controller whose torques are limited.
            tau_rate_max: (n,) or one number for all joints, N m/s; 1000 N m/s is 1 N m a tick of 1 ms.
        """
        super().__init__(arm, controller)
        self.tau_rate_max = tau_rate_max

    def _around(self, inner: _core.Law, dt: float) -> _core.Law:
        return _core.TorqueRateLimit(inner, tau_rate_max=self.tau_rate_max, dt=dt)

    def _changed(self, tau: Array, dt: float, memory: Any) -> tuple[Array, Any]:
        if memory is not None:
            change = self.tau_rate_max * dt
            highest = memory + change
            lowest = memory - change
            tau = np.where(tau > highest, highest, np.where(tau < lowest, lowest, tau))
        return tau, tau.copy()
