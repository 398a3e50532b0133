"""Computed torque that learns a payload, dry friction and the delay of the motors while the arm moves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from armctl import _core
from armctl._core import BODY_PARAMETERS
from armctl.control.computed_torque_observer import ComputedTorqueObserver
from armctl.control.gain_attribute import Gain
from armctl.control.gains import MAX_BANDWIDTH
from armctl.control.task_space import arm_length
from armctl.core.defaults import MIN_DELAY_MARGIN_S
from armctl.core.errors import InputError
from armctl.core.validation import Array, number
from armctl.model.arm.arm import Arm

FILTER_BANDWIDTH = 60.0  # rad/s, of each of two low-passes; above most motion, and below the noise of measured accelerations
TORQUE_NOISE_SHARE = 0.01  # of the torque limits: standard deviation of torques that neither model nor payload explain
FORGETTING_RATE = 0.2  # 1/s, while the reference moves and the estimate explains the torques
PRIOR_MASS_SHARE = 0.5  # of the moving mass of the arm: standard deviation of the mass before any motion
PRIOR_DELAY_PERIODS = 2.0  # standard deviation of the delay of the motors, control periods
PRIOR_FRICTION_SHARE = 0.05  # of the torque limits: standard deviation of dry friction
PRIOR_LENGTH_SHARE = 0.1  # of the length of the arm: the distance of the payload from the tip in the prior


def _observer_bandwidth(name: str, value: Any, _n: int) -> float | None:
    if value is None:
        return None
    bandwidth = number(name, value, 0.0, MAX_BANDWIDTH)
    if bandwidth == 0.0:
        raise InputError(f"{name}: expected a number above 0, got 0; the controller learns from the observer's estimate")
    return bandwidth


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
    """

    name = "computed-torque-learning"
    observer_bandwidth: Gain[float | None] = Gain(_observer_bandwidth)

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float | None = None,
        damping_ratio: float | None = None,
        observer_bandwidth: float | None = None,
        delay_margin: float = MIN_DELAY_MARGIN_S,
    ):
        """A controller that learns the payload of an arm.

        Args:
            arm: The arm whose model it uses, without the payload.
            bandwidth: rad/s, the natural frequency of the error; by default it follows from the margins, like the others.
            damping_ratio: 1 is critically damped.
            observer_bandwidth: rad/s up to which torques that the payload does not explain are estimated and cancelled.
            delay_margin: s, of the gains that are not given: give a larger one if the delay of the robot is unknown.
        """
        super().__init__(
            arm,
            bandwidth=bandwidth,
            damping_ratio=damping_ratio,
            observer_bandwidth=observer_bandwidth,
            delay_margin=delay_margin,
        )
        self._prior = _prior_deviations(arm)

    @property
    def payload(self) -> Array:
        """The estimate of this run, (4,): mass, kg, and first moment m c in the tip's frame, kg m."""
        return self._estimate[:4]

    @property
    def delay(self) -> float:
        """The estimate of this run of the time, s, that passes until a torque acts."""
        return float(self._estimate[BODY_PARAMETERS])

    @property
    def friction(self) -> Array:
        """The estimate of this run of the dry friction, (n,) N m, besides that of the model."""
        return self._estimate[BODY_PARAMETERS + 1 :]

    @property
    def _estimate(self) -> Array:
        """(11 + n,) inertial parameters of the payload, delay and friction."""
        law = self._law
        return law.estimate.copy() if isinstance(law, _core.ComputedTorqueLearning) else np.zeros(BODY_PARAMETERS + 1 + self.n)

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        tau_max = self._arm.limits.tau_max
        deviations = [self._prior, [PRIOR_DELAY_PERIODS * dt], PRIOR_FRICTION_SHARE * tau_max]
        return _core.ComputedTorqueLearning(
            self._model(dt, continuous),
            **self._law_gains(dt, continuous),
            filter_weight=-math.expm1(-FILTER_BANDWIDTH * dt),
            # Filtered samples are correlated over two periods of the low-pass.
            information_weight=0.5 * FILTER_BANDWIDTH * dt,
            forgetting=FORGETTING_RATE * dt,
            torque_precision=1 / (TORQUE_NOISE_SHARE * tau_max),
            prior_deviations=np.concatenate(deviations),
        )


def _prior_deviations(arm: Arm) -> Array:
    """(10,) standard deviations of mass, first moments and second moments before any motion; kg, kg m and kg m^2."""
    moving = list(arm.pinocchio_model.pin_model.inertias)[1:]
    mass = PRIOR_MASS_SHARE * sum(body.mass for body in moving)
    length = PRIOR_LENGTH_SHARE * arm_length(arm)
    return mass * np.repeat([1.0, length, length**2], [1, 3, 6])
