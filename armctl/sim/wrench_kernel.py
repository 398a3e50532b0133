"""What a wrench sensor measures at a tick, for the Python loop and, as a C function, for the compiled loop.

Only a simulation whose controller needs the wrench imports this.
"""

# Intrinsics are called without their first argument, and numba does not list what it exports.
# pyright: reportCallIssue=false, reportPrivateImportUsage=false

from __future__ import annotations

import math

import numba
from numba import types

from armctl.core.addresses import call_step, integers, matrix, short_integers, vector
from armctl.core.jit import c_function, njit
from armctl.robot.dynamics_kernel import add_friction, inverse_dynamics, locate, place, tip_jacobian

# Entries of the table of one arm. SIZES:
N = 0  # joints
BODIES_COUNT = 1  # behind the last joint
ALL_BODIES = 2  # of the model
KEPT = 3  # samples
MODEL_SIZE = 4
WORK_SIZE = 5
ROWS = 6  # of a wrench that torques tell: 3 or 6; 0 if a flange sensor measures it
# MuJoCo:
MODEL = 7
DATA = 8
POST_CONSTRAINT = 9  # mj_rnePostConstraint
CONTACT_COUNT = 10  # offset in mjData
IS_CONNECTED = 11  # equalities act on bodies
ROOT = 12  # body
TIP = 13  # body
XFRC_APPLIED = 14
CFRC_EXT = 15
XPOS = 16
XMAT = 17
SUBTREE_COM = 18
# Arrays:
BODIES = 19  # (bodies,) int64
OFFSET = 20  # (3,) m, of the tip in its body
PERIOD = 21  # (2,) s: the tick, and the age up to which samples are kept
SAMPLES = 22  # (kept, 7): time and wrench; a ring
DYNAMICS = 23
WORK = 24
ESTIMATE = 25  # numbers of the estimate, see `estimate_size`
PUSH = 26  # (6,) the wrench of the pushes; 0 for none
Q = 27  # (n,) measured
V = 28
TORQUE = 29  # (n,) N m of the motors
RESULT = 30  # (6,)
TIMES = 31  # (ticks,) s
NOISE = 32  # (ticks, 6); 0 for none
TRUE = 33  # (ticks, 6)
IS_SAMPLED = 34  # noise, delay or an estimate: the result is not the true wrench
# State:
TICK = 35  # the row of times, noise and true wrenches
OLDEST = 36  # sample
COUNT = 37  # samples
TABLE_SIZE = 38

SAMPLE_SIZE = 7
ESTIMATE_BANDWIDTH = 200.0  # rad/s of the low-pass of wrenches that are estimated from torques

_VECTORS = 5  # (n,) of the estimate: last position, last velocity, filtered torque, acceleration, inverse dynamics
_MAX_SWEEPS = 30  # of the orthogonalization, which converges in about 6
_EPSILON = 2.220446049250313e-16


def estimate_size(n: int) -> int:
    """Numbers of the estimate of an arm of n joints: the last time, vectors, Jacobian and rotations."""
    return 1 + _VECTORS * n + 6 * n + 36


@njit
def sense(table):
    """The wrench that the sensor gives at this tick, the same until the next one; notes the true one."""
    tick = table[TICK]
    table[TICK] = tick + 1
    true = vector(table[TRUE] + 48 * tick, 6)
    result = vector(table[RESULT], 6)
    read_wrench(table, true)
    if table[IS_SAMPLED] == 0:
        for k in range(6):
            result[k] = true[k]
        return
    t = vector(table[TIMES] + 8 * tick, 1)[0]
    kept = table[KEPT]
    samples = matrix(table[SAMPLES], kept, SAMPLE_SIZE)
    newest = (table[OLDEST] + table[COUNT] - 1) % kept
    if table[COUNT] == 0 or samples[newest, 0] != t:
        if table[COUNT] == kept:  # somebody else makes ticks, too
            table[OLDEST] = (table[OLDEST] + 1) % kept
            table[COUNT] -= 1
        newest = (newest + 1) % kept
        table[COUNT] += 1
        samples[newest, 0] = t
        for k in range(6):
            samples[newest, 1 + k] = true[k]
        if table[ROWS] > 0:
            _estimate(table, t, samples[newest, 1:])
        if table[NOISE] != 0:
            noise = vector(table[NOISE] + 48 * tick, 6)
            for k in range(6):
                samples[newest, 1 + k] += noise[k]
    age = vector(table[PERIOD], 2)[1]
    while table[COUNT] > 1 and samples[table[OLDEST], 0] < t - age:
        table[OLDEST] = (table[OLDEST] + 1) % kept
        table[COUNT] -= 1
    for k in range(6):
        result[k] = samples[table[OLDEST], 1 + k]


@njit
def read_wrench(table, wrench):
    """The true wrench (6,) on the tip: of contacts, connections, applied forces and pushes."""
    for k in range(6):
        wrench[k] = 0.0
    is_loaded = table[IS_CONNECTED] != 0
    is_loaded |= numba.carray(short_integers(table[DATA] + table[CONTACT_COUNT]), (1,))[0] != 0
    if not is_loaded:
        applied = vector(table[XFRC_APPLIED], 6 * table[ALL_BODIES])
        for k in range(len(applied)):
            is_loaded |= applied[k] != 0.0
    if is_loaded:
        call_step(table[POST_CONSTRAINT], table[MODEL], table[DATA])
        _sum_external_forces(table, wrench)
    if table[PUSH] != 0:
        push = vector(table[PUSH], 6)
        for k in range(6):
            wrench[k] += push[k]


@njit
def _sum_external_forces(table, wrench):
    """MuJoCo's external forces on the bodies behind the last joint, which have torques first, about the tree's center of mass.

    Forces between two of the bodies, such as two fingers, cancel.
    """
    external = matrix(table[CFRC_EXT], table[ALL_BODIES], 6)
    bodies = numba.carray(integers(table[BODIES]), (table[BODIES_COUNT],))
    for body in bodies:
        for k in range(3):
            wrench[k] += external[body, 3 + k]
            wrench[3 + k] += external[body, k]
    position = vector(table[XPOS] + 24 * table[TIP], 3)
    rotation = matrix(table[XMAT] + 72 * table[TIP], 3, 3)
    center = vector(table[SUBTREE_COM] + 24 * table[ROOT], 3)
    offset = vector(table[OFFSET], 3)
    x = position[0] - center[0]
    y = position[1] - center[1]
    z = position[2] - center[2]
    for k in range(3):
        x += rotation[0, k] * offset[k]
        y += rotation[1, k] * offset[k]
        z += rotation[2, k] * offset[k]
    wrench[3] -= y * wrench[2] - z * wrench[1]
    wrench[4] -= z * wrench[0] - x * wrench[2]
    wrench[5] -= x * wrench[1] - y * wrench[0]


@njit
def _estimate(table, t, wrench):
    """The wrench on the tip from torques and motion of the joints, w = J^-T LP[ID(q, v, (v_next - v) / dt) - tau].

    After De Luca, Mattone, "Sensorless robot collision detection and hybrid force/motion control" (2005), with the discrete
    inverse dynamics of the nominal model. Errors of the model, such as friction and payloads, appear as forces.
    """
    n = table[N]
    state = vector(table[ESTIMATE], 1 + _VECTORS * n + 6 * n + 36)
    last_q = state[1 : 1 + n]
    last_v = state[1 + n : 1 + 2 * n]
    filtered = state[1 + 2 * n : 1 + 3 * n]
    acceleration = state[1 + 3 * n : 1 + 4 * n]
    needed = state[1 + 4 * n : 1 + 5 * n]
    at = 1 + _VECTORS * n
    J = state[at : at + 6 * n].reshape((6, n))
    rotations = state[at + 6 * n :].reshape((6, 6))
    model = vector(table[DYNAMICS], table[MODEL_SIZE])
    work = vector(table[WORK], table[WORK_SIZE])
    q = vector(table[Q], n)
    v = vector(table[V], n)
    tau = vector(table[TORQUE], n)
    dt = vector(table[PERIOD], 2)[0]
    if abs(t - state[0] - dt) <= 0.5 * dt:
        for i in range(n):
            acceleration[i] = (v[i] - last_v[i]) / dt
        inverse_dynamics(model, last_q, last_v, acceleration, work, needed)
        add_friction(model, last_v, acceleration, work, needed)
        for i in range(n):
            filtered[i] -= math.expm1(-ESTIMATE_BANDWIDTH * dt) * (needed[i] - tau[i] - filtered[i])
    else:
        for i in range(n):
            filtered[i] = 0.0
    state[0] = t
    for i in range(n):
        last_q[i] = q[i]
        last_v[i] = v[i]
    place(model, q, work)
    locate(model, work)
    tip_jacobian(model, work, J)
    for k in range(6):
        wrench[k] = 0.0
    rows = table[ROWS]
    solve_least_squares(J[:rows], filtered, rotations[:rows], wrench)


@njit
def solve_least_squares(A, b, rotations, x):
    """Adds to x (r,) the shortest vector that minimizes |A^T x - b|, by one-sided Jacobi rotations of the rows of A (r, n).

    After Hestenes (1958), see Golub and Van Loan, Matrix Computations (2013), 8.6.3. The rows of A become orthogonal, and
    `rotations` (r, 6 or more) is scratch. Rows of less than rounding errors count as zero.
    """
    r, n = A.shape
    for i in range(r):
        for k in range(r):
            rotations[i, k] = 1.0 if i == k else 0.0
    for _ in range(_MAX_SWEEPS):
        is_orthogonal = True
        for i in range(r - 1):
            for k in range(i + 1, r):
                is_orthogonal &= not _orthogonalize(A, rotations, i, k)
        if is_orthogonal:
            break
    largest = 0.0
    for i in range(r):
        largest = max(largest, _product(A, i, i))
    threshold = _EPSILON * max(r, n)
    for i in range(r):
        squared = _product(A, i, i)
        if squared > threshold * threshold * largest:
            along = 0.0
            for j in range(n):
                along += A[i, j] * b[j]
            for k in range(r):
                x[k] += rotations[i, k] * along / squared


@njit
def _product(A, i, k):
    total = 0.0
    for j in range(A.shape[1]):
        total += A[i, j] * A[k, j]
    return total


@njit
def _orthogonalize(A, rotations, i, k):
    """Rotates two rows until they are orthogonal; False if they were."""
    first = _product(A, i, i)
    second = _product(A, k, k)
    both = _product(A, i, k)
    if not abs(both) > 1e-15 * math.sqrt(first * second):
        return False
    half = 0.5 * (second - first) / both
    tangent = math.copysign(1.0, half) / (abs(half) + math.sqrt(1.0 + half * half))
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    for j in range(A.shape[1]):
        x = A[i, j]
        y = A[k, j]
        A[i, j] = cosine * x - sine * y
        A[k, j] = sine * x + cosine * y
    for j in range(A.shape[0]):
        x = rotations[i, j]
        y = rotations[k, j]
        rotations[i, j] = cosine * x - sine * y
        rotations[k, j] = sine * x + cosine * y
    return True


@c_function(types.intp(types.intp), borrows=True)
def sense_table(address):
    """Senses by the table at an address."""
    sense(numba.carray(integers(address), (TABLE_SIZE,)))
    return 0
