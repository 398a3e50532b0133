"""Adaptive control: estimates the mass and the center of an unknown payload while the arm moves."""

from __future__ import annotations

import numpy as np

from armctl.control import feedforward
from armctl.control.gains import MAX_BANDWIDTH, sample_configurations
from armctl.control.interface import Clock, State, explains_wrong_arguments
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

ADAPTIVE_BANDWIDTH = 24.0  # rad/s; at a higher one, the adaptation reaches its bound at control periods of 4 ms
# Regularization of the adaptation gain, relative to the observability of the mass. Less observable parameters adapt slower.
REGULARIZATION_RATIO = 0.1
TYPICAL_PAYLOAD_CENTER_M = 0.1  # the distance that converts the observability of a mass to that of a first moment
MIN_OBSERVABILITY = 1e-12  # m^2/s^4; below this, gravity does not reveal a payload: the value is rounding error
# Stiffness of the adaptation x dt / bandwidth. See `Adaptive._slowdown`.
MAX_ADAPTATION_PER_PERIOD = 0.25


class Adaptive:
    """Passivity-based adaptive control of an arm with an unknown point mass at its tip.

    With e = q_ref - q and s = e_dot + bandwidth e,

        tau = M (a_ref + bandwidth e_dot + bandwidth s) + (C + D) (v + s) + g + Y theta, theta_dot = gain Y^T s,

    after Slotine and Li, "On the adaptive control of robot manipulators" (1987), with the joint damping D. The most frequent
    unknown of an arm is its payload, and the torque is linear in four numbers of it. Once estimated, they are correct at any
    speed and in any configuration, whereas an observer or an integral term must follow a torque that changes all the time. The
    law uses no measured acceleration, so it tolerates noise and delay, and its stability is proven. It does not estimate
    friction; use a disturbance observer for that.

    Attributes:
        bandwidth: rad/s, of the error.
        adaptation_rate: 1/s, the rate of the estimation.
        payload: (4,) the estimate: mass, kg, and first moment m c in the tip's frame, kg m.
    """

    name = "adaptive"

    def __init__(self, arm: Arm, *, bandwidth: float = ADAPTIVE_BANDWIDTH, adaptation_rate: float = 10.0):
        """An adaptive controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the error.
            adaptation_rate: 1/s, the approximate rate of the estimation; 0 disables it.

        Raises:
            InputError: A gain is negative or not finite.
            ModelError: A joint of the arm follows another one.
        """
        check_arm(arm)
        self.bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self.adaptation_rate = number("adaptation_rate", adaptation_rate, 0.0)
        self.payload = np.zeros(4)
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._clock = Clock()
        self._zero = np.zeros(arm.n)
        self._tau_max = arm.limits.tau_max
        self._gain = self._adaptation_gain(arm)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        q = state.q
        v = state.v
        v_ref, a_ref = feedforward.sampled(setpoint)
        error_rate = v_ref - v
        correction = self.bandwidth * (setpoint.q - q)
        s = error_rate + correction
        a = a_ref + self.bandwidth * (error_rate + s)
        Y = self._regressor(q, v, v + s, a)
        if not self._clock.follows(state):
            self.payload = np.zeros(4)
        tau = feedforward.inverse_dynamics_with_friction(self._dynamics, state, a, v_ref, a_ref)
        tau = tau + self._dynamics.coriolis_product(q, v, s) + self._dynamics.damping * correction + Y @ self.payload
        if (np.abs(tau) < self._tau_max).all():  # the effect of the payload is not measurable while a motor is at its limit
            self.payload = self.payload + state.dt * self._slowdown(q, Y, state.dt) * (self._gain @ (Y.T @ s))
        return tau

    def _slowdown(self, q: Array, Y: Array, dt: float) -> float:
        """A factor of at most 1 that keeps the adaptation stable in fast motions, where the regressor Y is large.

        Estimate and s form an oscillator of stiffness Y gain Y^T and damping bandwidth. Sampled at dt it is stable while
        stiffness x dt < bandwidth.
        """
        stiffness = np.trace(self._gain @ Y.T @ np.linalg.solve(self._dynamics.mass_matrix(q), Y))
        limit = MAX_ADAPTATION_PER_PERIOD * self.bandwidth
        return limit / max(limit, float(stiffness) * dt, np.finfo(float).tiny)

    def _regressor(self, q: Array, v: Array, v_r: Array, a_r: Array) -> Array:
        """(n, 4) Y of M a_r + C(q, v) v_r + g of the payload, C by Christoffel's symbols (polarization, as in `Dynamics`)."""
        regressor = self._dynamics.payload_regressor
        zero = self._zero
        return regressor(q, zero, a_r) + 0.25 * (regressor(q, v + v_r, zero) - regressor(q, v - v_r, zero))

    def _adaptation_gain(self, arm: Arm) -> Array:
        """(4, 4), rate k (Y^T M^-1 Y)^-1 at rest: the error of the estimate decays at about the adaptation rate.

        The gain is zero if gravity does not reveal a payload, as without gravity or with vertical axes only.
        """
        zero = self._zero
        configurations = sample_configurations(arm)
        observability = np.zeros((4, 4))
        for q in configurations:
            Y = self._dynamics.payload_regressor(q, zero, zero)
            observability += Y.T @ np.linalg.solve(self._dynamics.mass_matrix(q), Y)
        observability /= len(configurations)
        diagonal = np.diag(observability)
        moment = max(diagonal[1:].max(), TYPICAL_PAYLOAD_CENTER_M**2 * diagonal[0])
        if moment < MIN_OBSERVABILITY:
            return np.zeros((4, 4))
        regularization = REGULARIZATION_RATIO * np.array([max(diagonal[0], moment), moment, moment, moment])
        gain = self.adaptation_rate * self.bandwidth * np.linalg.inv(observability + np.diag(regularization))
        return np.asarray(gain, dtype=np.float64)
