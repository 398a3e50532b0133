"""Computed torque: the model's inverse dynamics make every joint a unit mass, and a PD law moves that."""

from __future__ import annotations

import math

import numpy as np

from armctl.control import feedforward as model
from armctl.control.gains import DEFAULT_BANDWIDTH, joint_inertia, raised
from armctl.control.interface import State
from armctl.control.observer import DisturbanceObserver
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

FORMS = ("discrete", "textbook")


class ComputedTorque:
    """Computed torque (inverse dynamics control): tau = ID(q, v, a_ref + k_p (q_ref - q) + k_d (v_ref - v)).

    After Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2. Dry friction is fed
    forward at the reference's velocity, so that measurement noise does not make it chatter. A joint with almost no inertia of
    its own gets the feedback of one that has a little (`gains.raised`).

    The discrete form (the default) inverts what the plant does over a control period instead of the differential equation: the
    reference's velocity and acceleration are differences on the tick grid, and damping is taken at the end of the step, or all
    in the middle of the period where the plant moves on continuously. With an exact model nothing is left but rounding. The
    textbook form is off by (k_d / k_p) (dt / 2) a_ref.

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
        """A computed-torque controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            form: "discrete" or "textbook".
            observer_bandwidth: rad/s up to which unknown torques are estimated and cancelled; 0 leaves them alone.

        Raises:
            InputError: A gain is negative or not finite, there is no such form, or a textbook form is to have an observer.
        """
        if form not in FORMS:
            raise InputError(f"form: {form!r} given, one of {', '.join(FORMS)} wanted")
        self.bandwidth = number("bandwidth", bandwidth, 0.0)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0)
        self.observer_bandwidth = number("observer_bandwidth", observer_bandwidth, 0.0)
        if self.observer_bandwidth and form == "textbook":
            raise InputError("observer_bandwidth: the observer compares ticks, so it needs form='discrete'")
        self.form = form
        self.name = "computed-torque" + ("-textbook" if form == "textbook" else "-observer" if observer_bandwidth else "")
        self._dynamics = Dynamics(arm)
        self._kp = np.full(arm.n, self.bandwidth**2)  # arrays times arrays are faster than floats times arrays
        self._kd = np.full(arm.n, 2 * self.damping_ratio * self.bandwidth)
        self._observer = DisturbanceObserver(arm, self.observer_bandwidth) if self.observer_bandwidth else None
        self._arm, self._inertia = arm, joint_inertia(arm).min(axis=0)
        self._is_raised = bool(self._raised(0.0).any())
        self._raise, self._raise_for = np.zeros(arm.n), math.nan

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        if self.form == "textbook":
            instant, v_ref, a_ref = state._replace(dt=0.0, continuous=False), setpoint.v, setpoint.a
        else:
            instant, (v_ref, a_ref) = state, model.sampled(setpoint)
        correction = self._kp * (setpoint.q - state.q) + self._kd * (v_ref - state.v)
        tau = model.inverse(self._dynamics, instant, a_ref + correction)
        if self._is_raised:
            if state.dt != self._raise_for:
                self._raise, self._raise_for = self._raised(state.dt), state.dt
            tau = tau + self._raise * correction
        friction = model.friction(self._dynamics, instant, v_ref, a_ref) if self._dynamics.has_friction else None
        if self._observer is not None:
            tau = self._observer.corrected(tau, state, friction)
        return tau if friction is None else tau + friction

    def _raised(self, dt: float) -> Array:
        """What joints of almost no inertia are taken to have besides their own, kg m^2."""
        bandwidth = self.bandwidth * max(self.damping_ratio, 1.0)
        return raised(self._arm, self._inertia, self._inertia, bandwidth, dt) - self._inertia
