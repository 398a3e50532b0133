"""Pseudo-inertia: the ten inertial parameters of a link as a 4 x 4 matrix that is positive definite if a body can have them.

    P = [[S, m c], [m c^T, m]],  S = tr(I) 1 / 2 - I,  I about the frame's origin

Sources: Wensing, Kim, Slotine, "Linear matrix inequalities for physically consistent inertial parameter identification"
(2018); Rucker, Wensing, "Smooth parameterization of rigid-body inertia" (2022) for the Cholesky factor with
the logarithms of its diagonal.
Parameters are in Pinocchio's order: m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
"""

import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.dynamics import TENSOR_ELEMENTS

PARAMETERS = 10
_MIN_RELATIVE_SPREAD = 1e-6  # of the second moment in directions in which a nominal link has no extent
_UPPER = np.triu_indices(4, 1)


def tensor_of(elements: Array) -> Array:
    """The symmetric (3, 3) with (6,) `TENSOR_ELEMENTS`."""
    rows, columns = TENSOR_ELEMENTS
    tensor = np.empty((3, 3))
    tensor[rows, columns] = elements
    tensor[columns, rows] = elements
    return tensor


def pseudo_inertia(parameters: Array) -> Array:
    """(4, 4) from (10,)."""
    inertia = tensor_of(parameters[4:])
    P = np.empty((4, 4))
    P[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    P[:3, 3] = parameters[1:4]
    P[3, :3] = parameters[1:4]
    P[3, 3] = parameters[0]
    return P


def inertial_parameters(P: Array) -> Array:
    """(10,) from (4, 4): the inverse of `pseudo_inertia`."""
    S = P[:3, :3]
    inertia = np.trace(S) * np.eye(3) - S
    return np.concatenate([[P[3, 3]], P[:3, 3], inertia[TENSOR_ELEMENTS]])


def is_consistent(parameters: Array) -> bool:
    """Whether a rigid body can have these parameters."""
    return bool(np.linalg.eigvalsh(pseudo_inertia(parameters))[0] > 0.0)


def regularized(parameters: Array, mass_floor: float, length_floor: float) -> Array:
    """Strictly consistent parameters close to the given ones: points, rods and massless links get a little spread."""
    P = pseudo_inertia(parameters)
    mass = max(float(P[3, 3]), mass_floor)
    spread = max(float(np.trace(P[:3, :3])), mass * length_floor**2)
    scale = np.diag([spread, spread, spread, mass])
    share = _MIN_RELATIVE_SPREAD
    while np.linalg.eigvalsh(P + share * scale)[0] <= 0.1 * share * min(spread, mass):
        share *= 10.0
    return inertial_parameters(P + share * scale)


def upper_factor(P: Array) -> Array:
    """The upper triangular U with P = U U^T."""
    return np.array(np.linalg.cholesky(P[::-1, ::-1])[::-1, ::-1], dtype=np.float64)


def to_log_cholesky(parameters: Array) -> Array:
    """(10,): the logarithms of the diagonal of U, and its upper part."""
    U = upper_factor(pseudo_inertia(parameters))
    return np.concatenate([np.log(np.diag(U)), U[_UPPER]])


def from_log_cholesky(factors: Array) -> tuple[Array, Array]:
    """The parameters (10,) and their Jacobian (10, 10)."""
    U = np.diag(np.exp(factors[:4]))
    U[_UPPER] = factors[4:]
    jacobian = np.empty((PARAMETERS, PARAMETERS))
    for k in range(PARAMETERS):
        change = np.zeros((4, 4))
        if k < 4:
            change[k, k] = U[k, k]
        else:
            change[_UPPER[0][k - 4], _UPPER[1][k - 4]] = 1.0
        change = change @ U.T
        jacobian[:, k] = inertial_parameters(change + change.T)
    return inertial_parameters(U @ U.T), jacobian
