"""Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls."""

from __future__ import annotations

import numpy as np

from armctl import _core
from armctl.control.arm_controller import ArmController
from armctl.control.gain_attribute import Gain, scalar_gain, word
from armctl.control.gains import DEFAULT_BANDWIDTH, extra_inertia
from armctl.control.integral_gains import IntegralGains, integral_gains
from armctl.control.interface import checked_period
from armctl.control.observer_gains import max_inertia_ratio
from armctl.core.errors import InputError
from armctl.core.validation import Array, flag
from armctl.robot.arm import Arm

FORMS = ("discrete", "textbook")
DEFAULT_DELAY_MARGIN_S = 5e-3


class ComputedTorque(ArmController):
    """Computed torque (inverse dynamics control): tau = ID(q, v, a_ref + k_p (q_ref - q) + k_d (v_ref - v)).

    After Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2. Dry friction is fed
    forward at the velocity of the reference, so that measurement noise does not cause chatter. The feedback of a joint with
    negligible inertia is that of a joint with a small one (`gains.extra_inertia`).

    The discrete form (the default) inverts the plant's motion over one control period instead of the differential equation.
    Velocity and acceleration of the reference are differences on the tick grid. Damping is evaluated at the end of the step; if
    the plant moves continuously, the whole model is evaluated in the middle of the period. With an exact model only
    rounding errors remain. The textbook form has a tracking error of (k_d / k_p) (dt / 2) a_ref.

    With integral action, the acceleration also contains the integral of the error, so unknown constant torques leave no error.
    All three gains are then the linear-quadratic optimal ones with a given delay margin (`integral_gains`), and stable with
    unknown payloads, of which `armctl info` prints the mass. A joint does not integrate while its motor is at its limit and the
    error has the same sign. The integral starts at zero in each run.

    Attributes:
        bandwidth: rad/s; not used with integral action.
        damping_ratio: 1 is critically damped; not used with integral action.
        form: "discrete" or "textbook".
        integral: Whether there is integral action.
        delay_margin: s, that of the loop with integral action, or two and a half control periods if they are longer.
    """

    bandwidth: Gain[float] = scalar_gain()
    damping_ratio: Gain[float] = scalar_gain()
    form: Gain[str] = word(FORMS)
    integral: Gain[bool] = Gain(lambda name, value, _n: flag(name, value))
    delay_margin: Gain[float] = scalar_gain(1e-6, 10.0)

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        form: str = "discrete",
        integral: bool = False,
        delay_margin: float = DEFAULT_DELAY_MARGIN_S,
    ):
        """A computed torque controller for an arm.

        Args:
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            form: "discrete" or "textbook".
            integral: Whether to add integral action. The gains then follow from the delay margin.
            delay_margin: s, for the gains with integral action.

        Raises:
            InputError: A gain is negative or not finite, the form is unknown, or integral action is combined with a bandwidth
                or the textbook form.
        """
        super().__init__(arm)
        self.form = form
        self.bandwidth = bandwidth
        self.damping_ratio = damping_ratio
        self.integral = integral
        self.delay_margin = delay_margin
        self.name = "computed-torque"
        if self.integral:
            self.name = "computed-torque-integral"
            if self.form == "textbook":
                raise InputError("integral: it needs form='discrete'")
            if (self.bandwidth, self.damping_ratio) != (DEFAULT_BANDWIDTH, 1.0):
                raise InputError("bandwidth: with integral=True, all gains follow from delay_margin; leave the others out")
        elif self.form == "textbook":
            self.name = "computed-torque-textbook"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run."""
        gains = self.gains_at(dt, continuous)
        is_textbook = self.form == "textbook"
        return _core.ComputedTorque(
            self._arm.core_model if is_textbook else self._model(dt, continuous),
            stiffness=gains.kp,
            damping=gains.kd,
            integral_gain=gains.ki,
            added_inertia=self.added_inertia(dt),
            torque_limit=self._arm.limits.tau_max,
            textbook=is_textbook,
            dt=dt,
        )

    def gains_at(self, dt: float, continuous: bool) -> IntegralGains:
        """The gains for a control period.

        Args:
            dt: s, the control period; 0 means continuous time.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            The gains that all joints share.

        Raises:
            InputError: The control period is no number in [0, 1] s, or `continuous` is not True or False.
        """
        dt, continuous = checked_period(dt, continuous)
        if self.integral:
            return integral_gains(dt, self.delay_margin, continuous, max_inertia_ratio(self._arm))
        return IntegralGains(self.bandwidth**2, 2 * self.damping_ratio * self.bandwidth, 0.0)

    def added_inertia(self, dt: float) -> Array:
        """The inertia with which the feedback of joints of negligible inertia acts.

        Args:
            dt: s, the control period; 0 means continuous time.

        Returns:
            (n,) kg m^2.

        Raises:
            InputError: The control period is no number in [0, 1] s.
        """
        dt, _ = checked_period(dt, False)
        return np.zeros(self.n) if self.integral else extra_inertia(self._arm, self.bandwidth, self.damping_ratio, dt)
