"""PD with dynamic feedforward: the model gives the torque of the reference motion, feedback corrects the rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armctl.control.interface import checked_period
from armctl.control.pd import PD
from armctl.core.validation import Array


class PDFeedforward(PD):
    """PD with dynamic feedforward: tau = ID(q_ref, v_ref, a_ref) + stiffness (q_ref - q) + damping (v_ref - v).

    After An, Atkeson, Hollerbach, Model-Based Control of a Robot Manipulator (1988), chapter 5. The model is evaluated on the
    reference only, so measurement noise does not pass through it and the loop is that of PD. With an exact model, of which the
    discrete form of `ComputedTorque` is the inverse, only rounding errors remain.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
    """

    name = "pd-feedforward"

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it."""
        from armctl.control.pd_kernel import pd_feedforward

        return pd_feedforward

    @property
    def memory_size(self) -> int:
        """Numbers of scratch memory."""
        return self._arm.packed_dynamics.work_size()

    def parameters(self, dt: float, continuous: bool) -> Array:
        """The gains and the model, for the kernel.

        Args:
            dt: s, the control period.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            A new vector.

        Raises:
            InputError: The control period is no number in [0, 1] s, or `continuous` is not True or False.
        """
        dt, continuous = checked_period(dt, continuous)
        return np.concatenate([super().parameters(dt, continuous), self._arm.packed_dynamics.vector(dt, continuous)])
