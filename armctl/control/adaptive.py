"""Adaptive control: estimates the mass and the center of an unknown payload while the arm moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from armctl.control.arm_controller import ArmController
from armctl.control.gains import MAX_BANDWIDTH, sample_configurations
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

ADAPTIVE_BANDWIDTH = 24.0  # rad/s; at a higher one, the adaptation reaches its bound at control periods of 4 ms
# Regularization of the adaptation gain, relative to the observability of the mass. Less observable parameters adapt slower.
REGULARIZATION_RATIO = 0.1
TYPICAL_PAYLOAD_CENTER_M = 0.1  # the distance that converts the observability of a mass to that of a first moment
MIN_OBSERVABILITY = 1e-12  # m^2/s^4; below this, gravity does not reveal a payload: the value is rounding error
# Stiffness of the adaptation x dt / bandwidth. See `adaptive_kernel`.
MAX_ADAPTATION_PER_PERIOD = 0.25


class Adaptive(ArmController):
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
        super().__init__(arm)
        self.bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self.adaptation_rate = number("adaptation_rate", adaptation_rate, 0.0)
        self._observability = _observability(arm)

    @property
    def payload(self) -> Array:
        """The estimate of this run, (4,): mass, kg, and first moment m c in the tip's frame, kg m."""
        return self.memory[:4].copy()

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it."""
        from armctl.control.adaptive_kernel import adaptive

        return adaptive

    def _constants(self, dt: float, continuous: bool) -> Sequence[Array | Sequence[float]]:
        header = [dt, self.bandwidth, MAX_ADAPTATION_PER_PERIOD * self.bandwidth]
        start_model = self._arm.packed_dynamics.vector(0.0)
        return header, self._adaptation_gain().ravel(), self._arm.limits.tau_max, start_model

    def _own_memory_size(self) -> int:
        from armctl.control.adaptive_kernel import memory_size

        return memory_size(self.n)

    def _adaptation_gain(self) -> Array:
        """(4, 4), rate k (Y^T M^-1 Y)^-1 at rest: the error of the estimate decays at about the adaptation rate.

        The gain is zero if gravity does not reveal a payload, as without gravity or with vertical axes only.
        """
        diagonal = np.diag(self._observability)
        moment = max(diagonal[1:].max(), TYPICAL_PAYLOAD_CENTER_M**2 * diagonal[0])
        if moment < MIN_OBSERVABILITY:
            return np.zeros((4, 4))
        regularization = REGULARIZATION_RATIO * np.array([max(diagonal[0], moment), moment, moment, moment])
        gain = self.adaptation_rate * self.bandwidth * np.linalg.inv(self._observability + np.diag(regularization))
        return np.asarray(gain, dtype=np.float64)


def _observability(arm: Arm) -> Array:
    """(4, 4), the mean of Y^T M^-1 Y at rest over `sample_configurations`."""
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    zero = np.zeros(arm.n)
    configurations = sample_configurations(arm)
    total = np.zeros((4, 4))
    for q in configurations:
        Y = dynamics.payload_regressor(q, zero, zero)
        total += Y.T @ np.linalg.solve(dynamics.mass_matrix(q), Y)
    return total / len(configurations)
