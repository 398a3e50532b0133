"""PD: a spring and a damper at every joint, and no model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.gains import DEFAULT_BANDWIDTH, pd_gains
from armctl.control.interface import KernelController
from armctl.core.validation import Array
from armctl.robot.arm import Arm


class PD(KernelController):
    """Joint PD: tau = stiffness (q_ref - q) + damping (v_ref - v).

    It uses neither gravity nor inertia, so it has a steady-state error under gravity and a tracking error in motion. Default
    gains scale with the inertia of each joint.

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
        stiffness: ArrayLike | None = None,
        damping: ArrayLike | None = None,
    ):
        """A PD controller for an arm.

        Args:
            arm: The arm.
            bandwidth: rad/s, the natural frequency of each joint's closed loop.
            damping_ratio: 1 is critically damped.
            stiffness: (n,) or one number for all joints, N m/rad; replaces the one that follows from the bandwidth.
            damping: (n,) or one number for all joints, N m s/rad; replaces the one that follows from the damping ratio.

        Raises:
            InputError: A gain is negative, not finite or of the wrong length.
        """
        self.stiffness, self.damping = pd_gains(arm, bandwidth, damping_ratio, stiffness, damping)
        super().__init__(arm.n)
        self._arm = arm

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it."""
        from armctl.control.pd_kernel import pd

        return pd

    def parameters(self, dt: float, continuous: bool) -> Array:
        """The gains, for the kernel.

        Args:
            dt: s, the control period.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            A new vector.
        """
        return np.concatenate([self.stiffness, self.damping])
