"""Computed torque with a disturbance observer that needs no velocity measurement."""

from __future__ import annotations

import numpy as np

from armctl import _core
from armctl.control.gain_attribute import Gain, optional_gain, scalar_gain
from armctl.control.gains import DELAY_MARGINS_S
from armctl.control.interface import ArmController
from armctl.control.observer_gains import EstimateWeights, ObserverGains, estimate_weights, low_pass_weight, observer_gains
from armctl.core.defaults import MIN_DELAY_MARGIN_S
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

_OBSERVERS = (_core.ComputedTorqueObserver, _core.ComputedTorqueLearning)  # laws that estimate a disturbance


class _ObserverLawGains(EstimateWeights):
    """The gains of a compiled law with an observer."""

    stiffness: float
    damping: float
    disturbance_weight: float
    torque_limit: Array
    dt: float
    continuous: bool


class ComputedTorqueObserver(ArmController):
    """Computed torque with estimated velocities and disturbance torques d: tau = ID(q, v, a_ref + k_p e + k_d e_dot) - d.

    The commanded acceleration predicts position and velocity, and the measured position corrects both, so that the noise of
    encoders has little effect on the torques. The observer cancels all torques that the model does not explain. Default gains,
    which are None as attributes, suppress disturbances as well as a delay margin of 5 ms (and of 2.5 control periods) and a
    peak sensitivity of 1.7 permit, and are stable with unknown payloads (`observer_gains`), so they depend on the control
    period. `armctl info` prints the payload that they tolerate.
    """

    name = "computed-torque-observer"
    bandwidth: Gain[float | None] = optional_gain()
    damping_ratio: Gain[float | None] = optional_gain()
    observer_bandwidth: Gain[float | None] = optional_gain()
    delay_margin: Gain[float] = scalar_gain(*DELAY_MARGINS_S)

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float | None = None,
        damping_ratio: float | None = None,
        observer_bandwidth: float | None = None,
        delay_margin: float = MIN_DELAY_MARGIN_S,
    ):
        """A computed torque controller with an observer for an arm.

        Args:
            bandwidth: rad/s, the natural frequency of the error; by default it follows from the margins, like the others.
            damping_ratio: 1 is critically damped.
            observer_bandwidth: rad/s up to which unknown torques are cancelled.
            delay_margin: s, of the gains that are not given: give a larger one if the delay of the robot is unknown.
        """
        super().__init__(arm)
        self.bandwidth = bandwidth
        self.damping_ratio = damping_ratio
        self.observer_bandwidth = observer_bandwidth
        self.delay_margin = delay_margin

    @property
    def disturbance(self) -> Array:
        """The torque (n,) N m that the observer estimates."""
        law = self._law
        return law.disturbance.copy() if isinstance(law, _OBSERVERS) else np.zeros(self.n)

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        return _core.ComputedTorqueObserver(self._model(dt, continuous), **self._law_gains(dt, continuous))

    def _law_gains(self, dt: float, continuous: bool) -> _ObserverLawGains:
        gains = self._gains_at(dt)
        return {
            "stiffness": gains.feedback**2,
            "damping": 2 * gains.damping_ratio * gains.feedback,
            **estimate_weights(gains.estimate, dt),
            "disturbance_weight": low_pass_weight(gains.disturbance, dt),
            "torque_limit": self._arm.limits.tau_max,
            "dt": dt,
            "continuous": continuous,
        }

    def _gains_at(self, dt: float) -> ObserverGains:
        default = observer_gains(self._arm, dt, self.delay_margin)
        return ObserverGains(
            feedback=default.feedback if self.bandwidth is None else self.bandwidth,
            damping_ratio=default.damping_ratio if self.damping_ratio is None else self.damping_ratio,
            estimate=default.estimate,
            disturbance=default.disturbance if self.observer_bandwidth is None else self.observer_bandwidth,
        )
