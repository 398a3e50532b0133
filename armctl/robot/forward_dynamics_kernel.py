"""Compiled forward dynamics of an arm that touches nothing, in world axes and about one point o, the origin of the first joint.

Forces and inertias of links then add up as they are, which is less work than in the frames of the links. The recursions are
those of `dynamics_kernel`, whose models and scratch memory they use; the algebra is that of Featherstone, Rigid Body Dynamics
Algorithms (2008), 2.10.
"""

from __future__ import annotations

import math

from armctl.core.jit import njit, njit_inlined
from armctl.robot.dynamics_kernel import (
    ARMATURE,
    CENTER,
    DAMPING,
    GRAVITY,
    HALF_STEP,
    HAS_FRICTION,
    HAS_LIFT,
    HAS_SPRINGS,
    HEADER,
    IMPLICIT_NONLINEAR,
    INERTIA,
    IS_PLAIN,
    IS_SLIDE,
    JOINT_COLUMNS,
    LIFTED_MASS,
    LIFTED_MOMENT,
    MASS,
    PLACEMENT,
    STEP,
    WORK_COLUMNS,
    WORLD,
    _add,
    _cross,
    _drive,
    _inertia_times,
    _store,
    _to_parent,
    add_implicit_damping,
    factorize,
    solve,
)

# Columns of the scratch memory, one row per joint, in place of those of `dynamics_kernel`. Twists and wrenches have (6,), the
# angular velocity or the force first.
VELOCITY = 0
ACCELERATION = 6
FORCE = 12
INERTIA_AT_O = 18  # mass, first moment (3,), second moment xx yy zz xy xz yz
AXIS = 28


@njit_inlined
def _locate_link(model, j, q, work):
    """The frame of a joint in the world at position q of it, from that of its parent."""
    row = j * WORK_COLUMNS + WORLD
    joint = HEADER + j * JOINT_COLUMNS
    at = joint + PLACEMENT
    x = model[at + 9]
    y = model[at + 10]
    z = model[at + 11]
    if j == 0:
        for k in range(9):
            work[row + k] = model[at + k]
        _store(work, row + 9, x, y, z)
    else:
        above = row - WORK_COLUMNS
        for k in range(3):
            a, b, c = _to_parent(work, above, model[at + k], model[at + 3 + k], model[at + 6 + k])
            work[row + k] = a
            work[row + 3 + k] = b
            work[row + 6 + k] = c
        x, y, z = _to_parent(work, above, x, y, z)
        _store(work, row + 9, work[above + 9] + x, work[above + 10] + y, work[above + 11] + z)
    if model[joint + IS_SLIDE] != 0.0:
        for k in range(3):
            work[row + 9 + k] += q * work[row + 3 * k + 2]
        return
    cos = math.cos(q)
    sin = math.sin(q)
    for k in range(3):
        x = work[row + 3 * k]
        y = work[row + 3 * k + 1]
        work[row + 3 * k] = cos * x + sin * y
        work[row + 3 * k + 1] = cos * y - sin * x


@njit_inlined
def _find_inertia(model, j, o, work):
    """Mass, first moment and second moment of a link about o."""
    joint = HEADER + j * JOINT_COLUMNS
    row = j * WORK_COLUMNS + WORLD
    inertia = j * WORK_COLUMNS + INERTIA_AT_O
    mass = model[joint + MASS]
    x, y, z = _to_parent(work, row, model[joint + CENTER], model[joint + CENTER + 1], model[joint + CENTER + 2])
    x += work[row + 9] - o[0]
    y += work[row + 10] - o[1]
    z += work[row + 11] - o[2]
    # R I R^T, column by column of R^T, which are the rows of R.
    at = joint + INERTIA
    half = 0.5 * (model[at] + model[at + 1] + model[at + 2])  # of the trace: the second moment is half 1 - I
    a, b, c = _inertia_times(model, at, work[row], work[row + 1], work[row + 2])
    xx, xy, xz = _to_parent(work, row, a, b, c)
    a, b, c = _inertia_times(model, at, work[row + 3], work[row + 4], work[row + 5])
    yy = work[row + 3] * a + work[row + 4] * b + work[row + 5] * c
    yz = work[row + 6] * a + work[row + 7] * b + work[row + 8] * c
    a, b, c = _inertia_times(model, at, work[row + 6], work[row + 7], work[row + 8])
    zz = work[row + 6] * a + work[row + 7] * b + work[row + 8] * c
    hx = mass * x
    hy = mass * y
    hz = mass * z
    work[inertia] = mass
    _store(work, inertia + 1, hx, hy, hz)
    _store(work, inertia + 4, half - xx + hx * x, half - yy + hy * y, half - zz + hz * z)
    _store(work, inertia + 7, hx * y - xy, hx * z - xz, hy * z - yz)


@njit_inlined
def _momentum(inertia, work, wx, wy, wz, vx, vy, vz):
    """Linear momentum, and angular momentum about o, of a body with angular velocity w whose point at o has velocity v."""
    mass = work[inertia]
    hx = work[inertia + 1]
    hy = work[inertia + 2]
    hz = work[inertia + 3]
    trace = work[inertia + 4] + work[inertia + 5] + work[inertia + 6]
    px, py, pz = _cross(wx, wy, wz, hx, hy, hz)
    lx, ly, lz = _inertia_times(work, inertia + 4, wx, wy, wz)
    cx, cy, cz = _cross(hx, hy, hz, vx, vy, vz)
    return (
        px + mass * vx,
        py + mass * vy,
        pz + mass * vz,
        trace * wx - lx + cx,
        trace * wy - ly + cy,
        trace * wz - lz + cz,
    )


@njit_inlined
def _find_axis(model, j, o, work):
    """The velocity of a link at unit speed of its joint: angular, and linear at the point o."""
    row = j * WORK_COLUMNS
    world = row + WORLD
    x = work[world + 2]
    y = work[world + 5]
    z = work[world + 8]
    if model[HEADER + j * JOINT_COLUMNS + IS_SLIDE] != 0.0:
        _store(work, row + AXIS, 0.0, 0.0, 0.0)
        _store(work, row + AXIS + 3, x, y, z)
        return
    _store(work, row + AXIS, x, y, z)
    x, y, z = _cross(work[world + 9] - o[0], work[world + 10] - o[1], work[world + 11] - o[2], x, y, z)
    _store(work, row + AXIS + 3, x, y, z)


@njit_inlined
def _move_link(model, j, v, work):
    """Velocity of a link, and its acceleration minus gravity while all joints keep their speeds."""
    row = j * WORK_COLUMNS
    axis = row + AXIS
    if j == 0:
        for k in range(6):
            work[row + VELOCITY + k] = v * work[axis + k]
        _store(work, row + ACCELERATION, 0.0, 0.0, 0.0)
        _store(work, row + ACCELERATION + 3, -model[GRAVITY], -model[GRAVITY + 1], -model[GRAVITY + 2])
        return
    above = row - WORK_COLUMNS + VELOCITY
    wx = work[above]
    wy = work[above + 1]
    wz = work[above + 2]
    sx = v * work[axis]
    sy = v * work[axis + 1]
    sz = v * work[axis + 2]
    ux = v * work[axis + 3]
    uy = v * work[axis + 4]
    uz = v * work[axis + 5]
    _store(work, row + VELOCITY, wx + sx, wy + sy, wz + sz)
    _store(work, row + VELOCITY + 3, work[above + 3] + ux, work[above + 4] + uy, work[above + 5] + uz)
    # The axis moves with the parent: its derivative is the parent's velocity x the axis.
    ax, ay, az = _cross(wx, wy, wz, sx, sy, sz)
    bx, by, bz = _cross(wx, wy, wz, ux, uy, uz)
    cx, cy, cz = _cross(work[above + 3], work[above + 4], work[above + 5], sx, sy, sz)
    above = row - WORK_COLUMNS + ACCELERATION
    _store(work, row + ACCELERATION, work[above] + ax, work[above + 1] + ay, work[above + 2] + az)
    _store(work, row + ACCELERATION + 3, work[above + 3] + bx + cx, work[above + 4] + by + cy, work[above + 5] + bz + cz)


@njit_inlined
def _load_link(model, j, o, work):
    """Force, and moment about o, that give a link its acceleration."""
    row = j * WORK_COLUMNS
    at = row + VELOCITY
    wx = work[at]
    wy = work[at + 1]
    wz = work[at + 2]
    ax, ay, az = _cross(wx, wy, wz, work[at + 3], work[at + 4], work[at + 5])
    at = row + ACCELERATION
    dx = work[at]
    dy = work[at + 1]
    dz = work[at + 2]
    # A point r of the link, seen from o, has the acceleration a + G r with the (3, 3) matrix G of this turn.
    ax += work[at + 3]
    ay += work[at + 4]
    az += work[at + 5]
    xx = wx * wx
    yy = wy * wy
    zz = wz * wz
    xy = wx * wy
    xz = wx * wz
    yz = wy * wz
    at = row + INERTIA_AT_O
    mass = work[at]
    hx = work[at + 1]
    hy = work[at + 2]
    hz = work[at + 3]
    fx = mass * ax - (yy + zz) * hx + (xy - dz) * hy + (xz + dy) * hz
    fy = mass * ay + (xy + dz) * hx - (xx + zz) * hy + (yz - dx) * hz
    fz = mass * az + (xz - dy) * hx + (yz + dx) * hy - (xx + yy) * hz
    mx, my, mz = _cross(hx, hy, hz, ax, ay, az)
    # The moment is the integral of r x (a + G r) over the mass, with the second moments of r.
    at += 4
    sxx = work[at]
    syy = work[at + 1]
    szz = work[at + 2]
    sxy = work[at + 3]
    sxz = work[at + 4]
    syz = work[at + 5]
    mx += (xz - dy) * sxy + (yz + dx) * syy - (xx + yy) * syz - (xy + dz) * sxz + (xx + zz) * syz - (yz - dx) * szz
    my += (xy - dz) * syz - (yy + zz) * sxz + (xz + dy) * szz - (xz - dy) * sxx - (yz + dx) * sxy + (xx + yy) * sxz
    mz += (xy + dz) * sxx - (xx + zz) * sxy + (yz - dx) * sxz + (yy + zz) * sxy - (xy - dz) * syy - (xz + dy) * syz
    _store(work, row + FORCE, fx, fy, fz)
    _store(work, row + FORCE + 3, mx, my, mz)
    if model[HAS_LIFT] != 0.0:
        _lift_link(model, j, o, work)


@njit
def _lift_link(model, j, o, work):
    """Adds the force and the moment of gravity compensation, which the joints need not give."""
    row = j * WORK_COLUMNS
    world = row + WORLD
    gx = model[GRAVITY]
    gy = model[GRAVITY + 1]
    gz = model[GRAVITY + 2]
    lifted = model[HEADER + j * JOINT_COLUMNS + LIFTED_MASS]
    at = HEADER + j * JOINT_COLUMNS + LIFTED_MOMENT
    x, y, z = _to_parent(work, world, model[at], model[at + 1], model[at + 2])
    x += lifted * (work[world + 9] - o[0])
    y += lifted * (work[world + 10] - o[1])
    z += lifted * (work[world + 11] - o[2])
    mx, my, mz = _cross(x, y, z, gx, gy, gz)
    _add(work, row + FORCE, lifted * gx, lifted * gy, lifted * gz)
    _add(work, row + FORCE + 3, mx, my, mz)


@njit_inlined
def _along(work, axis, fx, fy, fz, mx, my, mz):
    """The power of a force and a moment about o on a motion along an axis at unit speed."""
    return (
        work[axis + 3] * fx
        + work[axis + 4] * fy
        + work[axis + 5] * fz
        + work[axis] * mx
        + work[axis + 1] * my
        + work[axis + 2] * mz
    )


@njit
def bias_and_mass(model, q, v, work, bias, M):
    """The torques (n,) that keep the velocity, and the mass matrix (n, n), both with the drives.

    For an arm without springs and dry friction whose joints follow no others, so that they are one chain. Overwrites where the
    joints are placed.
    """
    n = q.shape[0]
    o = model[HEADER + PLACEMENT + 9 : HEADER + PLACEMENT + 12]
    for j in range(n):
        _locate_link(model, j, q[j], work)
        _find_inertia(model, j, o, work)
        _find_axis(model, j, o, work)
        _move_link(model, j, v[j], work)
        _load_link(model, j, o, work)
    for j in range(n - 1, -1, -1):
        row = j * WORK_COLUMNS
        axis = row + AXIS
        at = row + FORCE
        drive = _drive(model, j)
        speed = abs(v[j])
        damping = model[drive + DAMPING] + speed * (model[drive + DAMPING + 1] + speed * model[drive + DAMPING + 2])
        bias[j] = damping * v[j] + _along(
            work, axis, work[at], work[at + 1], work[at + 2], work[at + 3], work[at + 4], work[at + 5]
        )
        fx, fy, fz, mx, my, mz = _momentum(
            row + INERTIA_AT_O,
            work,
            work[axis],
            work[axis + 1],
            work[axis + 2],
            work[axis + 3],
            work[axis + 4],
            work[axis + 5],
        )
        M[j, j] = model[drive + ARMATURE] + _along(work, axis, fx, fy, fz, mx, my, mz)
        if j > 0:
            for k in range(FORCE, AXIS):
                work[row - WORK_COLUMNS + k] += work[row + k]
        for i in range(j):
            M[j, i] = _along(work, i * WORK_COLUMNS + AXIS, fx, fy, fz, mx, my, mz)
            M[i, j] = M[j, i]


@njit
def is_free(model):
    """Whether `bias_and_inertia` holds for a model: no springs, dry friction or joints that follow others, and one instant."""
    return (
        model[IS_PLAIN] != 0.0
        and model[HAS_SPRINGS] == 0.0
        and model[HAS_FRICTION] == 0.0
        and model[IMPLICIT_NONLINEAR] == 0.0
        and model[HALF_STEP] == 0.0
    )


@njit_inlined
def bias_and_inertia(model, q, v, work):
    """The torques (n,) that keep the velocity, and the inertia (n, n) that a step acts against.

    They are views of the scratch memory, which ends with the inertia and then the bias.
    """
    n = q.shape[0]
    bias = work[work.shape[0] - n :]
    inertia = work[work.shape[0] - n - n * n : work.shape[0] - n].reshape((n, n))
    bias_and_mass(model, q, v, work, bias, inertia)
    add_implicit_damping(model, inertia)
    return bias, inertia


@njit
def inverse_step(model, q, v, a, work, tau):
    """The torque (n,) that changes the velocity by a step in one step; bias and inertia stay in the scratch memory."""
    n = q.shape[0]
    bias, inertia = bias_and_inertia(model, q, v, work)
    for i in range(n):
        total = bias[i]
        for k in range(n):
            total += inertia[i, k] * a[k]
        tau[i] = total


@njit
def free_step(model, bounds, tau, applied, work, q, v):
    """One step of MuJoCo without constraints, with implicit linear damping; replaces q and v, and clips tau to its bounds.

    Behind the scratch memory of the other functions, `work` has room for (n,) more.
    """
    n = q.shape[0]
    bias, inertia = bias_and_inertia(model, q, v, work[: work.shape[0] - n])
    finish_step(model, bounds, tau, applied, bias, inertia, work[work.shape[0] - n :], q, v)


@njit_inlined
def finish_step(model, bounds, tau, applied, bias, inertia, acceleration, q, v):
    """The rest of a step, after `bias_and_inertia`, which it overwrites; the acceleration is scratch (n,)."""
    factorize(inertia)
    for i in range(q.shape[0]):
        bias[i] -= applied[i]
    move_freely(model, bounds, bias, inertia, tau, acceleration, q, v)


@njit_inlined
def move_freely(model, bounds, bias, factors, tau, acceleration, q, v):
    """The rest of a step, from bias and factors of the inertia: clips tau to its bounds, replaces q and v."""
    n = q.shape[0]
    for i in range(n):
        tau[i] = min(max(tau[i], bounds[0, i]), bounds[1, i])
        acceleration[i] = tau[i] - bias[i]
    solve(factors, acceleration)
    for i in range(n):
        v[i] += model[STEP] * acceleration[i]
        q[i] += model[STEP] * v[i]
