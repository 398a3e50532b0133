"""Cartesian impedance: the tip gives way to forces like a spring and a damper, around where it should be."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import feedforward as model
from armctl.control.gains import DEFAULT_BANDWIDTH, gain, poses
from armctl.control.interface import State
from armctl.control.task_space import consistent_inverse, tip_error
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, frozen, number
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics


class Impedance:
    """Cartesian impedance control, the arm's own inertia left as it is.

        tau = ID(q, v, a_ref) + J^T K e + D (v_ref - v) + posture

    After Hogan, "Impedance control" (1985); the damping D follows from stiffness and mass matrix by diagonalising both at once,
    so every mode has the same damping ratio: Albu-Schaeffer, Ott, Hirzinger, "A unified passivity-based control framework for
    position, torque and impedance control of flexible joint robots" (2007). At rest, a force f moves the tip by K^-1 f. The
    posture's spring acts in the null space.

    Attributes:
        stiffness: (6,) N/m and N m/rad, of the tip along and about the world's axes.
        damping_ratio: 1 is critically damped.
        posture_stiffness: (n,) N m/rad.
    """

    name = "impedance"

    def __init__(
        self,
        arm: Arm,
        *,
        stiffness: ArrayLike | None = None,
        damping_ratio: float = 1.0,
        posture_stiffness: ArrayLike | None = None,
        bandwidth: float = DEFAULT_BANDWIDTH,
    ):
        """An impedance controller for an arm.

        Args:
            arm: The arm whose model it uses.
            stiffness: (6,) N/m and N m/rad; left out, bandwidth^2 x the least mass and inertia that the tip has anywhere.
            damping_ratio: 1 is critically damped.
            posture_stiffness: (n,) N m/rad; left out, (bandwidth / 2)^2 x the least inertia of each joint.
            bandwidth: rad/s, where a stiffness is left out.

        Raises:
            InputError: A gain is negative, not finite or of the wrong length.
        """
        bandwidth = number("bandwidth", bandwidth, 0.0)
        self._arm, self._dynamics = arm, Dynamics(arm)
        tip, joints = _least_inertia(arm, self._dynamics)
        self.stiffness = gain("stiffness", bandwidth**2 * tip if stiffness is None else stiffness, 6)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0)
        default = (0.5 * bandwidth) ** 2 * joints
        self.posture_stiffness = gain("posture_stiffness", default if posture_stiffness is None else posture_stiffness, arm.n)

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
        M = self._dynamics.mass_matrix(q)
        error, _, J = tip_error(self._arm, q, q_ref)
        N = np.eye(self._arm.n) - consistent_inverse(J, M) @ J
        posture = N.T * self.posture_stiffness @ N
        stiffness = J.T * self.stiffness @ J + posture
        spring = J.T @ (self.stiffness * error) + posture @ (q_ref - q)
        damper = self.damping_ratio * _damping(M, stiffness) @ (v_ref - v)
        return model.torque(self._dynamics, state, a_ref, v_ref, a_ref) + spring + damper


def _damping(M: Array, K: Array) -> Array:
    """(n, n) N m s/rad that damps every mode of M and K critically: 2 M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2, by Cholesky."""
    L = np.linalg.cholesky(M)
    half = np.linalg.solve(L, K)
    squares, modes = np.linalg.eigh(np.linalg.solve(L, half.T))
    L_modes = L @ modes
    return 2 * L_modes * np.sqrt(np.maximum(squares, 0.0)) @ L_modes.T


def _least_inertia(arm: Arm, dynamics: Dynamics) -> tuple[Array, Array]:
    """The least inertia in any direction at any pose: (6,) kg and kg m^2 at the tip, (n,) kg m^2 at the joints."""
    mobility, joints = np.zeros(2), np.zeros(arm.n)
    for q in poses(arm):
        M_inv, J = np.linalg.inv(dynamics.mass_matrix(q)), arm.pinocchio_model.jacobian(q)
        felt = [np.linalg.eigvalsh(part @ M_inv @ part.T).max() for part in (J[:3], J[3:])]
        mobility, joints = np.maximum(mobility, felt), np.maximum(joints, np.diag(M_inv))
    with np.errstate(divide="ignore"):
        tip = np.where(mobility > 0.0, 1 / mobility, 0.0)
    return frozen(np.repeat(tip, 3)), frozen(1 / joints)
