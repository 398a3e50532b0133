"""Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls."""

from __future__ import annotations

import numpy as np

from armctl import _core
from armctl.control.gain_attribute import Gain, choice_gain, optional_gain, scalar_gain
from armctl.control.gains import extra_inertia
from armctl.control.interface import ArmController, checked_period
from armctl.control.observer_gains import estimate_weights, feedback_estimate
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

FORMS = ("discrete", "textbook")


class ComputedTorque(ArmController):
    """Computed torque (inverse dynamics control): tau = ID(q, v, a_ref + k_p (q_ref - q) + k_d (v_ref - v)).

    After Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2. Dry friction is fed
    forward at the velocity of the reference, so that measurement noise does not cause chatter.

    The discrete form (the default) adds the feedback torque (D + 2 z w E) (e_dot + w e), with the damping D of the joints, the
    bandwidth w, the damping ratio z, and an inertia E of joints whose own is negligible (`gains.extra_inertia`): such a joint
    would yield to any friction. No error decays more slowly than by the formula, apart from a
    fifth that the estimate may take: with z = 1, the slowest pole is -w.

    It inverts the plant's motion over one control period instead of the differential equation.
    Velocity and acceleration of the reference are differences on the tick grid. Damping is evaluated at the end of the step; if
    the plant moves continuously, the whole model is evaluated in the middle of the period. With an exact model only
    rounding errors remain. Position and velocity are estimated: the commanded acceleration predicts them, and the measured
    position corrects both, so a velocity that is differenced from encoder positions causes little torque noise. The velocity is
    measured at the first tick only.

    The textbook form is the formula, to rounding. Its price is margins: it compensates damping at the measured velocity, which
    is late. On an arm with large damping and small inertia it may oscillate or be unstable, and its delay margin may be below
    the one that the default form is designed for; `armctl.margins` computes those of both. It has a tracking error of
    (k_d / k_p) (dt / 2) a_ref.
    """

    bandwidth: Gain[float] = scalar_gain()
    damping_ratio: Gain[float] = scalar_gain()
    estimate_bandwidth: Gain[float | None] = optional_gain()
    form: Gain[str] = choice_gain(FORMS)

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        estimate_bandwidth: float | None = None,
        form: str = "discrete",
    ):
        """A computed torque controller for an arm.

        Args:
            bandwidth: rad/s, the natural frequency of the error, by the formula.
            damping_ratio: 1 is critically damped.
            estimate_bandwidth: rad/s, of the estimated position and velocity; by default at least five times `bandwidth`. A
                lower one causes less torque noise, a higher one less delay. The textbook form has none.
            form: "discrete" or "textbook".
        """
        super().__init__(arm)
        self.form = form
        self.bandwidth = bandwidth
        self.damping_ratio = damping_ratio
        self.estimate_bandwidth = estimate_bandwidth
        self.name = "computed-torque" if self.form == "discrete" else "computed-torque-textbook"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        is_textbook = self.form == "textbook"
        estimate = (
            feedback_estimate(self._arm, dt, self.bandwidth) if self.estimate_bandwidth is None else self.estimate_bandwidth
        )
        estimate = 0.0 if is_textbook else estimate
        return _core.ComputedTorque(
            self._arm.core_model if is_textbook else self._model(dt, continuous),
            stiffness=self.bandwidth**2,
            damping=2 * self.damping_ratio * self.bandwidth,
            added_damping=self._added_damping(dt),
            decay_rate=self.bandwidth,
            **estimate_weights(estimate, dt),
            torque_limit=self._arm.limits.tau_max,
            textbook=is_textbook,
            dt=dt,
            continuous=continuous,
        )

    def added_inertia(self, dt: float) -> Array:
        """The inertia that the feedback adds to joints of negligible inertia; none in the textbook form.

        Args:
            dt: s, the control period; 0 means continuous time.

        Returns:
            (n,) kg m^2.
        """
        dt, _ = checked_period(dt, False)
        if self.form == "textbook":
            return np.zeros(self.n)
        return extra_inertia(self._arm, self.bandwidth, self.damping_ratio, dt)

    def _added_damping(self, dt: float) -> Array:
        """(n,) N m s/rad, what the damping of the feedback gives the added inertia."""
        return 2 * self.damping_ratio * self.bandwidth * self.added_inertia(dt)
