"""PD with gravity compensation: gravity from the model, everything else from feedback."""

from __future__ import annotations

from armctl import _core
from armctl.control.pd import PD


class PDGravity(PD):
    """PD with gravity compensation: tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v).

    After Takegaki and Arimoto, "A new feedback method for dynamic control of manipulators" (1981). At rest the error is zero if
    the model's gravity is exact; in motion there is a tracking error.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
    """

    name = "pd-gravity"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        gains = self.gains_at(dt)
        return _core.PDGravity(self._arm.core_model, stiffness=gains.stiffness, damping=gains.damping)
