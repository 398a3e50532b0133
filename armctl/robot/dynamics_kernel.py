"""Compiled equations of motion of an arm: what `Dynamics` computes with Pinocchio, as scalar loops that a kernel can call.

The model is one vector, made by `PackedDynamics`: numba passes it at no cost, and a batch of models is a matrix. The recursions
are those of Featherstone, Rigid Body Dynamics Algorithms (2008): recursive Newton-Euler (5.3) and composite rigid bodies (6.2),
in the frames of the joints. Every joint turns about, or slides along, its own z axis.

All recursions are in one file (hence its length): they share the layout of the scratch memory.
"""

from __future__ import annotations

import math

from armctl.core.jit import njit, njit_inlined

# The model begins with a header. Then follow a row for each of the m joints, a row for each of the arm's n, and the (m, n)
# ratios of the joint map.
JOINTS = 0  # m
CHAIN_LENGTH = 1  # k, the joints from the base to the tip
IS_PLAIN = 2  # no joint follows another
HAS_LIFT = 3  # gravity compensation lifts something
HAS_SPRINGS = 4
STEP = 5  # s, of implicit forces; 0 for continuous time
HALF_STEP = 6  # s, from the start of the control period to the instant at which a continuous model is evaluated
IMPLICIT_NONLINEAR = 7  # forces other than linear damping are implicit in velocity
IMPLICIT_CORIOLIS = 8
IMPLICIT_IN_VELOCITY = 9  # any force is
HAS_FRICTION = 10
GRAVITY = 11  # (3,) m/s^2
TIP = 14  # rotation (9,) and translation (3,) of the tip in the last joint's frame
HEADER = 26

# Columns of a joint's row.
PLACEMENT = 0  # rotation (9,) and translation (3,) in its parent's frame, at position zero
IS_SLIDE = 12
PARENT = 13  # -1 for the base
MASS = 14
CENTER = 15  # (3,) of mass
INERTIA = 18  # xx yy zz xy xz yz about the center
LIFTED_MASS = 24
LIFTED_MOMENT = 25  # (3,) first moment of what gravity compensation lifts
STIFFNESS = 28  # (3,) of the spring: linear, quadratic, cubic
SPRING_REST = 31
OFFSET = 32  # of the joint map
JOINT_COLUMNS = 33

# Columns of the row of one of the arm's n.
ARMATURE = 0
DAMPING = 1  # (3,) linear, quadratic, cubic
IMPLICIT_DAMPING = 4
FRICTION_LOSS = 5
FRICTION_GAIN = 6
FRICTION_RATE = 7
DRIVE_COLUMNS = 8

# Columns of the scratch memory, one row per joint; behind the rows (n, n) for a mass matrix and (n,) for a vector.
ROTATION = 0  # (9,) in the parent's frame
TRANSLATION = 9  # (3,)
POSITION = 12
VELOCITY = 13
ACCELERATION = 14
OMEGA = 15  # (3,)
ALPHA = 18  # (3,)
LINEAR = 21  # (3,) acceleration of the origin minus gravity
FALL = 24  # (3,) gravity
FORCE = 27  # (3,)
MOMENT = 30  # (3,)
TORQUE = 33
COMPOSITE = 15  # mass, first moment (3,), inertia about the origin (6,); overwrites what Newton-Euler leaves
WORLD = 34  # rotation (9,) and origin (3,) in the world
WORK_COLUMNS = 46


@njit
def work_size(model, n):
    """Numbers of scratch memory for a model of n joints."""
    return int(model[JOINTS]) * WORK_COLUMNS + n * n + n


@njit
def model_size(model, n):
    """Numbers of a model of n joints."""
    return _drive(model, n) + int(model[JOINTS]) * n


@njit_inlined
def _drive(model, i):
    """Where the row of joint i of the arm begins."""
    return HEADER + int(model[JOINTS]) * JOINT_COLUMNS + i * DRIVE_COLUMNS


@njit
def _ratio(model, n, joint, i):
    """How far a joint moves per movement of joint i of the arm."""
    return model[_drive(model, n) + joint * n + i]


@njit_inlined
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit_inlined
def _to_joint(work, row, x, y, z):
    """A vector of the parent's frame in the joint's frame."""
    return (
        work[row] * x + work[row + 3] * y + work[row + 6] * z,
        work[row + 1] * x + work[row + 4] * y + work[row + 7] * z,
        work[row + 2] * x + work[row + 5] * y + work[row + 8] * z,
    )


@njit_inlined
def _to_parent(work, row, x, y, z):
    """A vector of the joint's frame in the parent's frame; also a vector of a frame in the world, with row at its rotation."""
    return (
        work[row] * x + work[row + 1] * y + work[row + 2] * z,
        work[row + 3] * x + work[row + 4] * y + work[row + 5] * z,
        work[row + 6] * x + work[row + 7] * y + work[row + 8] * z,
    )


@njit_inlined
def _inertia_times(array, start, x, y, z):
    """A symmetric matrix xx yy zz xy xz yz times a vector."""
    return (
        array[start] * x + array[start + 3] * y + array[start + 4] * z,
        array[start + 3] * x + array[start + 1] * y + array[start + 5] * z,
        array[start + 4] * x + array[start + 5] * y + array[start + 2] * z,
    )


@njit_inlined
def _store(array, start, x, y, z):
    array[start] = x
    array[start + 1] = y
    array[start + 2] = z


@njit_inlined
def _add(array, start, x, y, z):
    array[start] += x
    array[start + 1] += y
    array[start + 2] += z


@njit
def _spread(model, x, work, column):
    """Velocities or accelerations of the arm's n as those of all joints."""
    n = x.shape[0]
    plain = model[IS_PLAIN] != 0.0
    for j in range(int(model[JOINTS])):
        if plain:
            work[j * WORK_COLUMNS + column] = x[j]
        else:
            total = 0.0
            for i in range(n):
                total += _ratio(model, n, j, i) * x[i]
            work[j * WORK_COLUMNS + column] = total


@njit
def _gather(model, work, tau):
    """Torques of all joints as those of the arm's n, by virtual work."""
    n = tau.shape[0]
    plain = model[IS_PLAIN] != 0.0
    for i in range(n):
        if plain:
            tau[i] = work[i * WORK_COLUMNS + TORQUE]
        else:
            total = 0.0
            for j in range(int(model[JOINTS])):
                total += _ratio(model, n, j, i) * work[j * WORK_COLUMNS + TORQUE]
            tau[i] = total


@njit
def place(model, q, work):
    """Sets the joints at q: each joint's frame in its parent's frame."""
    _spread(model, q, work, POSITION)
    for j in range(int(model[JOINTS])):
        row = j * WORK_COLUMNS
        joint = HEADER + j * JOINT_COLUMNS
        position = work[row + POSITION]
        if model[IS_PLAIN] == 0.0:
            position += model[joint + OFFSET]
            work[row + POSITION] = position
        if model[joint + IS_SLIDE] != 0.0:
            for k in range(9):
                work[row + k] = model[joint + k]
            for k in range(3):
                work[row + TRANSLATION + k] = model[joint + 9 + k] + position * model[joint + 3 * k + 2]
        else:
            cos = math.cos(position)
            sin = math.sin(position)
            for k in range(3):
                x = model[joint + 3 * k]
                y = model[joint + 3 * k + 1]
                work[row + 3 * k] = cos * x + sin * y
                work[row + 3 * k + 1] = cos * y - sin * x
                work[row + 3 * k + 2] = model[joint + 3 * k + 2]
                work[row + TRANSLATION + k] = model[joint + 9 + k]


@njit
def _newton_euler(model, work):
    """Torques of all joints at the positions, velocities and accelerations in the scratch memory, without armature."""
    m = int(model[JOINTS])
    for j in range(m):
        _move_link(model, j, work)
        if model[HAS_LIFT] != 0.0:
            _turn_gravity(model, j, work)
        _load_link(model, j, work)
    for j in range(m - 1, -1, -1):
        row = j * WORK_COLUMNS
        joint = HEADER + j * JOINT_COLUMNS
        fx = work[row + FORCE]
        fy = work[row + FORCE + 1]
        fz = work[row + FORCE + 2]
        work[row + TORQUE] = fz if model[joint + IS_SLIDE] != 0.0 else work[row + MOMENT + 2]
        parent = int(model[joint + PARENT])
        if parent >= 0:
            above = parent * WORK_COLUMNS
            fx, fy, fz = _to_parent(work, row, fx, fy, fz)
            mx, my, mz = _to_parent(work, row, work[row + MOMENT], work[row + MOMENT + 1], work[row + MOMENT + 2])
            at = row + TRANSLATION
            tx, ty, tz = _cross(work[at], work[at + 1], work[at + 2], fx, fy, fz)
            _add(work, above + FORCE, fx, fy, fz)
            _add(work, above + MOMENT, mx + tx, my + ty, mz + tz)


@njit_inlined
def _move_link(model, j, work):
    """Velocity and acceleration of a link from those of its parent."""
    row = j * WORK_COLUMNS
    joint = HEADER + j * JOINT_COLUMNS
    parent = int(model[joint + PARENT])
    v = work[row + VELOCITY]
    a = work[row + ACCELERATION]
    wx = 0.0
    wy = 0.0
    dx = 0.0
    dy = 0.0
    wz = 0.0
    dz = 0.0
    if parent >= 0:
        above = parent * WORK_COLUMNS
        at = row + TRANSLATION
        tx = work[at]
        ty = work[at + 1]
        tz = work[at + 2]
        wx = work[above + OMEGA]
        wy = work[above + OMEGA + 1]
        wz = work[above + OMEGA + 2]
        dx = work[above + ALPHA]
        dy = work[above + ALPHA + 1]
        dz = work[above + ALPHA + 2]
        cx, cy, cz = _cross(wx, wy, wz, tx, ty, tz)
        cx, cy, cz = _cross(wx, wy, wz, cx, cy, cz)
        ex, ey, ez = _cross(dx, dy, dz, tx, ty, tz)
        ax, ay, az = _to_joint(
            work, row, work[above + LINEAR] + cx + ex, work[above + LINEAR + 1] + cy + ey, work[above + LINEAR + 2] + cz + ez
        )
        wx, wy, wz = _to_joint(work, row, wx, wy, wz)
        dx, dy, dz = _to_joint(work, row, dx, dy, dz)
    else:
        ax, ay, az = _to_joint(work, row, -model[GRAVITY], -model[GRAVITY + 1], -model[GRAVITY + 2])
    if model[joint + IS_SLIDE] != 0.0:
        ax += 2.0 * wy * v
        ay -= 2.0 * wx * v
        az += a
    else:
        dx += wy * v
        dy -= wx * v
        dz += a
        wz += v
    _store(work, row + OMEGA, wx, wy, wz)
    _store(work, row + ALPHA, dx, dy, dz)
    _store(work, row + LINEAR, ax, ay, az)


@njit
def _turn_gravity(model, j, work):
    """Gravity in the frame of a joint."""
    row = j * WORK_COLUMNS
    parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
    if parent >= 0:
        start = parent * WORK_COLUMNS + FALL
        x, y, z = _to_joint(work, row, work[start], work[start + 1], work[start + 2])
    else:
        x, y, z = _to_joint(work, row, model[GRAVITY], model[GRAVITY + 1], model[GRAVITY + 2])
    _store(work, row + FALL, x, y, z)


@njit_inlined
def _load_link(model, j, work):
    """Force and moment about the joint's origin that give a link its acceleration."""
    row = j * WORK_COLUMNS
    joint = HEADER + j * JOINT_COLUMNS
    mass = model[joint + MASS]
    x = model[joint + CENTER]
    y = model[joint + CENTER + 1]
    z = model[joint + CENTER + 2]
    wx = work[row + OMEGA]
    wy = work[row + OMEGA + 1]
    wz = work[row + OMEGA + 2]
    dx = work[row + ALPHA]
    dy = work[row + ALPHA + 1]
    dz = work[row + ALPHA + 2]
    cx, cy, cz = _cross(wx, wy, wz, x, y, z)
    cx, cy, cz = _cross(wx, wy, wz, cx, cy, cz)
    ex, ey, ez = _cross(dx, dy, dz, x, y, z)
    fx = mass * (work[row + LINEAR] + cx + ex)
    fy = mass * (work[row + LINEAR + 1] + cy + ey)
    fz = mass * (work[row + LINEAR + 2] + cz + ez)
    hx, hy, hz = _inertia_times(model, joint + INERTIA, wx, wy, wz)
    gx, gy, gz = _cross(wx, wy, wz, hx, hy, hz)
    ix, iy, iz = _inertia_times(model, joint + INERTIA, dx, dy, dz)
    mx, my, mz = _cross(x, y, z, fx, fy, fz)
    _store(work, row + FORCE, fx, fy, fz)
    _store(work, row + MOMENT, ix + gx + mx, iy + gy + my, iz + gz + mz)
    if model[HAS_LIFT] != 0.0:
        gx = work[row + FALL]
        gy = work[row + FALL + 1]
        gz = work[row + FALL + 2]
        lifted = model[joint + LIFTED_MASS]
        at = joint + LIFTED_MOMENT
        mx, my, mz = _cross(model[at], model[at + 1], model[at + 2], gx, gy, gz)
        _add(work, row + FORCE, lifted * gx, lifted * gy, lifted * gz)
        _add(work, row + MOMENT, mx, my, mz)


@njit
def _add_springs(model, work):
    """Adds the torques of the springs."""
    for j in range(int(model[JOINTS])):
        row = j * WORK_COLUMNS
        spring = HEADER + j * JOINT_COLUMNS + STIFFNESS
        x = work[row + POSITION] - model[HEADER + j * JOINT_COLUMNS + SPRING_REST]
        work[row + TORQUE] += x * (model[spring] + x * model[spring + 1] + x * x * model[spring + 2])


@njit
def gravity(model, q, work, tau):
    """The torque that holds the arm at rest, (n,) N m, as `Dynamics.gravity`: with gravity compensation and springs."""
    place(model, q, work)
    for j in range(int(model[JOINTS])):
        work[j * WORK_COLUMNS + VELOCITY] = 0.0
        work[j * WORK_COLUMNS + ACCELERATION] = 0.0
    _newton_euler(model, work)
    if model[HAS_SPRINGS] != 0.0:
        _add_springs(model, work)
    _gather(model, work, tau)


@njit
def inverse_dynamics(model, q, v, a, work, tau):
    """The torque that changes the velocity by a dt over the coming control period, (n,) N m, without dry friction.

    As `Dynamics.discrete_inverse_dynamics`, or `Dynamics.inverse_midpoint` where the arm moves continuously.
    """
    n = q.shape[0]
    half = model[HALF_STEP]
    if half != 0.0:
        middle = work[work.shape[0] - n :]
        for i in range(n):
            middle[i] = q[i] + half * v[i]
        place(model, middle, work)
        for i in range(n):
            middle[i] = v[i] + half * a[i]
        _smooth_torque(model, middle, a, work, tau)
        return
    place(model, q, work)
    _smooth_torque(model, v, a, work, tau)
    if model[STEP] != 0.0:
        for i in range(n):
            tau[i] += model[STEP] * model[_drive(model, i) + IMPLICIT_DAMPING] * a[i]
        if model[IMPLICIT_NONLINEAR] != 0.0:
            change = work[work.shape[0] - n :]
            _implicit_change(model, v, a, work, change)
            for i in range(n):
                tau[i] += model[STEP] * change[i]


@njit
def _smooth_torque(model, v, a, work, tau):
    """The torque in continuous time, at the placed positions."""
    _spread(model, v, work, VELOCITY)
    _spread(model, a, work, ACCELERATION)
    _newton_euler(model, work)
    if model[HAS_SPRINGS] != 0.0:
        _add_springs(model, work)
    _gather(model, work, tau)
    for i in range(v.shape[0]):
        drive = _drive(model, i)
        speed = abs(v[i])
        damping = model[drive + DAMPING] + speed * (model[drive + DAMPING + 1] + speed * model[drive + DAMPING + 2])
        tau[i] += model[drive + ARMATURE] * a[i] + damping * v[i]


@njit
def add_linear_damping(model, v, tau):
    """Adds the torque of the linear damping of the arm's joints at the velocities v, (n,) N m."""
    for i in range(v.shape[0]):
        tau[i] += model[_drive(model, i) + DAMPING] * v[i]


@njit
def coriolis_product(model, v, w, work, scratch, tau):
    """C(q, v) w (n,) at the placed positions, as `Dynamics.coriolis_product`; scratch is (n,)."""
    n = v.shape[0]
    for j in range(int(model[JOINTS])):
        work[j * WORK_COLUMNS + ACCELERATION] = 0.0
    for i in range(n):
        scratch[i] = v[i] + w[i]
    _spread(model, scratch, work, VELOCITY)
    _newton_euler(model, work)
    _gather(model, work, tau)
    for i in range(n):
        scratch[i] = v[i] - w[i]
    _spread(model, scratch, work, VELOCITY)
    _newton_euler(model, work)
    _gather(model, work, scratch)
    for i in range(n):
        tau[i] = 0.25 * (tau[i] - scratch[i])


@njit
def _implicit_change(model, v, a, work, change):
    """Rate at which implicit forces other than linear damping change during a step, d(force)/dv a, at the placed positions.

    The Coriolis torque is C(q, v) v, and C(q, v) a is symmetric in v and a, so its derivative along a is 2 C(q, v) a.
    """
    n = v.shape[0]
    if model[IMPLICIT_CORIOLIS] != 0.0:
        start = work.shape[0] - n * n - n
        coriolis_product(model, v, a, work, work[start : start + n], change)
        for i in range(n):
            change[i] *= 2.0
    else:
        for i in range(n):
            change[i] = 0.0
    for i in range(n):
        damping = _drive(model, i) + DAMPING
        change[i] += (2.0 * model[damping + 1] * abs(v[i]) + 3.0 * model[damping + 2] * v[i] * v[i]) * a[i]


@njit
def add_friction(model, v_ref, a_ref, work, tau):
    """Adds the torque against dry friction on the reference motion, at the positions that `inverse_dynamics` was called with.

    As `feedforward.friction`: in a discrete step, the friction constraint acts on the acceleration before implicit forces.
    """
    if model[HAS_FRICTION] == 0.0:
        return
    n = tau.shape[0]
    half = model[HALF_STEP]
    before = work[work.shape[0] - n :]
    for i in range(n):
        before[i] = 0.0
    if half == 0.0 and model[STEP] != 0.0 and model[IMPLICIT_IN_VELOCITY] != 0.0:
        if model[IMPLICIT_NONLINEAR] != 0.0:
            _implicit_change(model, v_ref, a_ref, work, before)
        for i in range(n):
            before[i] = model[STEP] * (model[_drive(model, i) + IMPLICIT_DAMPING] * a_ref[i] + before[i])
        M = work[work.shape[0] - n - n * n : work.shape[0] - n].reshape((n, n))
        mass_matrix(model, work, M)
        factorize(M)
        solve(M, before)
    for i in range(n):
        drive = _drive(model, i)
        loss = model[drive + FRICTION_LOSS]
        speed = v_ref[i] + half * a_ref[i]
        force = model[drive + FRICTION_GAIN] * (a_ref[i] + before[i] + model[drive + FRICTION_RATE] * speed)
        tau[i] += min(max(force, -loss), loss)


@njit
def mass_matrix(model, work, M):
    """The (n, n) mass matrix with armature, kg m^2, at the placed positions; overwrites velocities and forces of the links."""
    n = M.shape[0]
    m = int(model[JOINTS])
    for i in range(n):
        for k in range(n):
            M[i, k] = 0.0
        M[i, i] = model[_drive(model, i) + ARMATURE]
    for j in range(m):
        _own_inertia(model, j, work)
    for j in range(m - 1, -1, -1):
        _add_inertia_row(model, j, work, M)
        parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
        if parent >= 0:
            _carry_inertia(j, parent, work)


@njit
def add_implicit_damping(model, M):
    """Adds damping x step to the diagonal of a mass matrix: the inertia that a step with implicit damping acts against."""
    for i in range(M.shape[0]):
        M[i, i] += model[STEP] * model[_drive(model, i) + IMPLICIT_DAMPING]


@njit_inlined
def _own_inertia(model, j, work):
    """Mass, first moment and inertia about its joint's origin of a link alone."""
    joint = HEADER + j * JOINT_COLUMNS
    inertia = j * WORK_COLUMNS + COMPOSITE
    mass = model[joint + MASS]
    x = model[joint + CENTER]
    y = model[joint + CENTER + 1]
    z = model[joint + CENTER + 2]
    work[inertia] = mass
    _store(work, inertia + 1, mass * x, mass * y, mass * z)
    start = joint + INERTIA
    _store(
        work,
        inertia + 4,
        model[start] + mass * (y * y + z * z),
        model[start + 1] + mass * (x * x + z * z),
        model[start + 2] + mass * (x * x + y * y),
    )
    _store(work, inertia + 7, model[start + 3] - mass * x * y, model[start + 4] - mass * x * z, model[start + 5] - mass * y * z)


@njit
def _add_inertia_row(model, j, work, M):
    """Adds to M the torques, on all joints above, of a unit acceleration of joint j."""
    is_plain = model[IS_PLAIN] != 0.0
    inertia = j * WORK_COLUMNS + COMPOSITE
    fx = 0.0
    fy = 0.0
    fz = 0.0
    mx = 0.0
    my = 0.0
    mz = 0.0
    if model[HEADER + j * JOINT_COLUMNS + IS_SLIDE] != 0.0:
        fz = work[inertia]
        mx = work[inertia + 2]
        my = -work[inertia + 1]
    else:
        fx = -work[inertia + 2]
        fy = work[inertia + 1]
        mx = work[inertia + 8]
        my = work[inertia + 9]
        mz = work[inertia + 6]
    other = j
    while other >= 0:
        joint = HEADER + other * JOINT_COLUMNS
        coupling = fz if model[joint + IS_SLIDE] != 0.0 else mz
        if not is_plain:
            _add_coupling(model, j, other, coupling, M)
        elif other == j:
            M[j, j] += coupling
        else:
            M[j, other] = coupling
            M[other, j] = coupling
        row = other * WORK_COLUMNS
        fx, fy, fz = _to_parent(work, row, fx, fy, fz)
        mx, my, mz = _to_parent(work, row, mx, my, mz)
        at = row + TRANSLATION
        tx, ty, tz = _cross(work[at], work[at + 1], work[at + 2], fx, fy, fz)
        mx += tx
        my += ty
        mz += tz
        other = int(model[joint + PARENT])


@njit
def _add_coupling(model, j, other, inertia, M):
    """Adds the coupling inertia of two joints to the mass matrix of the arm's n, some of which move several joints."""
    n = M.shape[0]
    for i in range(n):
        for k in range(n):
            M[i, k] += _ratio(model, n, j, i) * _ratio(model, n, other, k) * inertia
            if other != j:
                M[i, k] += _ratio(model, n, other, i) * _ratio(model, n, j, k) * inertia


@njit_inlined
def _carry_inertia(j, parent, work):
    """Adds the composite inertia of a link to its parent's."""
    row = j * WORK_COLUMNS
    inertia = row + COMPOSITE
    above = parent * WORK_COLUMNS + COMPOSITE
    mass = work[inertia]
    at = row + TRANSLATION
    x = work[at]
    y = work[at + 1]
    z = work[at + 2]
    hx, hy, hz = _to_parent(work, row, work[inertia + 1], work[inertia + 2], work[inertia + 3])
    # R I R^T, column by column of R^T, which are the rows of R.
    ax, ay, az = _inertia_times(work, inertia + 4, work[row], work[row + 1], work[row + 2])
    xx, xy, xz = _to_parent(work, row, ax, ay, az)
    bx, by, bz = _inertia_times(work, inertia + 4, work[row + 3], work[row + 4], work[row + 5])
    _, yy, yz = _to_parent(work, row, bx, by, bz)
    cx, cy, cz = _inertia_times(work, inertia + 4, work[row + 6], work[row + 7], work[row + 8])
    _, _, zz = _to_parent(work, row, cx, cy, cz)
    # About the parent's origin: I + 2 (h . t) 1 - h t^T - t h^T + mass (t . t 1 - t t^T).
    spread = 2.0 * (hx * x + hy * y + hz * z) + mass * (x * x + y * y + z * z)
    work[above] += mass
    _add(work, above + 1, hx + mass * x, hy + mass * y, hz + mass * z)
    _add(
        work,
        above + 4,
        xx + spread - 2.0 * hx * x - mass * x * x,
        yy + spread - 2.0 * hy * y - mass * y * y,
        zz + spread - 2.0 * hz * z - mass * z * z,
    )
    _add(
        work,
        above + 7,
        xy - hx * y - hy * x - mass * x * y,
        xz - hx * z - hz * x - mass * x * z,
        yz - hy * z - hz * y - mass * y * z,
    )


@njit
def factorize(M):
    """Factorizes a positive definite matrix, of which the lower triangle counts, as L D L^T.

    The lower triangle becomes that of L, whose diagonal is 1, the diagonal the inverse of D, and the upper triangle D L^T.
    There is one division per row, and no root.
    """
    n = M.shape[0]
    for i in range(n):
        pivot = M[i, i]
        for j in range(i):
            rest = M[i, j]
            for k in range(j):
                rest -= M[k, i] * M[j, k]
            M[j, i] = rest
            M[i, j] = rest * M[j, j]
            pivot -= rest * M[i, j]
        M[i, i] = 1.0 / pivot


@njit
def take_roots(factors):
    """Replaces the lower triangle of what `factorize` leaves by the Cholesky factor L D^1/2; `solve` cannot use it."""
    n = factors.shape[0]
    for j in range(n):
        root = 1.0 / math.sqrt(factors[j, j])
        factors[j, j] = root
        for i in range(j + 1, n):
            factors[i, j] *= root


@njit
def solve(factors, x):
    """Replaces x by the solution of M solution = x, with M as `factorize` leaves it."""
    n = x.shape[0]
    for i in range(1, n):
        rest = x[i]
        for k in range(i):
            rest -= factors[i, k] * x[k]
        x[i] = rest
    for i in range(n):
        x[i] *= factors[i, i]
    for i in range(n - 2, -1, -1):
        rest = x[i]
        for k in range(i + 1, n):
            rest -= factors[k, i] * x[k]
        x[i] = rest


@njit
def multiply(factors, x, product):
    """product = M x, (n,) each, with M as `factorize` leaves it."""
    n = x.shape[0]
    for i in range(n):
        total = x[i] / factors[i, i]
        for k in range(i + 1, n):
            total += factors[i, k] * x[k]
        product[i] = total
    for i in range(n - 1, 0, -1):
        total = product[i]
        for k in range(i):
            total += factors[i, k] * product[k]
        product[i] = total


@njit
def locate(model, work):
    """The frames of all joints in the world, at the placed positions."""
    for j in range(int(model[JOINTS])):
        row = j * WORK_COLUMNS
        world = row + WORLD
        at = row + TRANSLATION
        parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
        if parent < 0:
            for k in range(12):
                work[world + k] = work[row + k]
            continue
        above = parent * WORK_COLUMNS + WORLD
        for k in range(3):
            x, y, z = _to_parent(work, above, work[row + k], work[row + 3 + k], work[row + 6 + k])
            work[world + k] = x
            work[world + 3 + k] = y
            work[world + 6 + k] = z
        x, y, z = _to_parent(work, above, work[at], work[at + 1], work[at + 2])
        _store(work, world + 9, work[above + 9] + x, work[above + 10] + y, work[above + 11] + z)


@njit
def tip_position(model, work):
    """The tip in the world, m, at the located joints."""
    world = (int(model[CHAIN_LENGTH]) - 1) * WORK_COLUMNS + WORLD
    x, y, z = _to_parent(work, world, model[TIP + 9], model[TIP + 10], model[TIP + 11])
    return work[world + 9] + x, work[world + 10] + y, work[world + 11] + z


@njit
def tip_rotation(model, work, rotation):
    """The (9,) rotation matrix of the tip in the world, at the located joints."""
    world = (int(model[CHAIN_LENGTH]) - 1) * WORK_COLUMNS + WORLD
    for k in range(3):
        x, y, z = _to_parent(work, world, model[TIP + k], model[TIP + 3 + k], model[TIP + 6 + k])
        rotation[k] = x
        rotation[3 + k] = y
        rotation[6 + k] = z


@njit
def tip_jacobian(model, work, J):
    """The (6, n) Jacobian of the tip, linear first, world axes, at the located joints."""
    n = J.shape[1]
    px, py, pz = tip_position(model, work)
    for i in range(n):
        for k in range(6):
            J[k, i] = 0.0
    for j in range(int(model[CHAIN_LENGTH])):
        world = j * WORK_COLUMNS + WORLD
        zx = work[world + 2]
        zy = work[world + 5]
        zz = work[world + 8]
        turns = model[HEADER + j * JOINT_COLUMNS + IS_SLIDE] == 0.0
        lx = zx
        ly = zy
        lz = zz
        if turns:
            lx, ly, lz = _cross(zx, zy, zz, px - work[world + 9], py - work[world + 10], pz - work[world + 11])
        for i in range(n):
            ratio = (1.0 if i == j else 0.0) if model[IS_PLAIN] != 0.0 else _ratio(model, n, j, i)
            if ratio != 0.0:
                J[0, i] += ratio * lx
                J[1, i] += ratio * ly
                J[2, i] += ratio * lz
                if turns:
                    J[3, i] += ratio * zx
                    J[4, i] += ratio * zy
                    J[5, i] += ratio * zz


@njit
def quaternion(R, quat):
    """The unit quaternion wxyz, w >= 0, of a rotation (9,) by Shepperd's method: the largest component is found first."""
    trace = R[0] + R[4] + R[8]
    largest = 0
    value = trace
    for i in range(3):
        if R[4 * i] > value:
            largest = i + 1
            value = R[4 * i]
    if largest == 0:
        quat[0] = 1.0 + trace
        _store(quat, 1, R[7] - R[5], R[2] - R[6], R[3] - R[1])
    else:
        i = largest - 1
        j = (i + 1) % 3
        k = (i + 2) % 3
        quat[0] = R[3 * k + j] - R[3 * j + k]
        quat[1 + i] = 1.0 + R[4 * i] - R[4 * j] - R[4 * k]
        quat[1 + j] = R[3 * i + j] + R[3 * j + i]
        quat[1 + k] = R[3 * i + k] + R[3 * k + i]
    scale = 1.0 / math.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    if quat[0] < 0.0:
        scale = -scale
    for i in range(4):
        quat[i] *= scale


@njit
def tip_motion(model, q, v, a, work, motion):
    """Angular velocity, angular acceleration, and acceleration minus gravity of the tip, each (3,), in the tip's axes.

    Places and locates the joints, in the middle of the control period where the arm moves continuously.
    """
    n = q.shape[0]
    half = model[HALF_STEP]
    middle = work[work.shape[0] - n :]
    for i in range(n):
        middle[i] = q[i] + half * v[i]
    place(model, middle, work)
    for i in range(n):
        middle[i] = v[i] + half * a[i]
    _spread(model, middle, work, VELOCITY)
    _spread(model, a, work, ACCELERATION)
    links = int(model[CHAIN_LENGTH])
    for j in range(links):
        _move_link(model, j, work)
    locate(model, work)
    last = (links - 1) * WORK_COLUMNS
    wx = work[last + OMEGA]
    wy = work[last + OMEGA + 1]
    wz = work[last + OMEGA + 2]
    dx = work[last + ALPHA]
    dy = work[last + ALPHA + 1]
    dz = work[last + ALPHA + 2]
    x = model[TIP + 9]
    y = model[TIP + 10]
    z = model[TIP + 11]
    cx, cy, cz = _cross(wx, wy, wz, x, y, z)
    cx, cy, cz = _cross(wx, wy, wz, cx, cy, cz)
    ex, ey, ez = _cross(dx, dy, dz, x, y, z)
    ax = work[last + LINEAR] + cx + ex
    ay = work[last + LINEAR + 1] + cy + ey
    az = work[last + LINEAR + 2] + cz + ez
    for k in range(3):
        px = model[TIP + k]
        py = model[TIP + 3 + k]
        pz = model[TIP + 6 + k]
        motion[k] = px * wx + py * wy + pz * wz
        motion[3 + k] = px * dx + py * dy + pz * dz
        motion[6 + k] = px * ax + py * ay + pz * az


@njit
def add_step_inertia(model, M):
    """Adds to a mass matrix what linear damping, implicit in velocity, adds to the inertia in one step."""
    for i in range(M.shape[0]):
        M[i, i] += model[STEP] * model[_drive(model, i) + IMPLICIT_DAMPING]
