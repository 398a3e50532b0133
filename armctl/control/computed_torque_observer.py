"""Computed torque with a disturbance observer that needs no velocity measurement."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from armctl.control.arm_controller import ArmController
from armctl.control.gains import MAX_BANDWIDTH
from armctl.control.observer_gains import (
    ObserverGains,
    low_pass_weight,
    observer_gains,
    position_weight,
    velocity_weight,
)
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm


class ComputedTorqueObserver(ArmController):
    """Computed torque with estimated velocities and disturbance torques d: tau = ID(q, v, a_ref + k_p e + k_d e_dot) - d.

    The commanded acceleration predicts position and velocity, and the measured position corrects both, so that the noise of
    encoders has little effect on the torques. The observer cancels all torques that the
    model does not explain. Default gains suppress disturbances as well as a delay margin of 5 ms (and of 2.5 control periods)
    and a peak sensitivity of 1.7 permit, and are stable with unknown payloads (`observer_gains`), so they depend on the control
    period. `armctl info` prints the payload that they tolerate.

    Attributes:
        bandwidth: rad/s of the feedback; None if it follows from the margins.
        damping_ratio: Of the feedback; None if it follows from the margins.
        observer_bandwidth: rad/s up to which unknown torques are cancelled; None if it follows from the margins.
    """

    name = "computed-torque-observer"

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float | None = None,
        damping_ratio: float | None = None,
        observer_bandwidth: float | None = None,
    ):
        """A computed torque controller with an observer for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the error; by default it follows from the margins, like the others.
            damping_ratio: 1 is critically damped.
            observer_bandwidth: rad/s up to which unknown torques are cancelled.

        Raises:
            InputError: A gain is negative or not finite.
        """
        super().__init__(arm)
        self.bandwidth = _optional("bandwidth", bandwidth)
        self.damping_ratio = _optional("damping_ratio", damping_ratio)
        self.observer_bandwidth = _optional("observer_bandwidth", observer_bandwidth)

    @property
    def disturbance(self) -> Array:
        """The torque (n,) N m that the observer estimates."""
        from armctl.control.computed_torque_observer_kernel import estimate

        return estimate(self.memory, self.n).copy()

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it."""
        from armctl.control.computed_torque_observer_kernel import computed_torque_observer

        return computed_torque_observer

    def _own_memory_size(self) -> int:
        from armctl.control.computed_torque_observer_kernel import memory_size

        return memory_size(self.n)

    def _constants(self, dt: float, continuous: bool) -> Sequence[Array | Sequence[float]]:
        default = observer_gains(self._arm, dt)
        gains = ObserverGains(
            feedback=default.feedback if self.bandwidth is None else self.bandwidth,
            damping_ratio=default.damping_ratio if self.damping_ratio is None else self.damping_ratio,
            estimate=default.estimate,
            disturbance=default.disturbance if self.observer_bandwidth is None else self.observer_bandwidth,
        )
        header = [
            dt,
            0.5 if continuous else 1.0,
            position_weight(gains.estimate, dt),
            velocity_weight(gains.estimate, dt),
            low_pass_weight(gains.disturbance, dt),
        ]
        stiffness = np.full(self.n, gains.feedback**2)
        damping = np.full(self.n, 2 * gains.damping_ratio * gains.feedback)
        return header, stiffness, damping, self._arm.limits.tau_max


def _optional(name: str, value: float | None) -> float | None:
    return None if value is None else number(name, value, 0.0, MAX_BANDWIDTH)
