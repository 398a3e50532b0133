"""Computed torque: the model's inverse dynamics turn every joint into a unit mass, which a PD law controls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armctl.control import feedforward
from armctl.control.gains import DEFAULT_BANDWIDTH, MAX_BANDWIDTH, effective_inertia, floored_inertia
from armctl.control.interface import State, explains_wrong_arguments
from armctl.control.observer import DisturbanceObserver
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, choice, number
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

FORMS = ("discrete", "textbook")


@dataclass(frozen=True, slots=True, eq=False)
class _ExtraInertia:
    """Inertia, (n,) kg m^2, that the feedback adds to the model's, at a control period of dt."""

    dt: float
    inertia: Array


class ComputedTorque:
    """Computed torque (inverse dynamics control): tau = ID(q, v, a_ref + k_p (q_ref - q) + k_d (v_ref - v)).

    After Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2. Dry friction is fed
    forward at the velocity of the reference, so that measurement noise does not make it chatter. The feedback of a joint with
    negligible inertia is that of a joint with a small one (`gains.floored_inertia`).

    The discrete form (the default) inverts the plant's motion over one control period instead of the differential equation.
    Velocity and acceleration of the reference are differences on the tick grid. Damping is evaluated at the end of the step; if
    the plant moves continuously, the whole model is evaluated in the middle of the period. With an exact model only
    rounding errors remain. The textbook form has a tracking error of (k_d / k_p) (dt / 2) a_ref.

    Attributes:
        bandwidth: rad/s.
        damping_ratio: 1 is critically damped.
        form: "discrete" or "textbook".
        observer_bandwidth: rad/s of the disturbance observer; 0 without one.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        form: str = "discrete",
        observer_bandwidth: float = 0.0,
    ):
        """A computed torque controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            form: "discrete" or "textbook".
            observer_bandwidth: rad/s up to which unknown torques are estimated and cancelled; 0 for no observer.

        Raises:
            InputError: A gain is negative or not finite, the form is unknown, or the textbook form has an observer.
        """
        check_arm(arm)
        self.form = choice("form", form, FORMS)
        self.bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0, MAX_BANDWIDTH)
        self.observer_bandwidth = number("observer_bandwidth", observer_bandwidth, 0.0, MAX_BANDWIDTH)
        self.name = "computed-torque"
        self._observer = None
        self._is_textbook = self.form == "textbook"
        if self._is_textbook:
            self.name = "computed-torque-textbook"
            if self.observer_bandwidth:
                raise InputError("observer_bandwidth: the observer compares ticks, so it needs form='discrete'")
        elif self.observer_bandwidth:
            self.name = "computed-torque-observer"
            self._observer = DisturbanceObserver(arm, self.observer_bandwidth)
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._kp = np.full(arm.n, self.bandwidth**2)  # arrays times arrays are faster than floats times arrays
        self._kd = np.full(arm.n, 2 * self.damping_ratio * self.bandwidth)
        self._arm = arm
        self._min_inertia = effective_inertia(arm).min(axis=0)
        self._extra_inertia = self._extra_inertia_at(0.0)
        self._has_extra_inertia = bool(self._extra_inertia.inertia.any())

    @property
    def disturbance(self) -> Array:
        """The torque (n,) N m that the observer estimates; zero without an observer."""
        return np.zeros(self._arm.n) if self._observer is None else self._observer.estimate.copy()

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        modelled = state
        v_ref = setpoint.v_tick
        a_ref = setpoint.a_tick
        if self._is_textbook:
            modelled = state._replace(dt=0.0, continuous=False)
        if self._is_textbook or v_ref is None or a_ref is None:
            v_ref = setpoint.v
            a_ref = setpoint.a
        correction = self._kp * (setpoint.q - state.q) + self._kd * (v_ref - state.v)
        tau = feedforward.inverse_dynamics(self._dynamics, modelled, a_ref + correction)
        if self._has_extra_inertia:
            extra = self._extra_inertia
            if extra.dt != state.dt:
                extra = self._extra_inertia_at(state.dt)
                self._extra_inertia = extra
            tau = tau + extra.inertia * correction
        friction = feedforward.friction(self._dynamics, modelled, v_ref, a_ref) if self._dynamics.has_friction else None
        if self._observer is not None:
            tau = self._observer.corrected(tau, state, friction)
        return tau if friction is None else tau + friction

    def _extra_inertia_at(self, dt: float) -> _ExtraInertia:
        bandwidth = self.bandwidth * max(self.damping_ratio, 1.0)
        floored = floored_inertia(self._arm, self._min_inertia, self._min_inertia, bandwidth, dt)
        return _ExtraInertia(dt, floored - self._min_inertia)
