"""Compiled parts of `ComputedTorqueQP`: the limits of the next control period, and the quadratic program that respects them."""

from __future__ import annotations

import math

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import (
    add_step_inertia,
    factorize,
    mass_matrix,
    place,
    solve,
    tip_jacobian,
    tip_motion,
    tip_position,
    tip_rotation,
)

# The parameters begin with these, then follow q_min, q_max, v_max, a_max and tau_max, each (n,), and the model.
PERIOD = 0  # s; in continuous time, 0, there are only torque limits
MEAN_SHARE = 1  # of the present velocity in the mean one of the period: 0.5 if the arm moves continuously, else 0
LENGTH = 2  # m, by which rotations of the tip and motions of the joints are converted to distances
STIFFNESS = 3  # 1/s^2, of the feedback
DAMPING = 4  # 1/s
HEADER = 5

# Weights of a deviation from the desired acceleration, relative to that of the tip's position: the joints decide only what the
# tip leaves open, with which a direction that the tip cannot move in costs little.
ROTATION = 0.03
JOINTS = 0.003
MAX_TIP_SHARE = 0.5  # of the feedback's acceleration: the largest correction for the curvature of the tip's motion
BRAKE_SHARE = 0.8  # of the torque left, with which a joint has to be able to stop
MIN_BRAKE_SHARE = 0.05  # of the torque limit, for joints whose motors hardly hold them
TOLERANCE = 1e-9  # relative, at which a limit counts as respected
_UNBOUNDED = 1e30  # infinite for daqp


@njit
def limit_program(params, rows, torque, work, J, H, M, factor, motion, lower, upper):
    """Fills the quadratic program of one control period, and tells whether the desired acceleration exceeds a limit.

    The unknown is the deviation x (n,) from the desired acceleration: minimize x H x / 2, subject to the bounds of x and of M x
    in lower and upper, (2n,).

    Args:
        params: Constants, limits and model, as above.
        rows: (7, n) measured positions and velocities, positions, velocities and accelerations of the reference, the desired
            feedback acceleration, and a torque whose acceleration is desired besides; the last two are overwritten.
        torque: (n,) that makes the desired accelerations; changed by the correction for curvature.
        work: Scratch of the model.
        J: (6, n) scratch.
        H: (n, n) result.
        M: (n, n) result, the inertia of one control period.
        factor: (n, n) scratch.
        motion: (18,) scratch.
        lower: (2n,) result.
        upper: (2n,) result.
    """
    n = torque.shape[0]
    model = params[HEADER + 5 * n :]
    q = rows[0]
    v = rows[1]
    desired = rows[5]
    added = rows[6]
    offset = lower[:n]  # scratch until the bounds are known
    place(model, q, work)
    mass_matrix(model, work, M)
    add_step_inertia(model, M)
    for i in range(n):
        desired[i] += rows[4, i]
    # The tip's law is that of stiffness and damping alone. With the added torques, which are of first order in the errors, the
    # offset would cancel them, by a share that is not linear.
    _tip_offset(params, rows, work, J, motion, offset)
    _add_acceleration(M, added, factor, desired)
    feedback = 0.0
    for i in range(n):
        feedback += (desired[i] - rows[4, i]) ** 2
    _metric(params[LENGTH], J, H)
    _follow_tip(M, H, feedback, offset, factor, desired, torque)
    return _bounds(params, q, v, desired, torque, M, lower, upper)


@njit
def _tip_offset(params, rows, work, J, motion, offset):
    """J^T c, (n,): c is what the tip's acceleration lacks of its own feedback law; leaves the Jacobian at q in J.

    It is of second order in the errors of the joints, so it changes neither exact tracking nor the linear loop.
    """
    n = offset.shape[0]
    model = params[HEADER + 5 * n :]
    wanted_x, wanted_y, wanted_z = _tip_law(params, model, rows[2], rows[3], rows[4], work, J, motion)
    x, y, z = _tip_law(params, model, rows[0], rows[1], rows[5], work, J, motion)
    for i in range(n):
        offset[i] = J[0, i] * (wanted_x - x) + J[1, i] * (wanted_y - y) + J[2, i] * (wanted_z - z)


@njit
def _tip_law(params, model, q, v, a, work, J, motion):
    """Acceleration minus gravity plus damping times velocity plus stiffness times position of the tip, in the world."""
    n = q.shape[0]
    tip_motion(model, q, v, a, work, motion)
    rotation = motion[9:18]
    tip_rotation(model, work, rotation)
    tip_jacobian(model, work, J)
    px, py, pz = tip_position(model, work)
    stiffness = params[STIFFNESS]
    damping = params[DAMPING]
    x = stiffness * px + rotation[0] * motion[6] + rotation[1] * motion[7] + rotation[2] * motion[8]
    y = stiffness * py + rotation[3] * motion[6] + rotation[4] * motion[7] + rotation[5] * motion[8]
    z = stiffness * pz + rotation[6] * motion[6] + rotation[7] * motion[7] + rotation[8] * motion[8]
    for i in range(n):
        x += damping * J[0, i] * v[i]
        y += damping * J[1, i] * v[i]
        z += damping * J[2, i] * v[i]
    return x, y, z


@njit
def _follow_tip(M, H, feedback, offset, factor, desired, torque):
    """Changes acceleration and torque so that the tip follows its own feedback law, by a share of the feedback at most."""
    n = offset.shape[0]
    square = 0.0
    for i in range(n):
        for k in range(n):
            factor[i, k] = H[i, k]
    factorize(factor)
    solve(factor, offset)
    for i in range(n):
        square += offset[i] * offset[i]
    if square == 0.0:
        return
    share = min(1.0, MAX_TIP_SHARE * math.sqrt(feedback / square))
    for i in range(n):
        desired[i] += share * offset[i]
        for k in range(n):
            torque[i] += share * M[i, k] * offset[k]


@njit
def _add_acceleration(M, torque, factor, acceleration):
    """Adds the acceleration of a torque; both arrays may be overwritten."""
    n = torque.shape[0]
    is_zero = True
    for i in range(n):
        if torque[i] != 0.0:
            is_zero = False
        for k in range(n):
            factor[i, k] = M[i, k]
    if is_zero:
        return
    factorize(factor)
    solve(factor, torque)
    for i in range(n):
        acceleration[i] += torque[i]


@njit
def _bounds(params, q, v, desired, torque, M, lower, upper):
    """The bounds of the deviation and of its torque; whether zero is outside."""
    n = q.shape[0]
    dt = params[PERIOD]
    limited = False
    for i in range(n):
        tau_max = params[HEADER + 4 * n + i]
        inertial = 0.0
        for k in range(n):
            inertial += M[i, k] * desired[k]
        bias = torque[i] - inertial
        slowest = MIN_BRAKE_SHARE * tau_max
        down = min(params[HEADER + 3 * n + i], max(BRAKE_SHARE * (tau_max + bias), slowest) / M[i, i])
        up = min(params[HEADER + 3 * n + i], max(BRAKE_SHARE * (tau_max - bias), slowest) / M[i, i])
        v_max = params[HEADER + 2 * n + i]
        highest = min(v_max, _stopping_speed(params, params[HEADER + n + i] - q[i], v[i], down))
        lowest = -min(v_max, _stopping_speed(params, q[i] - params[HEADER + i], -v[i], up))
        lower[i] = max((lowest - v[i]) / dt - desired[i], -_UNBOUNDED) if dt > 0.0 else -_UNBOUNDED
        upper[i] = min((highest - v[i]) / dt - desired[i], _UNBOUNDED) if dt > 0.0 else _UNBOUNDED
        lower[n + i] = max(-tau_max - torque[i], -_UNBOUNDED)
        upper[n + i] = min(tau_max - torque[i], _UNBOUNDED)
        slack = TOLERANCE * (abs(desired[i]) + 1.0)
        load = TOLERANCE * abs(torque[i])
        if lower[i] > slack or upper[i] < -slack or lower[n + i] > load or upper[n + i] < -load:
            limited = True
    return limited


@njit
def _stopping_speed(params, distance, v, deceleration):
    """The highest speed at the end of the period from which a joint still stops before its limit, at a distance now.

    The viability bound of Del Prete, "Joint position and velocity bounds in discrete-time acceleration/torque control of robot
    manipulators" (2018): the speed s after the period travels s dt / 2 + s^2 / (2 deceleration) until it stops.
    """
    dt = params[PERIOD]
    rest = distance - params[MEAN_SHARE] * v * dt
    if not rest > 0.0:
        return 0.0
    half = 0.5 * deceleration * dt
    speed = math.sqrt(half * half + 2.0 * deceleration * rest) - half
    return min(speed, rest / max((1.0 - params[MEAN_SHARE]) * dt, 1e-300))


@njit
def _metric(length, J, H):
    """The squared deviation of the tip, (n, n), with the weights above; J is overwritten."""
    n = H.shape[0]
    for i in range(n):
        for k in range(3, 6):
            J[k, i] *= ROTATION * length
    for i in range(n):
        for j in range(n):
            total = (JOINTS * length) ** 2 if i == j else 0.0
            for k in range(6):
                total += J[k, i] * J[k, j]
            H[i, j] = total
