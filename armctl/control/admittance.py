"""Admittance control: the reference of the tip yields to measured forces like a mass on a spring and a damper."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.gain_attribute import Gain, scalar_gain, tip_gain
from armctl.control.interface import ArmController
from armctl.control.task_space import POSE_SIZE
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.arm.dynamics import make_dynamics

YIELDING_BANDWIDTH = 10.0  # rad/s, of the default mass on the default spring
# The default mass is this multiple of the effective one. A mass below the real one bounces on stiff walls.
MASS_RATIO = 3.0


class Admittance(ArmController):
    """Admittance control: a position loop follows a compliant reference.

        mass x_c'' + damping x_c' + stiffness x_c = wrench,    tip reference = reference + x_c

    After Hogan, "Impedance control" (1985); Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control
    (2009), 9.3.2. Unlike impedance control, it realizes the same compliance in spite of dry friction in the joints, because it
    measures the force. On stiff walls impedance or hybrid force control is the better choice.

    It needs `state.wrench`. Arms of less than six joints yield in position only.
    """

    name = "admittance"
    needs_wrench = True
    yields = True
    mass: Gain[Array] = tip_gain(above_zero=True)
    damping: Gain[Array] = tip_gain()
    stiffness: Gain[Array] = tip_gain()
    bandwidth: Gain[float] = scalar_gain()

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
            mass: (6,) kg and kg m^2 along and about the world's axes, or one number for all six. The default is three times the
                effective inertia of the tip at home.
            stiffness: (6,) N/m and N m/rad, or one number for all six. The default is mass x (10 rad/s)^2. If it is 0, the tip
                stays where it was displaced to.
            damping: (6,) N s/m and N m s/rad, or one number for all six. The default is critical, at least that of the
                default stiffness.
            bandwidth: rad/s, of the position loop.
        """
        super().__init__(arm)
        self.bandwidth = bandwidth
        self.mass = MASS_RATIO * _inertia_at_home(arm) if mass is None else mass
        soft = YIELDING_BANDWIDTH**2 * self.mass
        self.stiffness = soft if stiffness is None else stiffness
        critical = 2 * np.sqrt(self.mass * np.maximum(self.stiffness, soft))
        self.damping = critical if damping is None else damping

    @property
    def offset(self) -> Array:
        """(6,) m and rad, the displacement of the reference after the last tick."""
        law = self._law
        return law.offset.copy() if isinstance(law, _core.Admittance) else np.zeros(POSE_SIZE)

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        return _core.Admittance(
            self._model(dt, continuous),
            mass=self.mass,
            damping=self.damping,
            stiffness=self.stiffness,
            bandwidth=self.bandwidth,
            dt=dt,
        )


def _inertia_at_home(arm: Arm) -> Array:
    """(6,) kg and kg m^2, of the tip in the most mobile direction; 1 where it cannot move."""
    J = arm.pinocchio_model.jacobian(arm.home)
    dynamics = make_dynamics(arm.model, arm.pinocchio_model)
    mobility = J @ np.linalg.solve(dynamics.mass_matrix(arm.home), J.T)
    largest = np.repeat([np.linalg.eigvalsh(mobility[rows, rows]).max() for rows in (slice(0, 3), slice(3, 6))], 3)
    return 1 / np.where(largest > 0.0, largest, 1.0)
