"""Compiled regressor of an unknown body at the tip, and a recursive Bayesian estimator of its parameters, delay and friction.

The ten parameters are the mass m, the first moment m c (3,) and the second moments S, xx yy zz xy xz yz, kg m^2, of the body in
the tip's frame. Its inertia about the tip is tr(S) 1 - S. The torque is linear in them. The eleventh unknown is the delay T of
the motors: the torque tau(t - T) acts, so tau(t) exceeds what the motion needs by T times the rate of tau. The last unknowns,
11 to p = 11 + n, are the dry friction of the n joints, N m.
"""

from __future__ import annotations

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import factorize, solve, tip_jacobian, tip_motion, tip_rotation

PARAMETERS = 10
DELAY = 10
FRICTION = 11  # the first of one unknown for each joint
_FIRST = (0, 1, 2, 0, 0, 1)  # rows and columns of the second moments
_SECOND = (0, 1, 2, 1, 2, 2)
_KINEMATICS = 18  # motion (9,), and the (3, 3) matrix of the acceleration field


@njit
def regressor_scratch(n):
    """Numbers of scratch memory of `payload_regressor` for n joints."""
    return 6 * n + 9 + _KINEMATICS


@njit
def payload_regressor(model, q, v, a, work, scratch, Y):
    """The torques of a body at the tip per parameter, the first ten columns of Y (n, 10 or more).

    A point x of the body has the acceleration a + A x with A = [alpha] + [omega]^2 and a that of the tip minus gravity. Its
    force and moment about the tip are therefore m a + A h and h x a + sum over i, j of S_ij e_i x A e_j.
    """
    n = Y.shape[0]
    motion = scratch[:9]
    field = scratch[9:_KINEMATICS].reshape((3, 3))
    rotation = scratch[_KINEMATICS : _KINEMATICS + 9]
    J = scratch[_KINEMATICS + 9 : _KINEMATICS + 9 + 6 * n].reshape((6, n))
    tip_motion(model, q, v, a, work, motion)
    tip_rotation(model, work, rotation)
    tip_jacobian(model, work, J)
    _acceleration_field(motion, field)
    for i in range(n):
        lx, ly, lz = _in_tip_axes(rotation, J[0, i], J[1, i], J[2, i])
        rx, ry, rz = _in_tip_axes(rotation, J[3, i], J[4, i], J[5, i])
        Y[i, 0] = lx * motion[6] + ly * motion[7] + lz * motion[8]
        # r . (e_k x a) = e_k . (a x r)
        Y[i, 1] = motion[7] * rz - motion[8] * ry
        Y[i, 2] = motion[8] * rx - motion[6] * rz
        Y[i, 3] = motion[6] * ry - motion[7] * rx
        for k in range(3):
            Y[i, 1 + k] += lx * field[0, k] + ly * field[1, k] + lz * field[2, k]
        for k in range(6):
            first = _FIRST[k]
            second = _SECOND[k]
            Y[i, 4 + k] = _moment(field, first, second, rx, ry, rz)
            if first != second:
                Y[i, 4 + k] += _moment(field, second, first, rx, ry, rz)


@njit
def _acceleration_field(motion, field):
    """[alpha] + [omega]^2, (3, 3)."""
    square = motion[0] * motion[0] + motion[1] * motion[1] + motion[2] * motion[2]
    for i in range(3):
        for k in range(3):
            field[i, k] = motion[i] * motion[k]
        field[i, i] -= square
    field[0, 1] -= motion[5]
    field[0, 2] += motion[4]
    field[1, 0] += motion[5]
    field[1, 2] -= motion[3]
    field[2, 0] -= motion[4]
    field[2, 1] += motion[3]


@njit
def _in_tip_axes(rotation, x, y, z):
    return (
        rotation[0] * x + rotation[3] * y + rotation[6] * z,
        rotation[1] * x + rotation[4] * y + rotation[7] * z,
        rotation[2] * x + rotation[5] * y + rotation[8] * z,
    )


@njit
def _moment(field, i, k, x, y, z):
    """(x, y, z) . (e_i x A e_k)."""
    if i == 0:
        return field[1, k] * z - field[2, k] * y
    if i == 1:
        return field[2, k] * x - field[0, k] * z
    return field[0, k] * y - field[1, k] * x


# Constants of the estimator, followed by the reciprocal torque noise (n,) and the prior standard deviations (p,).
FILTER_WEIGHT = 0  # of each of two low-passes in one control period
INFORMATION_WEIGHT = 1  # of one control period
FORGETTING = 2  # per control period
CONSTANTS = 3

# The memory of the estimator: unknowns (p,), regressors (2, n, p) and torques (2, n) behind each low-pass, information (p, p)
# and its vector (p,), and its factors (p, p).
_MAX_MISFIT = 50.0  # mean square of the residual, in units of the noise, up to which forgetting accelerates


@njit
def unknowns(n):
    """Numbers that are estimated for n joints."""
    return FRICTION + n


@njit
def constants_size(n):
    """Numbers of constants for n joints."""
    return CONSTANTS + n + unknowns(n)


@njit
def estimator_size(n):
    """Numbers of memory of the estimator for n joints."""
    p = unknowns(n)
    return 2 * p + 2 * n * (p + 1) + 2 * p * p


@njit
def learn_payload(constants, Y, torque, is_moving, memory):
    """Updates the estimate, memory[:p], with the torque (n,) that the motors gave beyond the model's in one control period.

    Regressors and torques pass the same low-pass. Old information fades, faster if the estimate does not explain the torques
    (Fortescue, Kershenbaum, Ydstie, "Implementation of self-tuning regulators with variable forgetting factors", 1981).
    """
    n, p = Y.shape
    at = p
    filtered = memory[at : at + 2 * n * p].reshape((2, n, p))
    at += 2 * n * p
    response = memory[at : at + 2 * n].reshape((2, n))
    at += 2 * n
    information = memory[at : at + p * p].reshape((p, p))
    at += p * p
    vector = memory[at : at + p]
    at += p
    factor = memory[at : at + p * p].reshape((p, p))
    estimate = memory[:p]
    weight = constants[FILTER_WEIGHT]
    misfit = 0.0
    for i in range(n):
        scale = constants[CONSTANTS + i]
        response[0, i] += weight * (scale * torque[i] - response[0, i])
        response[1, i] += weight * (response[0, i] - response[1, i])
        residual = response[1, i]
        for k in range(p):
            filtered[0, i, k] += weight * (scale * constants[CONSTANTS + n + k] * Y[i, k] - filtered[0, i, k])
            filtered[1, i, k] += weight * (filtered[0, i, k] - filtered[1, i, k])
            residual -= filtered[1, i, k] * estimate[k] / constants[CONSTANTS + n + k]
        misfit += residual * residual
    if not is_moving:
        return
    keep = 1.0 - constants[FORGETTING] * (1.0 + min(misfit / n, _MAX_MISFIT))
    gain = constants[INFORMATION_WEIGHT]
    for k in range(p):
        total = 0.0
        for i in range(n):
            total += filtered[1, i, k] * response[1, i]
        vector[k] = keep * vector[k] + gain * total
        for j in range(k + 1):
            total = 0.0
            for i in range(n):
                total += filtered[1, i, k] * filtered[1, i, j]
            information[k, j] = keep * information[k, j] + gain * total
            factor[k, j] = information[k, j]
        factor[k, k] += 1.0  # the prior, in units of its standard deviations
    factorize(factor)
    for k in range(p):
        estimate[k] = vector[k]
    solve(factor, estimate)
    for k in range(p):
        estimate[k] *= constants[CONSTANTS + n + k]
