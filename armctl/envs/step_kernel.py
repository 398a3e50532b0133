"""The compiled step of a batch of environments: action, reference, controller and plant, for a range of rows.

It runs as a C function inside `mjb_apply`, as the tick loop of a simulation does. The table and everything that it points to
belong to one range of rows, so ranges on different threads share nothing that they write.
"""

# pyright: reportCallIssue=false, reportPrivateImportUsage=false

from __future__ import annotations

import math

import numba
from numba import types

from armctl.control.kernel import A_REF, A_TICK, Q_REF, V_REF, V_TICK
from armctl.core.jit import c_function, njit
from armctl.robot.dynamics_kernel import (
    add_implicit_damping,
    factorize,
    free_step,
    inverse_dynamics,
    locate,
    mass_matrix,
    place,
    solve,
    tip_jacobian,
    tip_position,
    tip_rotation,
)
from armctl.sim.tick_kernel import _call_kernel, _integers, _matrix, _step, _vector

# Entries of the table. SIZES:
ROWS = 0
N = 1  # joints
NQ = 2
NV = 3
NCTRL = 4
FIRST = 5  # the range of rows
LAST = 6
TICKS = 7  # of a step of the environment
MODE = 8  # one of the action modes
ACTIONS = 9  # numbers of an action of the arm
PARAMETERS_SIZE = 10
MEMORY_SIZE = 11
MODEL_SIZE = 12
SCRATCH_SIZE = 13
# Addresses:
STEP_FUNCTION = 14
KERNEL = 15
PARAMETERS = 16
MEMORY = 17  # (rows, size)
NOMINAL = 18  # the model that the controller knows
PLANTS = 19  # (rows, size) dynamics of each plant in free space
DATAS = 20  # (rows, 5) int64: addresses of MjModel, MjData, qpos, qvel, ctrl; 0 in free space
BOUNDS = 21  # (2, n) torques of the motors
LIMITS = 22  # (5, n): least and greatest position, greatest speed, acceleration and torque
NUMBERS = 23  # (NUMBER_COUNT,)
INDICES = 24  # (3, n) int64: the joints in qpos, in qvel, their motors in ctrl
GEAR = 25
SCRATCH = 26
ACTION = 27  # (rows, actions)
Q = 28  # (rows, n), as all that follow up to TIP
V = 29
TARGET = 30
Q_REFERENCE = 31
V_REFERENCE = 32
TIP = 33  # (rows, 12): position, rotation matrix
TABLE_SIZE = 34

# Numbers:
PERIOD = 0  # s
JOINT_SCALE = 1  # fraction of the way at full speed that a joint moves in a step by a full action
POSITION_SCALE = 2  # m, of a full cartesian action
ROTATION_SCALE = 3  # rad
APPROACH_RATE = 4  # 1/s
DAMPING = 5  # of the inverse Jacobian, squared
HOME_TIP = 6  # (12,)
NUMBER_COUNT = 18

TORQUE = 0
JOINT_DELTA = 1
JOINT_TARGET = 2
CARTESIAN_DELTA = 3
CARTESIAN_POSE = 4

_IK_ITERATIONS = 4
_VECTORS = 6  # (n,) at the start of the scratch memory, then (5, n), (n, n), (6, n), 72 numbers, and that of the model


@njit
def scratch_size(n, work_size):
    """Numbers of scratch memory for n joints and a model with so many numbers of its own."""
    return _VECTORS * n + 5 * n + n * n + 6 * n + 72 + work_size + n


@njit
def _unit(value):
    """A number of an action within [-1, 1]; 0 where it is not a number."""
    return min(max(value, -1.0), 1.0) if value == value else 0.0


@njit
def approach_speed(way, a_max, rate):
    """The signed speed from which a joint stops within a way: sqrt(2 a s), exponential near the end."""
    distance = abs(way)
    speed = rate * distance
    if speed * rate > a_max:
        speed = math.sqrt(2.0 * a_max * (distance - 0.5 * a_max / (rate * rate)))
    return math.copysign(speed, way)


@njit
def _rotate(vector, rotation, out):
    """out = exp(vector) rotation, (9,) each, by Rodrigues' formula."""
    angle = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if angle < 1e-12:
        for k in range(9):
            out[k] = rotation[k]
        return
    x = vector[0] / angle
    y = vector[1] / angle
    z = vector[2] / angle
    sine = math.sin(angle)
    rest = 1.0 - math.cos(angle)
    for k in range(3):
        a = rotation[k]
        b = rotation[3 + k]
        c = rotation[6 + k]
        along = (x * a + y * b + z * c) * rest
        out[k] = math.cos(angle) * a + sine * (y * c - z * b) + x * along
        out[3 + k] = math.cos(angle) * b + sine * (z * a - x * c) + y * along
        out[6 + k] = math.cos(angle) * c + sine * (x * b - y * a) + z * along


@njit
def _find_tip(model, q, work, tip):
    """The tip's position and rotation matrix, (12,)."""
    place(model, q, work)
    locate(model, work)
    x, y, z = tip_position(model, work)
    tip[0] = x
    tip[1] = y
    tip[2] = z
    tip_rotation(model, work, tip[3:])


@njit
def _tip_error(goal, tip, error):
    """The twist (6,) from a tip to a goal: the difference of positions, and the sine of the angle times the axis."""
    for k in range(3):
        error[k] = goal[k] - tip[k]
        error[3 + k] = 0.0
    for k in range(3):
        ax = tip[3 + k]
        ay = tip[6 + k]
        az = tip[9 + k]
        bx = goal[3 + k]
        by = goal[6 + k]
        bz = goal[9 + k]
        error[3] += 0.5 * (ay * bz - az * by)
        error[4] += 0.5 * (az * bx - ax * bz)
        error[5] += 0.5 * (ax * by - ay * bx)


@njit
def _follow_tip(model, goal, size, damping, limits, way, start, target, work, J, A, error, tip):
    """Moves a target by damped least squares until its tip is at a goal, at most `way` from `start`.

    Nakamura, Hanafusa, "Inverse kinematic solutions with singularity robustness for robot manipulator control" (1986).
    """
    n = target.shape[0]
    for _ in range(_IK_ITERATIONS):
        _find_tip(model, target, work, tip)
        tip_jacobian(model, work, J)
        _tip_error(goal, tip, error)
        for r in range(size):
            for c in range(size):
                total = damping if r == c else 0.0
                for i in range(n):
                    total += J[r, i] * J[c, i]
                A[r, c] = total
        factorize(A)
        solve(A, error[:size])
        for i in range(n):
            change = 0.0
            for r in range(size):
                change += J[r, i] * error[r]
            moved = min(max(target[i] + change, start[i] - way[i]), start[i] + way[i])
            target[i] = min(max(moved, limits[0, i]), limits[1, i])


@njit
def _set_target(table, row, numbers, limits, scratch):
    """Moves the target of a row by its action."""
    n = table[N]
    mode = table[MODE]
    actions = table[ACTIONS]
    action = _matrix(table[ACTION], table[ROWS], actions)[row]
    target = _matrix(table[TARGET], table[ROWS], n)[row]
    if mode == JOINT_DELTA:
        scale = numbers[JOINT_SCALE]
        for i in range(n):
            moved = target[i] + scale * limits[2, i] * _unit(action[i])
            target[i] = min(max(moved, limits[0, i]), limits[1, i])
    elif mode == JOINT_TARGET:
        for i in range(n):
            share = 0.5 * (1.0 + _unit(action[i]))
            target[i] = limits[0, i] + share * (limits[1, i] - limits[0, i])
    elif mode in (CARTESIAN_DELTA, CARTESIAN_POSE):
        way = scratch[:n]
        start = scratch[n : 2 * n]
        rest = scratch[_VECTORS * n + 5 * n + n * n :]
        J = rest[: 6 * n].reshape((6, n))
        A = rest[6 * n : 6 * n + actions * actions].reshape((actions, actions))
        error = rest[6 * n + 36 : 6 * n + 42]
        tip = rest[6 * n + 42 : 6 * n + 54]
        goal = rest[6 * n + 60 : 6 * n + 72]
        turn = rest[6 * n + 54 : 6 * n + 57]
        work = rest[6 * n + 72 :]
        model = _vector(table[NOMINAL], table[MODEL_SIZE])
        for i in range(n):
            way[i] = numbers[PERIOD] * table[TICKS] * limits[2, i]
            start[i] = target[i]
        origin = numbers[HOME_TIP : HOME_TIP + 12]
        if mode == CARTESIAN_DELTA:
            _find_tip(model, target, work, tip)
            origin = tip
        for k in range(3):
            goal[k] = origin[k] + numbers[POSITION_SCALE] * _unit(action[k])
            turn[k] = numbers[ROTATION_SCALE] * _unit(action[3 + k]) if actions == 6 else 0.0
        _rotate(turn, origin[3:], goal[3:])
        _follow_tip(model, goal, actions, numbers[DAMPING], limits, way, start, target, work, J, A, error, tip)


@njit
def _advance_reference(dt, rate, limits, target, reference, q_ref, v_ref):
    """The reference of the next tick: towards the target within speed and acceleration, and a stop at it without overshoot."""
    for i in range(target.shape[0]):
        way = target[i] - q_ref[i]
        speed = approach_speed(way, limits[3, i], rate)
        speed = min(max(speed, -limits[2, i]), limits[2, i])
        change = limits[3, i] * dt
        after = min(max(speed, v_ref[i] - change), v_ref[i] + change)
        reference[Q_REF, i] = q_ref[i]
        reference[V_REF, i] = v_ref[i]
        reference[V_TICK, i] = v_ref[i]
        reference[A_REF, i] = (after - v_ref[i]) / dt
        reference[A_TICK, i] = reference[A_REF, i]
        v_ref[i] = after
        q_ref[i] += dt * after


@njit
def _guard(model, dt, rate, limits, q, v, tau, M, a, zero, force, work):
    """Changes a torque that would drive a joint too fast or into a stop, to one that brakes it; others stay as they are."""
    n = q.shape[0]
    for i in range(n):
        zero[i] = 0.0
    inverse_dynamics(model, q, v, zero, work, force)
    mass_matrix(model, work, M)
    add_implicit_damping(model, M)
    for i in range(n):
        a[i] = tau[i] - force[i]
    factorize(M)
    solve(M, a)
    changed = False
    for i in range(n):
        upper = min(approach_speed(limits[1, i] - q[i], limits[3, i], rate), limits[2, i])
        lower = max(approach_speed(limits[0, i] - q[i], limits[3, i], rate), -limits[2, i])
        brake = 2.0 * limits[3, i]
        highest = max((upper - v[i]) / dt, -brake)
        lowest = min((lower - v[i]) / dt, brake)
        bounded = min(max(a[i], lowest), highest)
        changed = changed or bounded != a[i]
        a[i] = bounded
    if changed:
        inverse_dynamics(model, q, v, a, work, tau)


@njit
def _stop(limits, q, v):
    """The mechanical stops of a plant in free space: a joint that reaches one stays there."""
    for i in range(q.shape[0]):
        if q[i] < limits[0, i]:
            q[i] = limits[0, i]
            v[i] = max(v[i], 0.0)
        elif q[i] > limits[1, i]:
            q[i] = limits[1, i]
            v[i] = min(v[i], 0.0)


@njit
def _step_mujoco(table, addresses, tau, q, v):
    """One step of MuJoCo with the torques (n,); reads positions and velocities."""
    n = table[N]
    gear = _vector(table[GEAR], n)
    bounds = _matrix(table[BOUNDS], 2, n)
    indices = numba.carray(_integers(table[INDICES]), (3, n))
    ctrl = _vector(addresses[4], table[NCTRL])
    for i in range(n):
        ctrl[indices[2, i]] = min(max(tau[i], bounds[0, i]), bounds[1, i]) / gear[i]
    _step(table[STEP_FUNCTION], addresses[0], addresses[1])
    qpos = _vector(addresses[2], table[NQ])
    qvel = _vector(addresses[3], table[NV])
    for i in range(n):
        q[i] = qpos[indices[0, i]]
        v[i] = qvel[indices[1, i]]


@njit
def step_rows(table):
    """One step of the environments [FIRST, LAST)."""
    n = table[N]
    rows = table[ROWS]
    numbers = _vector(table[NUMBERS], NUMBER_COUNT)
    limits = _matrix(table[LIMITS], 5, n)
    bounds = _matrix(table[BOUNDS], 2, n)
    scratch = _vector(table[SCRATCH], table[SCRATCH_SIZE])
    parameters = _vector(table[PARAMETERS], table[PARAMETERS_SIZE])
    memories = _matrix(table[MEMORY], rows, table[MEMORY_SIZE])
    nominal = _vector(table[NOMINAL], table[MODEL_SIZE])
    plants = _matrix(table[PLANTS], rows, table[MODEL_SIZE])
    actions = _matrix(table[ACTION], rows, table[ACTIONS])
    positions = _matrix(table[Q], rows, n)
    velocities = _matrix(table[V], rows, n)
    targets = _matrix(table[TARGET], rows, n)
    q_references = _matrix(table[Q_REFERENCE], rows, n)
    v_references = _matrix(table[V_REFERENCE], rows, n)
    tips = _matrix(table[TIP], rows, 12)
    addresses = numba.carray(_integers(table[DATAS]), (rows, 5))
    tau = scratch[:n]
    zero = scratch[n : 2 * n]
    force = scratch[2 * n : 3 * n]
    a = scratch[3 * n : 4 * n]
    reference = scratch[_VECTORS * n : _VECTORS * n + 5 * n].reshape((5, n))
    M = scratch[_VECTORS * n + 5 * n : _VECTORS * n + 5 * n + n * n].reshape((n, n))
    work = scratch[_VECTORS * n + 5 * n + n * n + 6 * n + 72 :]
    inner = work[: work.shape[0] - n]
    dt = numbers[PERIOD]
    rate = numbers[APPROACH_RATE]
    for row in range(table[FIRST], table[LAST]):
        q = positions[row]
        v = velocities[row]
        _set_target(table, row, numbers, limits, scratch)
        for _ in range(table[TICKS]):
            if table[MODE] == TORQUE:
                for i in range(n):
                    tau[i] = limits[4, i] * _unit(actions[row, i])
                _guard(nominal, dt, rate, limits, q, v, tau, M, a, zero, force, inner)
            else:
                _advance_reference(dt, rate, limits, targets[row], reference, q_references[row], v_references[row])
                _call_kernel(table[KERNEL], parameters, q, v, reference, memories[row], tau)
            if addresses[row, 1] == 0:
                for i in range(n):
                    zero[i] = 0.0
                free_step(plants[row], bounds, tau, zero, work, q, v)
                _stop(limits, q, v)
            else:
                _step_mujoco(table, addresses[row], tau, q, v)
        _find_tip(nominal, q, inner, tips[row])


@c_function(types.void(types.intp, types.intp, types.int32, types.intp))
def step_table(model, data, simulation, table):
    """A function for `mjb_apply`: steps the rows of the table at an address."""
    step_rows(numba.carray(_integers(table), (TABLE_SIZE,)))


STEP_TABLE = int(step_table.address or 0)
