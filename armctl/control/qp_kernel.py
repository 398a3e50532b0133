"""The kernel of `ComputedTorqueQP`: the limits of the next control period, and the quadratic program that respects them."""

from __future__ import annotations

import math
from typing import NamedTuple

from armctl.control.active_set_kernel import UNBOUNDED, solve_program, work_size
from armctl.control.computed_torque_kernel import ADDED, CORRECTION, VECTORS, computed_torque
from armctl.control.computed_torque_kernel import vector as law_vector
from armctl.control.kernel import A_TICK, Q_REF, V_TICK
from armctl.core.jit import njit, njit_borrowing
from armctl.core.validation import Array
from armctl.robot.dynamics_kernel import (
    add_step_inertia,
    factorize,
    mass_matrix,
    model_size,
    place,
    solve,
    tip_jacobian,
    tip_motion,
    tip_position,
    tip_rotation,
)

# The parameters begin with these. Then follow q_min, q_max, v_max, a_max and tau_max, each (n,), the model at the start of the
# control period, and the parameters of computed torque.
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
VIOLATION_WEIGHT = 1e4  # of limits that cannot be respected, relative to the deviation of the tip

# Rows (n,) of the memory, behind one number that tells whether the last torque was limited; then the scratch of `solve_program`
# and `tip_motion`, and the memory of computed torque.
_BOUNDS = 0  # of the deviation and its torque: lower (2n,), upper (2n,)
_RELAXED = 4  # the same without those that contradict others
_COST = 8
_DEVIATION = 9  # from the desired acceleration
_TORQUE = 10  # without limits
_JACOBIAN = 11  # (6, n)
_METRIC = 17  # H (n, n): the program minimizes x H x / 2; from here on, matrices
_MOTION_SIZE = 18


class Program(NamedTuple):
    """The program of the last tick.

    Attributes:
        H: (n, n)
        M: (n, n) inertia of one control period: the torque of a deviation is M x.
        lower: (2n,) bounds of x and M x.
        upper: (2n,)
        torque: (n,) N m, without limits.
    """

    H: Array
    M: Array
    lower: Array
    upper: Array
    torque: Array


def last_program(memory: Array, n: int) -> Program | None:
    """The program that the kernel solved in the last tick, as views of its memory; None if there was none."""
    if memory[0] == 0.0:
        return None
    rows = memory[1:]
    lower, upper = rows[_BOUNDS * n : _RELAXED * n].reshape(2, 2 * n)
    H, M = rows[_METRIC * n : _METRIC * n + 2 * n * n].reshape(2, n, n)
    return Program(H, M, lower, upper, rows[_TORQUE * n : (_TORQUE + 1) * n])


@njit
def _scratch(n):
    """Where the scratch begins."""
    return 1 + _METRIC * n + 3 * n * n


@njit
def _law(n):
    """Where the memory of computed torque begins."""
    return _scratch(n) + work_size(n) + _MOTION_SIZE


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return int(_law(n)) + VECTORS * n


@njit
def _rows(memory, n, k, count):
    """Some rows (n,) of the memory, one after another."""
    return memory[1 + k * n : 1 + (k + count) * n]


@njit
def _matrix(memory, n, k):
    """Matrix k (n, n): metric, inertia, factors."""
    start = 1 + _METRIC * n + k * n * n
    return memory[start : start + n * n].reshape((n, n))


@njit_borrowing
def computed_torque_qp(params, q, v, reference, memory, tau):
    """The law of `ComputedTorqueQP`."""
    n = tau.shape[0]
    is_limited = _make_program(params, q, v, reference, memory, tau)
    memory[0] = 1.0 if is_limited else 0.0
    if not is_limited:
        return
    _find_deviation(memory, n)
    M = _matrix(memory, n, 1)
    x = _rows(memory, n, _DEVIATION, 1)
    torque = _rows(memory, n, _TORQUE, 1)
    for i in range(n):
        torque[i] = tau[i]
        for k in range(n):
            tau[i] += M[i, k] * x[k]
        tau_max = params[HEADER + 4 * n + i]
        if tau[i] > tau_max:
            tau[i] = tau_max
        elif tau[i] < -tau_max:
            tau[i] = -tau_max


@njit
def _make_program(params, q, v, reference, memory, tau):
    """Computes the torque without limits and the program of one control period; whether the torque exceeds a limit."""
    n = tau.shape[0]
    model = params[HEADER + 5 * n :]
    law = memory[_law(n) :]
    computed_torque(model[model_size(model, n) :], q, v, reference, law, tau)
    work = law[VECTORS * n :]
    desired = law_vector(law, n, CORRECTION)
    J = _rows(memory, n, _JACOBIAN, 6).reshape((6, n))
    H = _matrix(memory, n, 0)
    M = _matrix(memory, n, 1)
    factor = _matrix(memory, n, 2)
    motion = memory[_law(n) - _MOTION_SIZE : _law(n)]
    offset = _rows(memory, n, _DEVIATION, 1)
    place(model, q, work)
    mass_matrix(model, work, M)
    add_step_inertia(model, M)
    for i in range(n):
        desired[i] += reference[A_TICK, i]
    # The tip's law is that of stiffness and damping alone. With the added torques, which are of first order in the errors, the
    # offset would cancel them, by a share that is not linear.
    _tip_offset(params, q, v, reference, desired, work, J, motion, offset)
    _add_acceleration(M, law_vector(law, n, ADDED), factor, desired)
    feedback = 0.0
    for i in range(n):
        missing = desired[i] - reference[A_TICK, i]
        feedback += missing * missing
    _metric(params[LENGTH], J, H)
    _follow_tip(M, H, feedback, offset, factor, desired, tau)
    bounds = _rows(memory, n, _BOUNDS, 4)
    return _bounds(params, q, v, desired, tau, M, bounds[: 2 * n], bounds[2 * n :])


@njit
def _find_deviation(memory, n):
    """Solves the program. Where limits contradict each other, those of velocity and position become costs."""
    H = _matrix(memory, n, 0)
    M = _matrix(memory, n, 1)
    bounds = _rows(memory, n, _BOUNDS, 4)
    relaxed = _rows(memory, n, _RELAXED, 4)
    weighted = _matrix(memory, n, 2)
    cost = _rows(memory, n, _COST, 1)
    x = _rows(memory, n, _DEVIATION, 1)
    work = memory[_scratch(n) : _law(n) - _MOTION_SIZE]
    for relax in (False, True):
        _copy_program(H, bounds, relax, weighted, cost, relaxed)
        if solve_program(weighted, cost, M, relaxed[: 2 * n], relaxed[2 * n :], work, x):
            return
    for i in range(n):
        x[i] = 0.0


@njit
def _copy_program(H, bounds, relax, weighted, cost, relaxed):
    """Copies metric and bounds; makes costs of the bounds of the deviation that exclude zero if they are to be relaxed."""
    n = H.shape[0]
    trace = 0.0
    for i in range(n):
        trace += H[i, i]
        cost[i] = 0.0
        for k in range(n):
            weighted[i, k] = H[i, k]
    for i in range(4 * n):
        relaxed[i] = bounds[i]
    for i in range(n):
        nearest = min(max(0.0, bounds[i]), bounds[2 * n + i])
        if relax and nearest != 0.0:
            weight = VIOLATION_WEIGHT * trace
            weighted[i, i] += weight
            cost[i] = -weight * nearest
            relaxed[i] = -UNBOUNDED
            relaxed[2 * n + i] = UNBOUNDED


@njit
def _tip_offset(params, q, v, reference, desired, work, J, motion, offset):
    """J^T c, (n,): c is what the tip's acceleration lacks of its own feedback law; leaves the Jacobian at q in J.

    It is of second order in the errors of the joints, so it changes neither exact tracking nor the linear loop.
    """
    n = offset.shape[0]
    model = params[HEADER + 5 * n :]
    wanted_x, wanted_y, wanted_z = _tip_law(
        params, model, reference[Q_REF], reference[V_TICK], reference[A_TICK], work, J, motion
    )
    x, y, z = _tip_law(params, model, q, v, desired, work, J, motion)
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
        lower[i] = max((lowest - v[i]) / dt - desired[i], -UNBOUNDED) if dt > 0.0 else -UNBOUNDED
        upper[i] = min((highest - v[i]) / dt - desired[i], UNBOUNDED) if dt > 0.0 else UNBOUNDED
        lower[n + i] = max(-tau_max - torque[i], -UNBOUNDED)
        upper[n + i] = min(tau_max - torque[i], UNBOUNDED)
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
            total = (JOINTS * length) * (JOINTS * length) if i == j else 0.0
            for k in range(6):
                total += J[k, i] * J[k, j]
            H[i, j] = total
