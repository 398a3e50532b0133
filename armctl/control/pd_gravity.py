"""PD and PID with gravity compensation: the arm's weight from the model, all else from feedback."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from armctl.control.gains import DEFAULT_BANDWIDTH, gain, locked_inertia
from armctl.control.interface import Clock, State
from armctl.control.pd import PD
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

_INTEGRAL_SHARE = 0.25  # of the fastest integral that a joint bears: a spring, a damper and a mass bear Kp Kd / m


class PDGravity(PD):
    """PD with gravity compensation: tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v).

    After Takegaki and Arimoto, "A new feedback method for dynamic control of manipulators" (1981): the arm comes to rest
    exactly where it should, as far as the model's weight is right. In motion it lags.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
    """

    name = "pd-gravity"

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self._arm)

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        return super().torque(state, setpoint) + self._dynamics.gravity(state.q)


class PIDGravity(PDGravity):
    """PID with gravity compensation: as PD with gravity, and the integral of the error takes what the model does not know.

    Anti-windup by conditional integration (Astrom and Hagglund, Advanced PID Control, 2006, 3.5): a joint does not integrate
    while its motor is at its limit and the error would push it further. The integral starts at zero, and afresh with each run.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
        integral_gain: (n,) N m/(rad s) (Ki).
    """

    name = "pid-gravity"

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        stiffness: Array | None = None,
        damping: Array | None = None,
        integral_gain: Array | None = None,
    ):
        """A PID controller with gravity compensation for an arm.

        Args:
            arm: The arm whose model tells its weight, and its torque limits.
            bandwidth: rad/s, the natural frequency of each joint's closed loop.
            damping_ratio: 1 is critically damped.
            stiffness: (n,) N m/rad, instead of the bandwidth.
            damping: (n,) N m s/rad, instead of the damping ratio.
            integral_gain: (n,) N m/(rad s), instead of a quarter of stiffness x damping / the most inertia that a joint moves.

        Raises:
            InputError: A gain is negative, not finite or of the wrong length.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio, stiffness=stiffness, damping=damping)
        default = _INTEGRAL_SHARE * self.stiffness * self.damping / locked_inertia(self._dynamics)
        self.integral_gain = gain("integral_gain", default if integral_gain is None else integral_gain, arm.n)
        self._tau_max = arm.limits.tau_max
        self._clock, self._integral = Clock(), np.zeros(arm.n)

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        if not self._clock.follows(state):
            self._integral = np.zeros_like(self._integral)
        tau = super().torque(state, setpoint) + self._integral
        push = self.integral_gain * (setpoint.q - state.q)
        winds_up = (np.abs(tau) >= self._tau_max) & (push * tau > 0.0)
        self._integral = self._integral + np.where(winds_up, 0.0, state.dt * push)
        return tau
