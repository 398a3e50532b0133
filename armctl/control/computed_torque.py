"""Computed torque: the model's inverse dynamics make every joint a unit mass, and a PD law moves that."""

from __future__ import annotations

from armctl.arm import Arm
from armctl.arrays import Array, number
from armctl.control.contract import State
from armctl.control.gains import DEFAULT_BANDWIDTH
from armctl.dynamics import Dynamics
from armctl.errors import InputError
from armctl.trajectory import Setpoint

FORMS = ("discrete", "textbook")


class ComputedTorque:
    """Computed torque (inverse dynamics control): tau = ID(q, v, a_ref + k_p (q_ref - q) + k_d (v_ref - v)).

    After Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control (2009), 8.5.2. Dry friction is fed
    forward at the reference's velocity, so that measurement noise does not make it chatter.

    The discrete form (the default) inverts the simulator's step instead of the differential equation: the reference's velocity
    and acceleration are differences on the tick grid, and damping is taken at the end of the step. With an exact model nothing
    is left but rounding. The textbook form is off by (k_d / k_p) (dt / 2) a_ref.

    Attributes:
        bandwidth: rad/s.
        damping_ratio: 1 is critically damped.
        form: "discrete" or "textbook".
    """

    def __init__(self, arm: Arm, *, bandwidth: float = DEFAULT_BANDWIDTH, damping_ratio: float = 1.0, form: str = "discrete"):
        """A computed-torque controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            form: "discrete" or "textbook".

        Raises:
            InputError: A gain is negative or not finite, or there is no such form.
        """
        if form not in FORMS:
            raise InputError(f"form: {form!r} given, one of {', '.join(FORMS)} wanted")
        self.bandwidth = number("bandwidth", bandwidth, 0.0)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0)
        self.form = form
        self.name = "computed-torque" if form == "discrete" else "computed-torque-textbook"
        self._kp, self._kd = self.bandwidth**2, 2 * self.damping_ratio * self.bandwidth
        self._dynamics = Dynamics(arm)
        self._is_textbook = form == "textbook" or not self._dynamics.is_discrete

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        q, v, _, dt = state
        q_ref, v_ref, a_ref, v_tick, a_tick = setpoint
        if self._is_textbook or v_tick is None or a_tick is None:
            dt = 0.0
        else:
            v_ref, a_ref = v_tick, a_tick
        a = a_ref + self._kp * (q_ref - q) + self._kd * (v_ref - v)
        tau = self._dynamics.inverse(q, v, a, dt)
        return tau + self._dynamics.friction(q, v_ref, a_ref, dt) if self._dynamics.has_friction else tau
