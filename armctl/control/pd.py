"""PD: a spring and a damper at every joint, and no model."""

from __future__ import annotations

from armctl.control.gains import DEFAULT_BANDWIDTH, pd_gains
from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.robot.arm import Arm


class PD:
    """Joint PD: tau = stiffness (q_ref - q) + damping (v_ref - v).

    It knows neither gravity nor inertia, so it sags and lags; its gains are scaled by each joint's inertia.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
    """

    name = "pd"

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        stiffness: Array | None = None,
        damping: Array | None = None,
    ):
        """A PD controller for an arm.

        Args:
            arm: The arm.
            bandwidth: rad/s, the natural frequency of each joint's closed loop.
            damping_ratio: 1 is critically damped.
            stiffness: (n,) N m/rad, instead of the bandwidth.
            damping: (n,) N m s/rad, instead of the damping ratio.

        Raises:
            InputError: A gain is negative, not finite or of the wrong length.
        """
        self._arm = arm
        self.stiffness, self.damping = pd_gains(arm, bandwidth, damping_ratio, stiffness, damping)

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        return self.stiffness * (setpoint.q - state.q) + self.damping * (setpoint.v - state.v)
