"""PD with dynamic feedforward: the model gives the torque of the reference motion, feedback corrects the rest."""

from __future__ import annotations

from collections.abc import Callable

from armctl.control.pd import PD


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
    _has_model = True

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it."""
        from armctl.control.pd_kernel import pd_feedforward

        return pd_feedforward
