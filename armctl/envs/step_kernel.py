"""The compiled step of a batch of environments: action, reference, controller and plant, for a range of rows.

It runs as a C function inside `mjb_apply`, as the tick loop of a simulation does. The table and everything that it points to
belong to one range of rows, so ranges on different threads share nothing that they write.
"""

# pyright: reportCallIssue=false, reportPrivateImportUsage=false

from __future__ import annotations

import math

import numba
from numba import types

from armctl.control import computed_torque_kernel as law
from armctl.control.kernel import A_REF, A_TICK, Q_REF, V_REF, V_TICK
from armctl.control.kernel_call import call_kernel
from armctl.core.addresses import floats, integers, matrix, short_integers, vector
from armctl.core.jit import c_function, njit
from armctl.envs.difference_kernel import COLUMNS, subtract_mass, subtract_torque
from armctl.envs.tip_kernel import find_tip, follow_tip, rotate
from armctl.robot.dynamics_kernel import (
    add_implicit_damping,
    factorize,
    inverse_dynamics,
    mass_matrix,
    multiply,
    solve,
)
from armctl.robot.forward_dynamics_kernel import bias_and_mass, move_freely
from armctl.sim.tick_kernel import step

# Entries of the table. SIZES:
ROWS = 0
N = 1  # joints
NQ = 2
NV = 3
NCTRL = 4
NU = 5
FIRST = 6  # the range of rows
LAST = 7
TICKS = 8  # of a step of the environment
MODE = 9  # one of the action modes
ACTIONS = 10  # numbers of an action of the arm
ACTION_WIDTH = 11  # ... and of the gripper
PARAMETERS_SIZE = 12
MEMORY_SIZE = 13
MODEL_SIZE = 14
SCRATCH_SIZE = 15
GRIPPERS = 16  # actuators of the gripper; 0 without one
COMMAND_DEPTH = 17  # ticks in the ring buffer of commands; 1 without delays
# Where the loose object and the obstacle are; -1 without one:
OBJECT_QPOS = 18
OBJECT_QVEL = 19
OBSTACLE = 20  # its geom
# Offsets of MuJoCo's contacts, as in ContactLayout:
CONTACT_COUNT = 21
CONTACT_ARRAY = 22
CONTACT_STRIDE = 23
CONTACT_GEOMS = 24
# Addresses:
STEP_FUNCTION = 25
KERNEL = 26
PARAMETERS = 27
MEMORY = 28  # (rows, size)
NOMINAL = 29  # the model that the controller knows
PLANTS = 30  # (rows, size) dynamics of each plant in free space
# (rows, 7) int64: addresses of MjModel, MjData, qpos, qvel, ctrl, actuator_length, and of the table for steps without
# collision detection; 0 in free space
DATAS = 31
BOUNDS = 32  # (2, n) torques of the motors
LIMITS = 33  # (5, n): least and greatest position, greatest speed, acceleration and torque
NUMBERS = 34  # (NUMBER_COUNT,)
INDICES = 35  # (3, n) int64: the joints in qpos, in qvel, their motors in ctrl
GEAR = 36
SCRATCH = 37
ACTION = 38  # (rows, width)
Q = 39  # (rows, n), as all that follow up to TIP
V = 40
TARGET = 41
Q_REFERENCE = 42
V_REFERENCE = 43
TIP = 44  # (rows, 12): position, rotation matrix
GRIPPER_INDICES = 45  # (2, grippers) int64: in ctrl, in actuator_length
GRIPPER_ENDS = 46  # (4, grippers): controls when closed and open, lengths when closed and open
GRIP_TARGET = 47  # (rows,) where the gripper's controls are, from closed (0) to open (1)
OPENING = 48  # (rows,) where the gripper is
OBJECT = 49  # (rows, 13): position, quaternion, velocity, angular velocity
TOUCHED = 50  # (rows,) int64: ticks of this step at which something touched the obstacle
DELAYS = 51  # (rows,) int64: ticks
COMMANDS = 52  # (rows, depth, n): ring buffer of the torques
GIVEN = 53  # (rows,) int64: commands since the start of the episode
NOISE = 54  # (rows, ticks, 2, n) on measured positions and velocities; 0 for none
SHARED = 55  # (rows,) int64: what the plant's dynamics share with those that the controller knows
DIFFERENCES = 56  # (rows, n, columns) of the plant's dynamics from those, where they differ
TABLE_SIZE = 57

# What the dynamics of plant and controller share, so that it is computed once per tick:
NOTHING = 0
GEOMETRY = 1  # masses and drives differ
EVERYTHING = 2

# Numbers:
PERIOD = 0  # s
JOINT_SCALE = 1  # fraction of the way at full speed that a joint moves in a step by a full action
POSITION_SCALE = 2  # m, of a full cartesian action
ROTATION_SCALE = 3  # rad
APPROACH_RATE = 4  # 1/s
DAMPING = 5  # of the inverse Jacobian, squared
GRIP_STEP = 6  # of the way from closed to open, in a tick
HOME_TIP = 7  # (12,)
NUMBER_COUNT = 19

TORQUE = 0
JOINT_DELTA = 1
JOINT_TARGET = 2
CARTESIAN_DELTA = 3
CARTESIAN_POSE = 4

# The scratch memory: vectors (n,), then (5, n), matrices (n, n), (6, n), 72 numbers, and that of the model.
_VECTORS = 6
_MATRICES = 2


@njit
def _own_size(n):
    """Numbers of scratch memory in front of that of the model."""
    return (_VECTORS + 5) * n + _MATRICES * n * n + 6 * n + 72


@njit
def scratch_size(n, work_size):
    """Numbers of scratch memory for n joints and a model with so many numbers of its own."""
    return _own_size(n) + work_size


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
def _move_target(mode, ticks, model, numbers, limits, action, target, scratch):
    """Moves joint targets (n,) by the action of the arm."""
    n = target.shape[0]
    actions = action.shape[0]
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
        rest = scratch[(_VECTORS + 5) * n + _MATRICES * n * n :]
        J = rest[: 6 * n].reshape((6, n))
        A = rest[6 * n : 6 * n + actions * actions].reshape((actions, actions))
        error = rest[6 * n + 36 : 6 * n + 42]
        tip = rest[6 * n + 42 : 6 * n + 54]
        goal = rest[6 * n + 60 : 6 * n + 72]
        turn = rest[6 * n + 54 : 6 * n + 57]
        work = rest[6 * n + 72 :]
        for i in range(n):
            way[i] = numbers[PERIOD] * ticks * limits[2, i]
            start[i] = target[i]
        find_tip(model, target, work, tip)
        origin = tip if mode == CARTESIAN_DELTA else numbers[HOME_TIP : HOME_TIP + 12]
        for k in range(3):
            goal[k] = origin[k] + numbers[POSITION_SCALE] * _unit(action[k])
            turn[k] = numbers[ROTATION_SCALE] * _unit(action[3 + k]) if actions == 6 else 0.0
        rotate(turn, origin[3:], goal[3:])
        follow_tip(model, goal, actions, numbers[DAMPING], limits, way, start, target, work, J, A, error, tip)


@njit
def _advance_reference(numbers, limits, target, reference, q_ref, v_ref):
    """The reference of the next tick: towards the target within speed and acceleration, and a stop at it without overshoot."""
    dt = numbers[PERIOD]
    rate = numbers[APPROACH_RATE]
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
def rehearse(mode, ticks, model, numbers, limits, action, target, q_ref, v_ref, scratch):
    """Moves target and reference (n,) as in one step: the motion of an arm that follows its reference."""
    n = target.shape[0]
    _move_target(mode, ticks, model, numbers, limits, action, target, scratch)
    reference = scratch[_VECTORS * n : _VECTORS * n + 5 * n].reshape((5, n))
    for _ in range(ticks):
        _advance_reference(numbers, limits, target, reference, q_ref, v_ref)


@njit
def _factorize_inertia(model, M):
    """Replaces a mass matrix by the factors of the inertia that a step acts against."""
    add_implicit_damping(model, M)
    factorize(M)


@njit
def _find_known(plant, nominal, difference, v, a, work, bias, M, known_bias, known_factors):
    """As `_find_dynamics` of the nominal model, from what `bias_and_mass` found for the plant; `a` is scratch (n,)."""
    n = v.shape[0]
    for i in range(n):
        a[i] = 0.0
        known_bias[i] = bias[i]
        for k in range(i + 1):
            known_factors[i, k] = M[i, k]
    subtract_torque(plant, difference, v, a, work, known_bias)
    subtract_mass(plant, difference, work, known_factors)
    _factorize_inertia(nominal, known_factors)


@njit
def _find_dynamics(model, q, v, a, work, bias, factors):
    """The torques (n,) that keep the velocity, and the factors (n, n) of the inertia of a step; `a` is scratch (n,)."""
    for i in range(q.shape[0]):
        a[i] = 0.0
    inverse_dynamics(model, q, v, a, work, bias)
    mass_matrix(model, work, factors)
    _factorize_inertia(model, factors)


@njit
def _guarded_torque(action, numbers, limits, q, v, bias, factors, tau, a):
    """The torque of an action; where it would drive a joint too fast or into a stop, one that brakes this joint."""
    n = q.shape[0]
    dt = numbers[PERIOD]
    rate = numbers[APPROACH_RATE]
    for i in range(n):
        tau[i] = limits[4, i] * _unit(action[i])
        a[i] = tau[i] - bias[i]
    solve(factors, a)
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
        multiply(factors, a, tau)
        for i in range(n):
            tau[i] += bias[i]


@njit
def _move_freely(table, plant, limits, bias, factors, tau, a, q, v):
    """One tick in free space, with mechanical stops: a joint that reaches one stays there."""
    n = table[N]
    move_freely(plant, matrix(table[BOUNDS], 2, n), bias, factors, tau, a, q, v)
    for i in range(n):
        if q[i] < limits[0, i]:
            q[i] = limits[0, i]
            v[i] = max(v[i], 0.0)
        elif q[i] > limits[1, i]:
            q[i] = limits[1, i]
            v[i] = min(v[i], 0.0)


@njit
def _measure(table, row, tick, q, v, q_seen, v_seen):
    """Positions and velocities as the controller sees them in a tick."""
    n = table[N]
    for i in range(n):
        q_seen[i] = q[i]
        v_seen[i] = v[i]
    if table[NOISE] != 0:
        noise = numba.carray(floats(table[NOISE]), (table[ROWS], table[TICKS], 2, n))[row, tick]
        for i in range(n):
            q_seen[i] += noise[0, i]
            v_seen[i] += noise[1, i]


@njit
def _delay(table, row, tau):
    """Replaces the torque of this tick by that of some ticks ago, or by the first one until then, if there are delays."""
    depth = table[COMMAND_DEPTH]
    if depth == 1:
        return
    n = table[N]
    rows = table[ROWS]
    commands = numba.carray(floats(table[COMMANDS]), (rows, depth, n))[row]
    given = numba.carray(integers(table[GIVEN]), (rows,))
    delay = numba.carray(integers(table[DELAYS]), (rows,))[row]
    newest = given[row] % depth
    oldest = max(given[row] - delay, 0) % depth
    for i in range(n):
        commands[newest, i] = tau[i]
    for i in range(n):
        tau[i] = commands[oldest, i]
    given[row] += 1


@njit
def _drive_gripper(table, row, addresses, step):
    """Moves the controls of the gripper towards the last number of the action, at a limited speed."""
    grippers = table[GRIPPERS]
    indices = numba.carray(integers(table[GRIPPER_INDICES]), (2, grippers))
    ends = matrix(table[GRIPPER_ENDS], 4, grippers)
    ctrl = vector(addresses[4], table[NCTRL])
    targets = vector(table[GRIP_TARGET], table[ROWS])
    action = matrix(table[ACTION], table[ROWS], table[ACTION_WIDTH])[row]
    wanted = 0.5 * (1.0 + _unit(action[table[ACTIONS]]))
    targets[row] = min(max(wanted, targets[row] - step), targets[row] + step)
    for k in range(grippers):
        ctrl[indices[0, k]] = ends[0, k] + targets[row] * (ends[1, k] - ends[0, k])


@njit
def _touches(table, data, geom):
    """Whether a geom is in contact."""
    count = numba.carray(short_integers(data + table[CONTACT_COUNT]), (1,))[0]
    if count == 0:
        return False
    first = numba.carray(integers(data + table[CONTACT_ARRAY]), (1,))[0] + table[CONTACT_GEOMS]
    for k in range(count):
        pair = numba.carray(short_integers(first + k * table[CONTACT_STRIDE]), (2,))
        if pair[0] == geom or pair[1] == geom:
            return True
    return False


@njit
def _observe_scene(table, row, addresses):
    """Reads the gripper's opening and the loose object, which are not in free space."""
    if addresses[1] == 0:
        return
    grippers = table[GRIPPERS]
    if grippers > 0:
        indices = numba.carray(integers(table[GRIPPER_INDICES]), (2, grippers))
        ends = matrix(table[GRIPPER_ENDS], 4, grippers)
        lengths = vector(addresses[5], table[NU])
        share = 0.0
        for k in range(grippers):
            share += (lengths[indices[1, k]] - ends[2, k]) / (ends[3, k] - ends[2, k])
        vector(table[OPENING], table[ROWS])[row] = share / grippers
    if table[OBJECT_QPOS] >= 0:
        qpos = vector(addresses[2], table[NQ])
        qvel = vector(addresses[3], table[NV])
        found = matrix(table[OBJECT], table[ROWS], 13)[row]
        for k in range(7):
            found[k] = qpos[table[OBJECT_QPOS] + k]
        for k in range(6):
            found[7 + k] = qvel[table[OBJECT_QVEL] + k]


@njit
def _step_mujoco(table, addresses, tau, q, v):
    """One step of MuJoCo with the torques (n,); reads positions and velocities."""
    n = table[N]
    gear = vector(table[GEAR], n)
    bounds = matrix(table[BOUNDS], 2, n)
    indices = numba.carray(integers(table[INDICES]), (3, n))
    ctrl = vector(addresses[4], table[NCTRL])
    for i in range(n):
        ctrl[indices[2, i]] = min(max(tau[i], bounds[0, i]), bounds[1, i]) / gear[i]
    step(addresses[6], table[STEP_FUNCTION], addresses[0], addresses[1])
    qpos = vector(addresses[2], table[NQ])
    qvel = vector(addresses[3], table[NV])
    for i in range(n):
        q[i] = qpos[indices[0, i]]
        v[i] = qvel[indices[1, i]]


@njit
def _simulate(table, row, addresses, grip_step, tau, q, v):
    """One tick of a copy on MuJoCo."""
    if table[GRIPPERS] > 0:
        _drive_gripper(table, row, addresses, grip_step)
    _step_mujoco(table, addresses, tau, q, v)
    if table[OBSTACLE] >= 0 and _touches(table, addresses[1], table[OBSTACLE]):
        numba.carray(integers(table[TOUCHED]), (table[ROWS],))[row] += 1


@njit
def _step_row(table, row):  # noqa: PLR0915  # calls with many arrays take time
    """One step of an environment."""
    n = table[N]
    rows = table[ROWS]
    mode = table[MODE]
    numbers = vector(table[NUMBERS], NUMBER_COUNT)
    limits = matrix(table[LIMITS], 5, n)
    parameters = vector(table[PARAMETERS], table[PARAMETERS_SIZE])
    memory = matrix(table[MEMORY], rows, table[MEMORY_SIZE])[row]
    nominal = vector(table[NOMINAL], table[MODEL_SIZE])
    plant = matrix(table[PLANTS], rows, table[MODEL_SIZE])[row]
    difference = numba.carray(floats(table[DIFFERENCES]), (rows, n, COLUMNS))[row]
    share = numba.carray(integers(table[SHARED]), (rows,))[row]
    addresses = numba.carray(integers(table[DATAS]), (rows, 7))[row]
    q = matrix(table[Q], rows, n)[row]
    v = matrix(table[V], rows, n)[row]
    target = matrix(table[TARGET], rows, n)[row]
    q_reference = matrix(table[Q_REFERENCE], rows, n)[row]
    v_reference = matrix(table[V_REFERENCE], rows, n)[row]
    action = matrix(table[ACTION], rows, table[ACTION_WIDTH])[row, : table[ACTIONS]]
    scratch = vector(table[SCRATCH], table[SCRATCH_SIZE])
    tau = scratch[0 * n : 1 * n]
    bias = scratch[1 * n : 2 * n]
    a = scratch[2 * n : 3 * n]
    q_seen = scratch[3 * n : 4 * n]
    v_seen = scratch[4 * n : 5 * n]
    known_bias = bias if share == EVERYTHING else scratch[5 * n : 6 * n]
    reference = scratch[_VECTORS * n : (_VECTORS + 5) * n].reshape((5, n))
    matrices = scratch[(_VECTORS + 5) * n : (_VECTORS + 5) * n + _MATRICES * n * n].reshape((_MATRICES, n, n))
    factors = matrices[0]
    known_factors = matrices[0 if share == EVERYTHING else 1]
    work = scratch[_own_size(n) :]
    _move_target(mode, table[TICKS], nominal, numbers, limits, action, target, scratch)
    for tick in range(table[TICKS]):
        _measure(table, row, tick, q, v, q_seen, v_seen)
        if share != NOTHING:
            bias_and_mass(plant, q, v, work, bias, factors)
            if share == GEOMETRY and mode == TORQUE:
                _find_known(plant, nominal, difference, v, a, work, bias, factors, known_bias, known_factors)
            _factorize_inertia(plant, factors)
        if mode == TORQUE:
            if share == NOTHING:
                _find_dynamics(nominal, q_seen, v_seen, a, work, known_bias, known_factors)
            _guarded_torque(action, numbers, limits, q_seen, v_seen, known_bias, known_factors, tau, a)
        else:
            _advance_reference(numbers, limits, target, reference, q_reference, v_reference)
            if share == NOTHING:
                call_kernel(table[KERNEL], parameters, q_seen, v_seen, reference, memory, tau)
            else:
                law.command_acceleration(parameters, q, v, reference, memory, n)
                acceleration = law.vector(memory, n, law.ACCELERATION)
                multiply(factors, acceleration, tau)
                for i in range(n):
                    tau[i] += bias[i]
                if share == GEOMETRY:
                    subtract_torque(plant, difference, v, acceleration, work, tau)
                law.add_feedback(parameters, q, v, reference, memory, tau)
        _delay(table, row, tau)
        if addresses[1] == 0:
            if share == NOTHING:
                bias_and_mass(plant, q, v, work, bias, factors)
                _factorize_inertia(plant, factors)
            _move_freely(table, plant, limits, bias, factors, tau, a, q, v)
        else:
            _simulate(table, row, addresses, numbers[GRIP_STEP], tau, q, v)
    _observe_scene(table, row, addresses)
    find_tip(nominal, q, work, matrix(table[TIP], rows, 12)[row])


@njit
def step_rows(table):
    """One step of the environments [FIRST, LAST)."""
    touched = numba.carray(integers(table[TOUCHED]), (table[ROWS],))
    for row in range(table[FIRST], table[LAST]):
        touched[row] = 0
        _step_row(table, row)


@c_function(types.void(types.intp, types.intp, types.int32, types.intp), borrows=True)
def step_table(model, data, simulation, table):
    """A function for `mjb_apply`: steps the rows of the table at an address."""
    step_rows(numba.carray(integers(table), (TABLE_SIZE,)))


STEP_TABLE = int(step_table.address or 0)
