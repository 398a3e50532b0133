"""Computed torque that learns a payload, dry friction and the delay of the motors while the arm moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from armctl.control.computed_torque_observer import ComputedTorqueObserver
from armctl.control.task_space import arm_length
from armctl.core.errors import InputError
from armctl.core.validation import Array
from armctl.robot.arm import Arm

FILTER_BANDWIDTH = 60.0  # rad/s, of each of two low-passes; above most motion, and below the noise of measured accelerations
TORQUE_NOISE_SHARE = 0.01  # of the torque limits: standard deviation of torques that neither model nor payload explain
FORGETTING_RATE = 0.2  # 1/s, while the reference moves and the estimate explains the torques
PRIOR_MASS_SHARE = 0.5  # of the moving mass of the arm: standard deviation of the mass before any motion
PRIOR_DELAY_PERIODS = 2.0  # standard deviation of the delay of the motors, control periods
PRIOR_FRICTION_SHARE = 0.05  # of the torque limits: standard deviation of dry friction
PRIOR_LENGTH_SHARE = 0.1  # of the length of the arm: the distance of the payload from the tip in the prior


class ComputedTorqueLearning(ComputedTorqueObserver):
    """Computed torque with a disturbance observer, which learns payload, friction and delay, and feeds them forward.

        tau = computed torque with observer + Y(q_ref, v_ref, a_ref) theta + friction sign(v_ref) + T tau_ref'

    theta are the ten inertial parameters of a rigid body at the tip, friction is the dry friction of each joint that the model
    does not contain, T is the delay of the motors, and tau_ref' the rate of the torque that the reference needs. They are
    estimated by recursive Bayesian least squares (Ljung, System Identification, 1999, 11.2) from the torque that the model does
    not explain. The regressor of the body is by Atkeson, An, Hollerbach, "Estimation of inertial parameters of manipulator
    loads and links" (1986). Only torques along the reference are fed forward, and the observer is corrected for every change of
    the estimate. At rest the estimate has therefore no effect on the loop, whose margins are those of computed torque with the
    same observer. The estimate changes only while the reference moves, and it starts at zero in each run.

    Attributes:
        bandwidth: rad/s of the feedback; None if it follows from the margins.
        damping_ratio: Of the feedback; None if it follows from the margins.
        observer_bandwidth: rad/s up to which other unknown torques are cancelled; None if it follows from the margins.
    """

    name = "computed-torque-learning"

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float | None = None,
        damping_ratio: float | None = None,
        observer_bandwidth: float | None = None,
    ):
        """A controller that learns the payload of an arm.

        Args:
            arm: The arm whose model it uses, without the payload.
            bandwidth: rad/s, the natural frequency of the error; by default it follows from the margins, like the others.
            damping_ratio: 1 is critically damped.
            observer_bandwidth: rad/s up to which torques that the payload does not explain are estimated and cancelled.

        Raises:
            InputError: A gain is negative or not finite, or the observer's bandwidth is zero.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio, observer_bandwidth=observer_bandwidth)
        if self.observer_bandwidth == 0.0:
            raise InputError(
                "observer_bandwidth: expected a number above 0, got 0; the controller learns from the observer's estimate"
            )
        self._prior = _prior_deviations(arm)

    @property
    def payload(self) -> Array:
        """The estimate of this run, (4,): mass, kg, and first moment m c in the tip's frame, kg m."""
        return self.memory[:4].copy()

    @property
    def delay(self) -> float:
        """The estimate of this run of the time, s, that passes until a torque acts."""
        from armctl.control.payload_kernel import DELAY

        return float(self.memory[DELAY])

    @property
    def friction(self) -> Array:
        """The estimate of this run of the dry friction, (n,) N m, besides that of the model."""
        from armctl.control.payload_kernel import FRICTION

        return self.memory[FRICTION : FRICTION + self.n].copy()

    @property
    def disturbance(self) -> Array:
        """The torque (n,) N m that the observer estimates besides what is learnt."""
        from armctl.control.computed_torque_observer_kernel import estimate, memory_size

        size = memory_size(self.n) + self._arm.packed_dynamics.work_size()
        return estimate(self.memory[-size:], self.n).copy()

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it."""
        from armctl.control.computed_torque_learning_kernel import computed_torque_learning

        return computed_torque_learning

    def _own_memory_size(self) -> int:
        from armctl.control.computed_torque_learning_kernel import memory_size

        return memory_size(self.n)

    def _constants(self, dt: float, continuous: bool) -> Sequence[Array | Sequence[float]]:
        filter_weight = -math.expm1(-FILTER_BANDWIDTH * dt)
        information_weight = 0.5 * FILTER_BANDWIDTH * dt  # filtered samples are correlated over two periods of the low-pass
        rates = [filter_weight, information_weight, FORGETTING_RATE * dt]
        tau_max = self._arm.limits.tau_max
        deviations = [self._prior, [PRIOR_DELAY_PERIODS * dt], PRIOR_FRICTION_SHARE * tau_max]
        return rates, 1 / (TORQUE_NOISE_SHARE * tau_max), *deviations, *super()._constants(dt, continuous)


def _prior_deviations(arm: Arm) -> Array:
    """(10,) standard deviations of mass, first moments and second moments before any motion; kg, kg m and kg m^2."""
    moving = list(arm.pinocchio_model.pin_model.inertias)[1:]
    mass = PRIOR_MASS_SHARE * sum(body.mass for body in moving)
    length = PRIOR_LENGTH_SHARE * arm_length(arm)
    return mass * np.repeat([1.0, length, length**2], [1, 3, 6])
