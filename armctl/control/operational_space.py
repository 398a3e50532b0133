"""Operational space control: the tip's error is a unit mass on a spring; the posture moves only what the tip does not feel."""

from __future__ import annotations

from armctl.control import feedforward as model
from armctl.control.gains import DEFAULT_BANDWIDTH
from armctl.control.interface import State
from armctl.control.task_space import consistent_inverse, tip_error
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics


class OperationalSpace:
    """Operational space control with feed-forward and a posture in the null space.

        tau = ID(q, v, a_ref + J# (k_p e + k_d e_dot) + (1 - J# J) (k_p' (q_ref - q) + k_d' (v_ref - v)))

    After Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
    (1987). J# is the dynamically consistent inverse, damped near singular poses, where the posture's law takes over. The task
    is the tip's pose at q_ref, so its feed-forward is the reference's own acceleration.

    Attributes:
        bandwidth: rad/s, of the tip's error.
        damping_ratio: 1 is critically damped.
        posture_bandwidth: rad/s, of the joints' error where the tip does not feel it.
    """

    name = "operational-space"

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        posture_bandwidth: float = 0.5 * DEFAULT_BANDWIDTH,
    ):
        """An operational-space controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the tip's error.
            damping_ratio: 1 is critically damped.
            posture_bandwidth: rad/s, the natural frequency of the joints' error in the null space.

        Raises:
            InputError: A gain is negative or not finite.
        """
        self.bandwidth = number("bandwidth", bandwidth, 0.0)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0)
        self.posture_bandwidth = number("posture_bandwidth", posture_bandwidth, 0.0)
        self._arm, self._dynamics = arm, Dynamics(arm)

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        q, v, q_ref = state.q, state.v, setpoint.q
        v_ref, a_ref = model.sampled(setpoint)
        error, J_ref, J = tip_error(self._arm, q, q_ref)
        task = self._law(self.bandwidth, error, J_ref @ v_ref - J @ v)
        posture = self._law(self.posture_bandwidth, q_ref - q, v_ref - v)
        a = a_ref + posture + consistent_inverse(J, self._dynamics.mass_matrix(q)) @ (task - J @ posture)
        return model.torque(self._dynamics, state, a, v_ref, a_ref)

    def _law(self, bandwidth: float, error: Array, rate: Array) -> Array:
        return bandwidth**2 * error + 2 * self.damping_ratio * bandwidth * rate
