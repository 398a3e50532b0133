"""SimulatedMotors: the motors of a simulated robot that takes torques."""

from __future__ import annotations

import numpy as np

from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.run.links.added_torque import AddedTorque
from armctl.run.links.torque_interface import TorqueInterface

_RATE_TOLERANCE = 1e-6  # relative


class SimulatedMotors:
    """Motors that give the torques which were sent, filtered, and what the maker adds; they refuse what is not allowed."""

    def __init__(self, arm: Arm, interface: TorqueInterface, dt: float):
        """Motors of an arm with a tick of dt s."""
        self.arrived = np.zeros(arm.n)  # (n,) N m, the torques that arrived last
        self._interface = interface
        self._maker = AddedTorque(arm, interface)
        self._sent = self.arrived  # (n,) N m, the torques that were sent last
        self._filtered = self.arrived
        self._kept = np.exp(-dt / interface.lag) if interface.lag else 0.0  # of the filter's torque after a tick
        self._step_max = dt * interface.rate_limits * (1.0 + _RATE_TOLERANCE)

    def begin(self, tau: Array, state: State) -> None:
        """Goes on with the torques of the joints in a state."""
        self.arrived = tau - self._maker.at(state.q, state.v)
        self._sent = self.arrived
        self._filtered = self.arrived

    def refusal(self, tau: Array) -> str:
        """Why torques that are sent are refused; empty if they are not."""
        step = np.abs(tau - self._sent) - self._step_max
        excess = np.abs(tau) - self._interface.torque_limits
        self._sent = tau
        if step.max() > 0.0:
            return f"the torque of joint {int(step.argmax()) + 1} changes faster than the robot allows"
        if excess.max() > 0.0:
            return f"the torque of joint {int(excess.argmax()) + 1} is greater than the robot allows"
        return ""

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque of the motors in the coming tick; the setpoint has no effect."""
        self._filtered = self._kept * self._filtered + (1.0 - self._kept) * self.arrived
        return self._filtered + self._maker.at(state.q, state.v)
