"""PD with dynamic feedforward: the model gives the torque of the reference motion, feedback corrects the rest."""

from __future__ import annotations

from armctl import _core
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

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        gains = self.gains_at(dt)
        model = self._model(dt, continuous)
        return _core.PDFeedforward(model, stiffness=gains.stiffness, damping=gains.damping)
