"""Cartesian impedance: the tip yields to forces like a spring and a damper around its reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.gain_attribute import Gain, joint_gain, scalar_gain, tip_bound
from armctl.control.gains import MAX_BANDWIDTH, gain, sample_configurations
from armctl.control.interface import ArmController, State
from armctl.control.task_space import POSE_SIZE, consistent_inverse
from armctl.core.defaults import IMPEDANCE_BANDWIDTH
from armctl.core.validation import Array, frozen, number, vector
from armctl.model.arm.arm import Arm
from armctl.model.arm.dynamics import Dynamics, make_dynamics


class Impedance(ArmController):
    """Cartesian impedance control without inertia shaping.

        tau = ID(q, v, a_ref) + J^T K e + D (v_ref - v) + posture

    After Hogan, "Impedance control" (1985). D follows from stiffness and mass matrix by simultaneous diagonalization, so every
    mode has the same damping ratio: Albu-Schaeffer, Ott, Hirzinger, "A unified passivity-based control framework for position,
    torque and impedance control of flexible joint robots" (2007). At rest, a force f displaces the tip by K^-1 f. The posture
    spring acts in the null space. The stiffness may change during a run; raising it while the tip is displaced supplies energy.
    """

    name = "impedance"
    yields = True
    error_max: Gain[Array] = tip_bound()
    damping_ratio: Gain[float] = scalar_gain()
    posture_stiffness: Gain[Array] = joint_gain()

    def __init__(
        self,
        arm: Arm,
        *,
        stiffness: ArrayLike | Callable[[float], ArrayLike] | None = None,
        error_max: ArrayLike | None = None,
        damping_ratio: float = 1.0,
        posture_stiffness: ArrayLike | None = None,
        bandwidth: float = IMPEDANCE_BANDWIDTH,
    ):
        """An impedance controller for an arm.

        Args:
            stiffness: (6,) N/m and N m/rad, of the tip along and about the world's axes, or one number for all six, or a
                function of the time, s, that gives either; it can be replaced during a run. The default is bandwidth^2 x the
                smallest mass and the smallest inertia of the tip in any direction and configuration.
            error_max: (6,) m and rad, or one number for all six: the spring stretches no further, so that its force is at most
                stiffness x error_max. Not bounded by default.
            damping_ratio: 1 is critically damped.
            posture_stiffness: (n,) or one number for all joints, N m/rad. The default is bandwidth^2 x the smallest
                inertia of each joint.
            bandwidth: rad/s, for stiffnesses that are not given.
        """
        super().__init__(arm)
        bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self.damping_ratio = damping_ratio
        self._dynamics = make_dynamics(arm.model, arm.pinocchio_model)
        inertia = _min_inertia(arm, self._dynamics)
        self.stiffness = bandwidth**2 * inertia.tip if stiffness is None else stiffness
        self.error_max = np.inf if error_max is None else error_max
        if posture_stiffness is None:
            posture_stiffness = bandwidth**2 * inertia.joints
        self.posture_stiffness = posture_stiffness

    @property
    def stiffness(self) -> Array | Callable[[float], ArrayLike]:
        """(6,) N/m and N m/rad, or a function of the time that gives it."""
        return self._stiffness

    @stiffness.setter
    def stiffness(self, stiffness: ArrayLike | Callable[[float], ArrayLike]) -> None:
        self._stiffness = stiffness if callable(stiffness) else gain("stiffness", stiffness, POSE_SIZE)

    @property
    def is_time_varying(self) -> bool:
        """Whether the stiffness is a function of the time."""
        return callable(self._stiffness)

    def begin(self, state: State) -> _core.Law:
        """Prepares for a tick.

        Returns:
            The law, with the stiffness at the time of the state.

        Raises:
            InputError: It is no `State`, or the function of the time gives no stiffness.
        """
        law = super().begin(state)
        if callable(self._stiffness) and isinstance(law, _core.Impedance):
            law.set_stiffness(stiffness=gain("stiffness", self._stiffness(state.t), POSE_SIZE))
        return law

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        return _core.Impedance(
            self._model(dt, continuous),
            stiffness=np.zeros(POSE_SIZE) if callable(self._stiffness) else self._stiffness,
            max_error=self.error_max,
            posture_stiffness=self.posture_stiffness,
            damping_ratio=self.damping_ratio,
        )

    def joint_stiffness(self, q: ArrayLike, tip_stiffness: ArrayLike) -> Array:
        """The springs of tip and posture as seen by the joints.

        Args:
            q: (n,) rad.
            tip_stiffness: (6,) N/m and N m/rad, or one number for all six.

        Returns:
            (n, n) N m/rad.
        """
        q = vector("q", q, self._arm.n)
        tip_stiffness = gain("tip_stiffness", tip_stiffness, POSE_SIZE)
        J = self._arm.pinocchio_model.jacobian(q)
        return J.T * tip_stiffness @ J + self._posture(J, self._dynamics.mass_matrix(q))

    def _posture(self, J: Array, M: Array) -> Array:
        """(n, n) N m/rad, the posture spring in the null space of the tip."""
        N = np.eye(self._arm.n) - consistent_inverse(J, M) @ J
        return N.T * self.posture_stiffness @ N


class _MinInertia(NamedTuple):
    """The smallest inertia in any direction and sampled configuration: (6,) kg and kg m^2 of the tip, (n,) of the joints."""

    tip: Array
    joints: Array


def _min_inertia(arm: Arm, dynamics: Dynamics) -> _MinInertia:
    tip_mobility = np.zeros(2)  # of translation and rotation, 1/kg and 1/(kg m^2)
    joint_mobility = np.zeros(arm.n)
    for q in sample_configurations(arm):
        M_inv = np.linalg.inv(dynamics.mass_matrix(q))
        J = arm.pinocchio_model.jacobian(q)
        largest = [np.linalg.eigvalsh(part @ M_inv @ part.T).max() for part in (J[:3], J[3:])]
        tip_mobility = np.maximum(tip_mobility, largest)
        joint_mobility = np.maximum(joint_mobility, np.diag(M_inv))
    with np.errstate(divide="ignore"):
        tip = np.where(tip_mobility > 0.0, 1 / tip_mobility, 0.0)
    return _MinInertia(frozen(np.repeat(tip, 3)), frozen(1 / joint_mobility))
