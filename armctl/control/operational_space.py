"""Operational space control: the tip's error behaves like a unit mass on a spring; a posture law acts in the null space."""

from __future__ import annotations

from armctl.control import feedforward
from armctl.control.gains import DEFAULT_BANDWIDTH, MAX_BANDWIDTH
from armctl.control.interface import State, explains_wrong_arguments
from armctl.control.task_space import consistent_inverse, tip_error
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics


class OperationalSpace:
    """Operational space control with feedforward and a posture in the null space.

        tau = ID(q, v, a_ref + J# (k_p e + k_d e_dot) + (1 - J# J) (k_p' (q_ref - q) + k_d' (v_ref - v)))

    After Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
    (1987). J# is the dynamically consistent inverse. It is damped near singular configurations, where the posture law takes
    over. The task is the tip's pose at q_ref, so the feedforward is the acceleration of the reference.

    Attributes:
        bandwidth: rad/s, of the tip's error.
        damping_ratio: 1 is critically damped.
        posture_bandwidth: rad/s, of the joint error in the null space of the tip.
    """

    name = "operational-space"

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        posture_bandwidth: float = DEFAULT_BANDWIDTH,
    ):
        """An operational space controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the tip's error.
            damping_ratio: 1 is critically damped.
            posture_bandwidth: rad/s, the natural frequency of the joint error in the null space.

        Raises:
            InputError: A gain is negative or not finite.
        """
        check_arm(arm)
        self.bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0, MAX_BANDWIDTH)
        self.posture_bandwidth = number("posture_bandwidth", posture_bandwidth, 0.0, MAX_BANDWIDTH)
        self._arm = arm
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        q = state.q
        v = state.v
        q_ref = setpoint.q
        v_ref, a_ref = feedforward.sampled(setpoint)
        error, J_ref, J = tip_error(self._arm, q, q_ref)
        task = self._pd_acceleration(self.bandwidth, error, J_ref @ v_ref - J @ v)
        posture = self._pd_acceleration(self.posture_bandwidth, q_ref - q, v_ref - v)
        a = a_ref + posture + consistent_inverse(J, self._dynamics.mass_matrix(q)) @ (task - J @ posture)
        return feedforward.inverse_dynamics_with_friction(self._dynamics, state, a, v_ref, a_ref)

    def _pd_acceleration(self, bandwidth: float, error: Array, rate: Array) -> Array:
        return bandwidth**2 * error + 2 * self.damping_ratio * bandwidth * rate
