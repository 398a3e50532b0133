"""Operational space control: the tip's error behaves like a unit mass on a spring; a posture law acts in the null space."""

from __future__ import annotations

from armctl import _core
from armctl.control.gain_attribute import Gain, scalar_gain
from armctl.control.interface import ArmController
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.model.arm.arm import Arm


class OperationalSpace(ArmController):
    """Operational space control with feedforward and a posture in the null space.

        tau = ID(q, v, a_ref + J# (k_p e + k_d e_dot) + (1 - J# J) (k_p' (q_ref - q) + k_d' (v_ref - v)))

    After Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
    (1987). J# is the dynamically consistent inverse. It is damped near singular configurations, where the posture law takes
    over. The task is the tip's pose at q_ref, so the feedforward is the acceleration of the reference.

    The linear damping of the joints is compensated at the velocity v_ref + J# w e + (1 - J# J) w' (q_ref - q), with the
    bandwidths w and w', so that errors of damped joints decay as fast as by the formula.
    """

    name = "operational-space"
    bandwidth: Gain[float] = scalar_gain()
    damping_ratio: Gain[float] = scalar_gain()
    posture_bandwidth: Gain[float] = scalar_gain()

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
            bandwidth: rad/s, the natural frequency of the tip's error.
            damping_ratio: 1 is critically damped.
            posture_bandwidth: rad/s, the natural frequency of the joint error in the null space.
        """
        super().__init__(arm)
        self.bandwidth = bandwidth
        self.damping_ratio = damping_ratio
        self.posture_bandwidth = posture_bandwidth

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        damping = 2 * self.damping_ratio
        return _core.OperationalSpace(
            self._model(dt, continuous),
            stiffness=self.bandwidth**2,
            damping=damping * self.bandwidth,
            posture_stiffness=self.posture_bandwidth**2,
            posture_damping=damping * self.posture_bandwidth,
        )
