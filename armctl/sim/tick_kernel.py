"""The compiled tick loop: the same ticks as `Stepper._run_ticks`, for a controller that has a kernel.

The loop runs as a C function inside `mjb_apply`, which passes one address: that of a table of int64 with numbers and addresses
of arrays. The table and everything that it points to belong to one run, so runs on different threads share nothing.
"""

# Intrinsics are called without their first argument, and numba does not list what it exports.
# pyright: reportCallIssue=false, reportPrivateImportUsage=false

from __future__ import annotations

import math

import mujoco
import numba
import numpy as np
from numba import types

from armctl.control.kernel_call import call_kernel
from armctl.core.addresses import call_step, call_with_table, floats, integers, matrix, short_integers, vector
from armctl.core.jit import c_function, njit, njit_inlined
from armctl.robot.dynamics_kernel import locate, place, tip_jacobian
from armctl.robot.forward_dynamics_kernel import bias_and_inertia, finish_step

# Entries of the table. SIZES:
N = 0  # joints
NQ = 1
NV = 2
NCTRL = 3
TICKS = 4  # rows of the reference
FIRST = 5  # the run begins at this row ...
LAST = 6  # ... and ends before this one
SUBSTEPS = 7
DELAY = 8  # ticks
COMMANDS_GIVEN = 9  # ticks whose command is in the ring buffer, since the last reset
EVENTS_SIZE = 10
PUSHED_JOINTS = 11  # joints of the arm on whose tip pushes act; 0 without pushes
# Addresses of MuJoCo:
MODEL = 12
DATA = 13
STEP_FUNCTION = 14
CONTACT_COUNT = 15  # offsets, as in ContactLayout
CONTACT_ARRAY = 16
CONTACT_STRIDE = 17
CONTACT_GEOMS = 18
# Addresses of arrays:
QPOS = 19
QVEL = 20
CTRL = 21
QFRC_ACTUATOR = 22
QFRC_APPLIED = 23
INDICES = 24  # (4, n) int64: the joints in qpos, in qvel, their motors in ctrl, their torques in qfrc_actuator
SCALES = 25  # (2, n): gear, torque per unit of qfrc_actuator
KERNEL = 26
PARAMETERS = 27
PARAMETERS_SIZE = 28
MEMORY = 29
MEMORY_SIZE = 30
REFERENCE = 31  # (5,) addresses of q, v, a, v_tick and a_tick, each (ticks, n)
NOISE = 32  # (LAST - FIRST, 2, n) on measured positions and velocities; 0 for none
COMMANDS = 33  # (delay + 1, n) ring buffer; 0 if the motors receive the command itself
RIPPLE = 34  # (1,)
WRENCHES = 35  # (LAST - FIRST, 6) of the pushes
PUSHED_MODEL = 36
PUSHED_MODEL_SIZE = 37
SCRATCH = 38
SCRATCH_SIZE = 39
QPOS_ROWS = 40
V_ROWS = 41
COMMAND_ROWS = 42
TORQUE_ROWS = 43
EVENTS = 44  # (events size,) int32: row, number of contacts, geoms; again
FREE_MODEL = 45  # dynamics of a plant in free space; 0 for mj_step
FREE_MODEL_SIZE = 46
FREE_BOUNDS = 47  # (2, n)
FREE_WORK = 48
FREE_WORK_SIZE = 49
KNOWN_DYNAMICS = 50  # where the controller's kernel leaves inertia and bias of the same model; 0 if the plant computes them
SKIP = 51  # the table for skipping collision detection, see below; 0 for none
PUSH = 52  # (6,) the wrench of the pushes now, which the loop writes
SENSE = 53  # a C function that measures the wrench ...
SENSE_TABLE = 54  # ... and its argument; 0 if the controller needs no wrench
# Results:
ROW = 55  # the last row that was begun
COUNT = 56  # complete rows
STATUS = 57
EVENTS_USED = 58
LAST_EVENT = 59  # where the last event begins; -1 before the first
TABLE_SIZE = 60

# Entries of the table for skipping collision detection. It belongs to one MjData, and tells in which box of joint positions
# nothing can touch. Addresses:
SKIP_FLAGS = 0  # of `disableflags` in MjModel, int32
SKIP_QPOS = 1
SKIP_QVEL = 2
SKIP_INDICES = 3  # (2, joints) int64: in qpos, in qvel
SKIP_BOX = 4  # (2, joints), the least and the greatest positions
SKIP_POSITIONS = 5  # (joints,) the center of the box that is to be proved ...
SKIP_DELTA = 6  # (joints,) ... and its half width, which the proof reduces
SKIP_PROOF = 7  # a C function that returns 0 if there is no such box, ...
SKIP_PROOF_TABLE = 8  # ... and its argument
# Numbers:
SKIP_JOINTS = 9
SKIP_NQ = 10
SKIP_NV = 11
SKIP_NORMAL = 12  # the flags of the model
SKIP_IS_NEW = 13  # whether the box was not left since it was proved
SKIP_LASTED = 14  # steps in the box
SKIP_WAIT = 15  # steps until the next proof
SKIP_PAUSE = 16  # steps between proofs that did not pay
SKIP_SKIPPED = 17  # steps without collision detection
SKIP_PROOFS = 18
SKIP_SIZE = 19

NO_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
BOX_TIME_S = 0.04  # the joints reach the border of a box in this time at their speed
BOX_MARGIN = 2e-3  # rad (m), more than that
MIN_BOX_STEPS = 4  # a proof takes as long as collision detection in a few steps
MAX_PAUSE = 64  # so many steps after a contact, proofs begin again

# Vectors (n,) at the start of the scratch memory; then J and scratch of the model for pushes.
Q = 0
Q_SEEN = 1
V_SEEN = 2
TAU = 3
V = 4
APPLIED = 5
REFERENCE_ROW = 6  # five vectors, the rows of `Setpoint`
SCRATCH_VECTORS = 11

COMPLETE = 0
DIVERGED = 1
NOT_FINITE = 2
KERNEL_FAILED = 3
EVENTS_FULL = 4  # the contacts of the last complete row are new, but there is no place for them

RIPPLES_PER_RADIAN = 12.0  # 75 a turn, typical of a motor behind a gear
MAX_SPEED = 1e4  # rad/s (m/s), of all joints together; above it a run counts as diverged


@njit
def rippled(tau, q, ripple):
    """A motor's torque with torque ripple at position q."""
    return tau * (1.0 + ripple * math.sin(RIPPLES_PER_RADIAN * q))


@njit
def tip_torque(model, q, wrench, work, jacobian, torque):
    """J^T wrench, (n,): the joint torque of a wrench (6,) on the tip; `jacobian` is scratch (6, n)."""
    place(model, q, work)
    locate(model, work)
    tip_jacobian(model, work, jacobian)
    for i in range(torque.shape[0]):
        total = 0.0
        for k in range(6):
            total += jacobian[k, i] * wrench[k]
        torque[i] = total


@njit
def _contacts_changed(table, events, count):
    """Whether the geoms that touch differ from those of the last event."""
    known = table[LAST_EVENT]
    if known < 0:
        return count > 0
    if events[known + 1] != count:
        return True
    if count == 0:
        return False
    first = numba.carray(integers(table[DATA] + table[CONTACT_ARRAY]), (1,))[0] + table[CONTACT_GEOMS]
    for k in range(count):
        pair = numba.carray(short_integers(first + k * table[CONTACT_STRIDE]), (2,))
        if pair[0] != events[known + 2 + 2 * k] or pair[1] != events[known + 3 + 2 * k]:
            return True
    return False


@njit_inlined
def _note_contacts(table, row):
    """Notes the geoms that touch, if they changed; False if there is no place for them."""
    count = numba.carray(short_integers(table[DATA] + table[CONTACT_COUNT]), (1,))[0]
    if count == 0 and table[LAST_EVENT] < 0:
        return True
    events = numba.carray(short_integers(table[EVENTS]), (table[EVENTS_SIZE],))
    if not _contacts_changed(table, events, count):
        return True
    used = table[EVENTS_USED]
    if used + 2 + 2 * count > table[EVENTS_SIZE]:
        return False
    events[used] = row
    events[used + 1] = count
    if count > 0:
        first = numba.carray(integers(table[DATA] + table[CONTACT_ARRAY]), (1,))[0] + table[CONTACT_GEOMS]
        for k in range(count):
            pair = numba.carray(short_integers(first + k * table[CONTACT_STRIDE]), (2,))
            events[used + 2 + 2 * k] = pair[0]
            events[used + 3 + 2 * k] = pair[1]
    table[LAST_EVENT] = used
    table[EVENTS_USED] = used + 2 + 2 * count
    return True


@njit_inlined
def _drive(table, row, indices, scales, q, tau, ctrl):
    """Sets the controls of the motors from the commanded torque: delay, ripple, gears; and the torques of pushes."""
    n = tau.shape[0]
    if table[COMMANDS] == 0:
        for i in range(n):
            ctrl[indices[2, i]] = tau[i] / scales[0, i]
        return
    length = table[DELAY] + 1
    commands = matrix(table[COMMANDS], length, n)
    given = table[COMMANDS_GIVEN]
    newest = given % length
    oldest = max(given - table[DELAY], 0) % length
    ripple = vector(table[RIPPLE], 1)[0]
    for i in range(n):
        commands[newest, i] = tau[i]
        ctrl[indices[2, i]] = rippled(commands[oldest, i], q[i], ripple) / scales[0, i]
    table[COMMANDS_GIVEN] = given + 1
    pushed = table[PUSHED_JOINTS]
    if pushed > 0:
        scratch = vector(table[SCRATCH], table[SCRATCH_SIZE])[SCRATCH_VECTORS * n :]
        torque = scratch[:pushed]
        jacobian = scratch[pushed : 7 * pushed].reshape((6, pushed))
        wrench = matrix(table[WRENCHES], table[LAST] - table[FIRST], 6)[row - table[FIRST]]
        model = vector(table[PUSHED_MODEL], table[PUSHED_MODEL_SIZE])
        tip_torque(model, q[:pushed], wrench, scratch[7 * pushed :], jacobian, torque)
        applied = vector(table[QFRC_APPLIED], table[NV])
        for i in range(pushed):
            applied[indices[1, i]] = torque[i]
        push = vector(table[PUSH], 6)
        for k in range(6):
            push[k] = wrench[k]


@njit_inlined
def step(skip_address, function, model, data):
    """One step of MuJoCo; without collision detection if there is a table for that, and nothing can touch."""
    if skip_address != 0:
        skip = numba.carray(integers(skip_address), (SKIP_SIZE,))
        flags = numba.carray(short_integers(skip[SKIP_FLAGS]), (1,))
        flags[0] = skip[SKIP_NORMAL] | NO_CONTACTS if _is_free(skip) else skip[SKIP_NORMAL]
    call_step(function, model, data)


@njit_inlined
def _is_free(skip):
    """Whether it is proved that nothing touches at the joint positions now."""
    joints = skip[SKIP_JOINTS]
    indices = numba.carray(integers(skip[SKIP_INDICES]), (2, joints))
    qpos = vector(skip[SKIP_QPOS], skip[SKIP_NQ])
    box = matrix(skip[SKIP_BOX], 2, joints)
    is_inside = True
    for j in range(joints):
        is_inside &= box[0, j] <= qpos[indices[0, j]] <= box[1, j]
    if not is_inside:
        if skip[SKIP_IS_NEW]:
            skip[SKIP_IS_NEW] = 0
            if skip[SKIP_LASTED] < MIN_BOX_STEPS:
                _pause(skip)
            else:
                skip[SKIP_PAUSE] = 0
        if skip[SKIP_WAIT] > 0:
            skip[SKIP_WAIT] -= 1
            return False
        if not _prove_box(skip, indices, qpos, box):
            _pause(skip)
            return False
    skip[SKIP_LASTED] += 1
    skip[SKIP_SKIPPED] += 1
    return True


@njit
def _pause(skip):
    """Proofs do not pay here: waits, each time longer."""
    skip[SKIP_PAUSE] = min(2 * skip[SKIP_PAUSE] + 2, MAX_PAUSE)
    skip[SKIP_WAIT] = skip[SKIP_PAUSE]


@njit
def _prove_box(skip, indices, qpos, box):
    """Proves a new box around the joint positions now; False if it is too small, and then the last one stays."""
    qvel = vector(skip[SKIP_QVEL], skip[SKIP_NV])
    joints = skip[SKIP_JOINTS]
    positions = vector(skip[SKIP_POSITIONS], joints)
    delta = vector(skip[SKIP_DELTA], joints)
    skip[SKIP_PROOFS] += 1
    for j in range(joints):
        positions[j] = qpos[indices[0, j]]
        delta[j] = BOX_TIME_S * abs(qvel[indices[1, j]]) + BOX_MARGIN
        if not abs(positions[j]) + delta[j] < np.inf:
            return False
    if call_with_table(skip[SKIP_PROOF], skip[SKIP_PROOF_TABLE]) == 0:
        return False
    for j in range(joints):
        box[0, j] = positions[j] - delta[j]
        box[1, j] = positions[j] + delta[j]
    skip[SKIP_IS_NEW] = 1
    skip[SKIP_LASTED] = 0
    return True


@njit_inlined
def _advance(table, indices, scales, q, v_row, scratch):
    """The steps of a tick: those of MuJoCo, or of a plant in free space."""
    if table[FREE_MODEL] == 0:
        for _ in range(table[SUBSTEPS]):
            step(table[SKIP], table[STEP_FUNCTION], table[MODEL], table[DATA])
        return
    n = table[N]
    v = scratch[V * n : (V + 1) * n]
    tau = scratch[TAU * n : (TAU + 1) * n]
    applied = scratch[APPLIED * n : (APPLIED + 1) * n]
    ctrl = vector(table[CTRL], table[NCTRL])
    forces = vector(table[QFRC_APPLIED], table[NV])
    for i in range(n):
        v[i] = v_row[i]
        applied[i] = forces[indices[1, i]]
        tau[i] = ctrl[indices[2, i]] * scales[0, i]
    model = vector(table[FREE_MODEL], table[FREE_MODEL_SIZE])
    bounds = matrix(table[FREE_BOUNDS], 2, n)
    work = vector(table[FREE_WORK], table[FREE_WORK_SIZE] - n)
    acceleration = vector(table[FREE_WORK] + 8 * len(work), n)
    is_known = table[KNOWN_DYNAMICS] != 0
    size = n * n + n
    dynamics = vector(table[KNOWN_DYNAMICS] if is_known else table[FREE_WORK] + 8 * (len(work) - size), size)
    inertia = dynamics[: n * n].reshape((n, n))
    for _ in range(table[SUBSTEPS]):
        if not is_known:
            bias_and_inertia(model, q, v, work)
        finish_step(model, bounds, tau, applied, dynamics[n * n :], inertia, acceleration, q, v)
    qpos = vector(table[QPOS], table[NQ])
    qvel = vector(table[QVEL], table[NV])
    actuator = vector(table[QFRC_ACTUATOR], table[NV])
    for i in range(n):
        qpos[indices[0, i]] = q[i]
        qvel[indices[1, i]] = v[i]
        actuator[indices[3, i]] = tau[i]


@njit_inlined
def _read_state(indices, qpos, qvel, q, v):
    """Positions and velocities (n,) of the joints; returns the norm of the velocities."""
    squared = 0.0
    for i in range(len(q)):
        q[i] = qpos[indices[0, i]]
        v[i] = qvel[indices[1, i]]
        squared += v[i] * v[i]
    return math.sqrt(squared)


@njit_inlined
def _read_reference(addresses, row, reference):
    """The reference of a tick, (5, n), from the addresses of its columns."""
    n = reference.shape[1]
    for k in range(5):
        column = vector(addresses[k] + 8 * n * row, n)
        for i in range(n):
            reference[k, i] = column[i]


@njit_inlined
def _copy_finite(values, copy):
    """Copies values; False if one is not finite."""
    is_finite = True
    for i in range(len(values)):
        copy[i] = values[i]
        is_finite &= abs(values[i]) < np.inf
    return is_finite


@njit
def run_ticks(table):
    """The ticks [FIRST, LAST) of a run; STATUS says why it ended."""
    n = table[N]
    ticks = table[TICKS]
    indices = numba.carray(integers(table[INDICES]), (4, n))
    scales = matrix(table[SCALES], 2, n)
    qpos = vector(table[QPOS], table[NQ])
    qvel = vector(table[QVEL], table[NV])
    ctrl = vector(table[CTRL], table[NCTRL])
    actuator = vector(table[QFRC_ACTUATOR], table[NV])
    parameters = vector(table[PARAMETERS], table[PARAMETERS_SIZE])
    memory = vector(table[MEMORY], table[MEMORY_SIZE])
    references = numba.carray(integers(table[REFERENCE]), (5,))
    qpos_rows = matrix(table[QPOS_ROWS], ticks, table[NQ])
    v_rows = matrix(table[V_ROWS], ticks, n)
    command_rows = matrix(table[COMMAND_ROWS], ticks, n)
    torque_rows = matrix(table[TORQUE_ROWS], ticks, n)
    scratch = vector(table[SCRATCH], table[SCRATCH_SIZE])
    q = scratch[Q * n : (Q + 1) * n]
    q_seen = scratch[Q_SEEN * n : (Q_SEEN + 1) * n]
    v_seen = scratch[V_SEEN * n : (V_SEEN + 1) * n]
    tau = scratch[TAU * n : (TAU + 1) * n]
    reference = scratch[REFERENCE_ROW * n : (REFERENCE_ROW + 5) * n].reshape((5, n))
    is_noisy = table[NOISE] != 0
    first = table[FIRST]
    noise = numba.carray(floats(table[NOISE]), (table[LAST] - first, 2, n))  # not read unless there is any
    table[STATUS] = COMPLETE
    for row in range(first, table[LAST]):
        table[ROW] = row
        for i in range(table[NQ]):
            qpos_rows[row, i] = qpos[i]
        speed = _read_state(indices, qpos, qvel, q, v_rows[row])
        for i in range(n):
            q_seen[i] = q[i] + noise[row - first, 0, i] if is_noisy else q[i]
            v_seen[i] = v_rows[row, i] + noise[row - first, 1, i] if is_noisy else v_rows[row, i]
        if not speed < MAX_SPEED:
            table[STATUS] = DIVERGED
            return
        _read_reference(references, row, reference)
        if table[SENSE_TABLE] != 0:
            for i in range(n):
                tau[i] = actuator[indices[3, i]] * scales[1, i]
            call_with_table(table[SENSE], table[SENSE_TABLE])
        if call_kernel(table[KERNEL], parameters, q_seen, v_seen, reference, memory, tau):
            table[STATUS] = KERNEL_FAILED
            return
        if not _copy_finite(tau, command_rows[row]):
            table[STATUS] = NOT_FINITE
            return
        _drive(table, row, indices, scales, q, tau, ctrl)
        _advance(table, indices, scales, q, v_rows[row], scratch)
        for i in range(n):
            torque_rows[row, i] = actuator[indices[3, i]] * scales[1, i]
        table[COUNT] = row + 1
        if table[FREE_MODEL] == 0 and not _note_contacts(table, row):
            table[STATUS] = EVENTS_FULL
            return


@c_function(types.void(types.intp, types.intp, types.int32, types.intp), borrows=True)
def run_table(model, data, simulation, table):
    """A function for `mjb_apply`: runs the table at an address."""
    run_ticks(numba.carray(integers(table), (TABLE_SIZE,)))
