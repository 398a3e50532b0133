"""Compiled forward dynamics of an arm that touches nothing, in world axes and about one point o, the origin of the first joint.

Forces and inertias of links then add up as they are, which is less work than in the frames of the links. The recursions are
those of `dynamics_kernel`, whose models and scratch memory they use; the algebra is that of Featherstone, Rigid Body Dynamics
Algorithms (2008), 2.10.
"""

from __future__ import annotations

import math

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import (
    ARMATURE,
    CENTER,
    DAMPING,
    GRAVITY,
    HAS_LIFT,
    HEADER,
    INERTIA,
    IS_SLIDE,
    JOINT_COLUMNS,
    LIFTED_MASS,
    LIFTED_MOMENT,
    MASS,
    PARENT,
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
INERTIA_AT_O = 18  # mass, first moment (3,), inertia (6,)
AXIS = 28


@njit
def _locate_link(model, j, q, work):
    """The frame of a joint in the world at position q of it, from that of its parent."""
    row = j * WORK_COLUMNS + WORLD
    joint = HEADER + j * JOINT_COLUMNS
    at = joint + PLACEMENT
    parent = int(model[joint + PARENT])
    x = model[at + 9]
    y = model[at + 10]
    z = model[at + 11]
    if parent < 0:
        for k in range(9):
            work[row + k] = model[at + k]
        _store(work, row + 9, x, y, z)
    else:
        above = parent * WORK_COLUMNS + WORLD
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


@njit
def _find_inertia(model, j, o, work):
    """Mass, first moment and inertia of a link about o."""
    joint = HEADER + j * JOINT_COLUMNS
    row = j * WORK_COLUMNS + WORLD
    inertia = j * WORK_COLUMNS + INERTIA_AT_O
    mass = model[joint + MASS]
    x, y, z = _to_parent(work, row, model[joint + CENTER], model[joint + CENTER + 1], model[joint + CENTER + 2])
    x += work[row + 9] - o[0]
    y += work[row + 10] - o[1]
    z += work[row + 11] - o[2]
    at = joint + INERTIA
    # R I R^T, column by column of R^T, which are the rows of R.
    a, b, c = _inertia_times(model, at, work[row], work[row + 1], work[row + 2])
    xx, xy, xz = _to_parent(work, row, a, b, c)
    a, b, c = _inertia_times(model, at, work[row + 3], work[row + 4], work[row + 5])
    yy = work[row + 3] * a + work[row + 4] * b + work[row + 5] * c
    yz = work[row + 6] * a + work[row + 7] * b + work[row + 8] * c
    a, b, c = _inertia_times(model, at, work[row + 6], work[row + 7], work[row + 8])
    zz = work[row + 6] * a + work[row + 7] * b + work[row + 8] * c
    work[inertia] = mass
    _store(work, inertia + 1, mass * x, mass * y, mass * z)
    _store(work, inertia + 4, xx + mass * (y * y + z * z), yy + mass * (x * x + z * z), zz + mass * (x * x + y * y))
    _store(work, inertia + 7, xy - mass * x * y, xz - mass * x * z, yz - mass * y * z)


@njit
def _momentum(inertia, work, wx, wy, wz, vx, vy, vz):
    """Linear momentum, and angular momentum about o, of a body with angular velocity w whose point at o has velocity v."""
    mass = work[inertia]
    hx = work[inertia + 1]
    hy = work[inertia + 2]
    hz = work[inertia + 3]
    px, py, pz = _cross(wx, wy, wz, hx, hy, hz)
    lx, ly, lz = _inertia_times(work, inertia + 4, wx, wy, wz)
    cx, cy, cz = _cross(hx, hy, hz, vx, vy, vz)
    return px + mass * vx, py + mass * vy, pz + mass * vz, lx + cx, ly + cy, lz + cz


@njit
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


@njit
def _move_link(model, j, v, work):
    """Velocity of a link, and its acceleration minus gravity while all joints keep their speeds."""
    row = j * WORK_COLUMNS
    parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
    axis = row + AXIS
    if parent < 0:
        for k in range(6):
            work[row + VELOCITY + k] = v * work[axis + k]
        _store(work, row + ACCELERATION, 0.0, 0.0, 0.0)
        _store(work, row + ACCELERATION + 3, -model[GRAVITY], -model[GRAVITY + 1], -model[GRAVITY + 2])
        return
    above = parent * WORK_COLUMNS + VELOCITY
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
    above = parent * WORK_COLUMNS + ACCELERATION
    _store(work, row + ACCELERATION, work[above] + ax, work[above + 1] + ay, work[above + 2] + az)
    _store(work, row + ACCELERATION + 3, work[above + 3] + bx + cx, work[above + 4] + by + cy, work[above + 5] + bz + cz)


@njit
def _load_link(model, j, o, work):
    """Force, and moment about o, that give a link its acceleration."""
    row = j * WORK_COLUMNS
    inertia = row + INERTIA_AT_O
    at = row + ACCELERATION
    fx, fy, fz, mx, my, mz = _momentum(
        inertia, work, work[at], work[at + 1], work[at + 2], work[at + 3], work[at + 4], work[at + 5]
    )
    at = row + VELOCITY
    wx = work[at]
    wy = work[at + 1]
    wz = work[at + 2]
    vx = work[at + 3]
    vy = work[at + 4]
    vz = work[at + 5]
    px, py, pz, lx, ly, lz = _momentum(inertia, work, wx, wy, wz, vx, vy, vz)
    gx, gy, gz = _cross(wx, wy, wz, px, py, pz)
    _store(work, row + FORCE, fx + gx, fy + gy, fz + gz)
    gx, gy, gz = _cross(wx, wy, wz, lx, ly, lz)
    cx, cy, cz = _cross(vx, vy, vz, px, py, pz)
    _store(work, row + FORCE + 3, mx + gx + cx, my + gy + cy, mz + gz + cz)
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


@njit
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
    """The torques (n,) that keep the velocity, and the lower triangle of the mass matrix (n, n), both with the drives.

    For an arm without springs and dry friction whose joints follow no others. Overwrites where the joints are placed.
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
        for i in range(j):
            M[j, i] = 0.0
        M[j, j] = model[drive + ARMATURE] + _along(work, axis, fx, fy, fz, mx, my, mz)
        parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
        if parent >= 0:
            for k in range(FORCE, AXIS):
                work[parent * WORK_COLUMNS + k] += work[row + k]
        while parent >= 0:
            M[j, parent] = _along(work, parent * WORK_COLUMNS + AXIS, fx, fy, fz, mx, my, mz)
            parent = int(model[HEADER + parent * JOINT_COLUMNS + PARENT])


@njit
def bias_and_factors(model, q, v, work, bias, factors):
    """The torques (n,) that keep the velocity, and the factors (n, n) of the inertia that a step acts against."""
    bias_and_mass(model, q, v, work, bias, factors)
    add_implicit_damping(model, factors)
    factorize(factors)


@njit
def free_step(model, bounds, tau, applied, work, q, v):
    """One step of MuJoCo without constraints, with implicit linear damping; replaces q and v, and clips tau to its bounds.

    Behind the scratch memory of the other functions, `work` has room for (n,) more.
    """
    n = q.shape[0]
    inner = work[: work.shape[0] - n]
    acceleration = work[work.shape[0] - n :]
    force = inner[inner.shape[0] - n :]
    factors = inner[inner.shape[0] - n - n * n : inner.shape[0] - n].reshape((n, n))
    bias_and_factors(model, q, v, inner, force, factors)
    for i in range(n):
        force[i] -= applied[i]
    move_freely(model, bounds, force, factors, tau, acceleration, q, v)


@njit
def move_freely(model, bounds, bias, factors, tau, acceleration, q, v):
    """The rest of a step, after `bias_and_factors`: clips tau to its bounds, computes the acceleration, replaces q and v."""
    n = q.shape[0]
    for i in range(n):
        tau[i] = min(max(tau[i], bounds[0, i]), bounds[1, i])
        acceleration[i] = tau[i] - bias[i]
    solve(factors, acceleration)
    for i in range(n):
        v[i] += model[STEP] * acceleration[i]
        q[i] += model[STEP] * v[i]
