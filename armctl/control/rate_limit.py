"""TorqueRateLimit: bounds how fast the torques of another controller change."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.gains import gain
from armctl.control.interface import Clock, Controller, State, controller_name, explains_wrong_arguments
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, shown
from armctl.robot.arm import Arm, check_arm


class TorqueRateLimit:
    """A controller with limited torque rates, as the interfaces of many arms require.

    The first torque of a run is not limited.

    Attributes:
        controller: The controller whose torques are limited.
        tau_rate_max: (n,) N m/s.
        name: The name of the controller.
        needs_wrench: Whether the controller needs the wrench.
    """

    def __init__(self, arm: Arm, controller: Controller, tau_rate_max: ArrayLike):
        """A controller with limited torque rates.

        Args:
            arm: The arm.
            controller: The controller whose torques are limited.
            tau_rate_max: (n,) or one number for all joints, N m/s; 1000 N m/s is 1 N m a tick of 1 ms.

        Raises:
            InputError: It is no controller, or a rate is negative, not finite or of the wrong length.
        """
        check_arm(arm)
        if not callable(getattr(controller, "torque", None)):
            raise InputError(f"controller: {shown(controller)} has no method torque; armctl.PD(arm) is one")
        self.controller = controller
        self.tau_rate_max = gain("tau_rate_max", tau_rate_max, arm.n)
        self.name = controller_name(controller)
        self.needs_wrench = bool(getattr(controller, "needs_wrench", False))
        self._clock = Clock()
        self._last = np.zeros(arm.n)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        tau = self.controller.torque(state, setpoint)
        if self._clock.follows(state):
            step = self.tau_rate_max * state.dt
            tau = np.clip(tau, self._last - step, self._last + step)
        self._last = np.array(tau)
        return tau
