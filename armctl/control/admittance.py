"""Admittance control: the reference of the tip yields to measured forces like a mass on a spring and a damper."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import feedforward
from armctl.control.gains import MAX_BANDWIDTH, gain
from armctl.control.interface import Clock, State, explains_wrong_arguments, measured_wrench
from armctl.control.task_space import POSE_SIZE, consistent_inverse, task_rows, tip_error
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

DEFAULT_BANDWIDTH = 30.0  # rad/s, of the position loop
YIELDING_BANDWIDTH = 10.0  # rad/s, of the default mass on the default spring
# The default mass is this multiple of the effective one. A mass below the real one bounces on stiff walls.
MASS_RATIO = 3.0
# rad/s. The measured wrench is compensated, so the position loop need not be stiff. Faster, it resonates with a stiff wall.
_WRENCH_FILTER = 20.0


class Admittance:
    """Admittance control: a position loop follows a compliant reference.

        mass x_c'' + damping x_c' + stiffness x_c = wrench,    tip reference = reference + x_c

    After Hogan, "Impedance control" (1985); Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control
    (2009), 9.3.2. Unlike impedance control, it realizes the same compliance in spite of dry friction in the joints, because it
    measures the force. On stiff walls impedance or hybrid force control is the better choice.

    It needs `state.wrench`. Arms of less than six joints yield in position only.

    Attributes:
        mass: (6,) kg and kg m^2 along and about the world's axes.
        damping: (6,) N s/m and N m s/rad.
        stiffness: (6,) N/m and N m/rad; if it is 0, the tip stays where it was displaced to.
        bandwidth: rad/s, of the position loop.
        offset: (6,) m and rad, the displacement of the reference.
    """

    name = "admittance"
    needs_wrench = True

    def __init__(
        self,
        arm: Arm,
        *,
        mass: ArrayLike | None = None,
        stiffness: ArrayLike | None = None,
        damping: ArrayLike | None = None,
        bandwidth: float = DEFAULT_BANDWIDTH,
    ):
        """An admittance controller for an arm.

        Args:
            arm: The arm whose model it uses.
            mass: (6,) kg and kg m^2, or one number for all six. The default is three times the effective
                inertia of the tip at home.
            stiffness: (6,) N/m and N m/rad, or one number for all six. The default is mass x (10 rad/s)^2.
            damping: (6,) N s/m and N m s/rad, or one number for all six. The default is critical, at least that of the
                default stiffness.
            bandwidth: rad/s, of the position loop.

        Raises:
            InputError: A gain is negative, not finite or of the wrong length, or a mass is zero.
        """
        check_arm(arm)
        self.bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self._arm = arm
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self.mass = gain("mass", MASS_RATIO * _inertia_at_home(arm, self._dynamics) if mass is None else mass, POSE_SIZE)
        if not (self.mass > 0.0).all():
            raise InputError(f"mass: every value must be greater than 0, got {self.mass.min():g}")
        soft = YIELDING_BANDWIDTH**2 * self.mass
        self.stiffness = gain("stiffness", soft if stiffness is None else stiffness, POSE_SIZE)
        critical = 2 * np.sqrt(self.mass * np.maximum(self.stiffness, soft))
        self.damping = gain("damping", critical if damping is None else damping, POSE_SIZE)
        self.offset = np.zeros(POSE_SIZE)
        self._rows = task_rows(arm)
        self._clock = Clock()
        self._rate = np.zeros(POSE_SIZE)
        self._wrench = np.zeros(POSE_SIZE)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state, with its wrench.
            setpoint: Where the arm should be without forces.

        Returns:
            (n,) N m.

        Raises:
            InputError: The state has no wrench.
        """
        wrench = measured_wrench(state, self.name)
        q = state.q
        v = state.v
        v_ref, a_ref = feedforward.sampled(setpoint)
        if not self._clock.follows(state):
            self.offset = np.zeros(POSE_SIZE)
            self._rate = np.zeros(POSE_SIZE)
            self._wrench = np.zeros(POSE_SIZE)
        self._yield(wrench, state.dt)
        self._wrench = self._wrench - math.expm1(-_WRENCH_FILTER * state.dt) * (wrench - self._wrench)

        error, J_ref, J = tip_error(self._arm, q, setpoint.q)
        rate_error = J_ref @ v_ref + self._rate - J @ v
        # The acceleration of the offset is not fed forward: with a delay, a mass below the real one would bounce.
        task = self.bandwidth**2 * (error + self.offset) + 2 * self.bandwidth * rate_error
        posture_bandwidth = 0.5 * self.bandwidth
        posture = posture_bandwidth**2 * (setpoint.q - q) + 2 * posture_bandwidth * (v_ref - v)
        rows = self._rows
        J_task = J[rows]
        J_inverse = consistent_inverse(J_task, self._dynamics.mass_matrix(q))
        a = a_ref + posture + J_inverse @ (task[rows] - J_task @ posture)
        v_friction = v_ref + J_inverse @ self._rate[rows]
        tau = feedforward.inverse_dynamics_with_friction(self._dynamics, state, a, v_friction, a_ref)
        return tau - J_task.T @ self._wrench[rows]

    def _yield(self, wrench: Array, dt: float) -> None:
        """Moves the offset by one control period, by an implicit Euler step, which is stable for any gains."""
        force = wrench - self.damping * self._rate - self.stiffness * (self.offset + dt * self._rate)
        acceleration = force / (self.mass + dt * self.damping + dt**2 * self.stiffness)
        self._rate = self._rate + dt * acceleration
        self.offset = self.offset + dt * self._rate


def _inertia_at_home(arm: Arm, dynamics: Dynamics) -> Array:
    """(6,) kg and kg m^2, of the tip in the most mobile direction; 1 where it cannot move."""
    J = arm.pinocchio_model.jacobian(arm.home)
    mobility = J @ np.linalg.solve(dynamics.mass_matrix(arm.home), J.T)
    largest = np.repeat([np.linalg.eigvalsh(mobility[rows, rows]).max() for rows in (slice(0, 3), slice(3, 6))], 3)
    return 1 / np.where(largest > 0.0, largest, 1.0)
