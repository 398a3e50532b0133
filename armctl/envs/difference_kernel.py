"""Compiled differences between the equations of motion of a plant and those of the model that the controller knows.

Masses and drives differ, and the geometry is the same. So placements and velocities of the links are computed once per tick,
for the plant. Torques and inertias are linear in mass, first moment and inertia of each link about a point, so the difference
is that of an arm whose links have the differences of these. After a payload, only the last of them is not zero.
"""

from __future__ import annotations

from armctl.core.jit import njit_inlined
from armctl.robot.dynamics_kernel import (
    HEADER,
    JOINT_COLUMNS,
    PARENT,
    PLACEMENT,
    STEP,
    WORK_COLUMNS,
    WORLD,
    _inertia_times,
    _store,
    _to_parent,
)
from armctl.robot.forward_dynamics_kernel import ACCELERATION, AXIS, FORCE, INERTIA_AT_O, _along, _load_link, _momentum

# Columns of a difference, one row per joint:
DIFFERS = 0  # whether its link does
MASS = 1
MOMENT = 2  # (3,) first moment about the joint's origin, in its frame
INERTIA = 5  # xx yy zz xy xz yz about the joint's origin
DAMPING = 11  # linear, of the joint
IMPLICIT_DAMPING = 12
COLUMNS = 13


@njit_inlined
def _find_inertia(difference, j, o, work):
    """Mass, first moment and second moment of the difference of a link, about o."""
    row = j * WORK_COLUMNS + WORLD
    inertia = j * WORK_COLUMNS + INERTIA_AT_O
    mass = difference[j, MASS]
    hx, hy, hz = _to_parent(work, row, difference[j, MOMENT], difference[j, MOMENT + 1], difference[j, MOMENT + 2])
    x = work[row + 9] - o[0]
    y = work[row + 10] - o[1]
    z = work[row + 11] - o[2]
    # R I R^T, column by column of R^T, which are the rows of R.
    own = difference[j]
    half = 0.5 * (own[INERTIA] + own[INERTIA + 1] + own[INERTIA + 2])  # of the trace: the second moment is half 1 - I
    a, b, c = _inertia_times(own, INERTIA, work[row], work[row + 1], work[row + 2])
    xx, xy, xz = _to_parent(work, row, a, b, c)
    a, b, c = _inertia_times(own, INERTIA, work[row + 3], work[row + 4], work[row + 5])
    _, yy, yz = _to_parent(work, row, a, b, c)
    a, b, c = _inertia_times(own, INERTIA, work[row + 6], work[row + 7], work[row + 8])
    _, _, zz = _to_parent(work, row, a, b, c)
    # About o, at -t from the joint: S + h t^T + t h^T + mass t t^T.
    work[inertia] = mass
    _store(work, inertia + 1, hx + mass * x, hy + mass * y, hz + mass * z)
    _store(
        work,
        inertia + 4,
        half - xx + 2.0 * hx * x + mass * x * x,
        half - yy + 2.0 * hy * y + mass * y * y,
        half - zz + 2.0 * hz * z + mass * z * z,
    )
    _store(
        work,
        inertia + 7,
        hx * y + hy * x + mass * x * y - xy,
        hx * z + hz * x + mass * x * z - xz,
        hy * z + hz * y + mass * y * z - yz,
    )


@njit_inlined
def subtract_torque(model, difference, v, a, work, tau):
    """Subtracts from tau (n,) what only the plant needs to get the acceleration a (n,) in a step.

    Args:
        model: The plant.
        difference: (n, COLUMNS) of the plant from the model.
        v: (n,) rad/s.
        a: (n,) rad/s^2.
        work: Scratch memory as `bias_and_mass` of the plant leaves it; the accelerations and forces of links are overwritten.
        tau: (n,) N m.
    """
    n = a.shape[0]
    o = model[HEADER + PLACEMENT + 9 : HEADER + PLACEMENT + 12]
    for j in range(n):
        # The accelerations of the joints add up along the chain, in the place of forces.
        force = j * WORK_COLUMNS + FORCE
        axis = j * WORK_COLUMNS + AXIS
        parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
        for k in range(6):
            total = a[j] * work[axis + k]
            if parent >= 0:
                total += work[parent * WORK_COLUMNS + FORCE + k]
            work[force + k] = total
    for j in range(n):
        force = j * WORK_COLUMNS + FORCE
        at = j * WORK_COLUMNS + ACCELERATION
        if difference[j, DIFFERS] == 0.0:
            for k in range(6):
                work[force + k] = 0.0
            continue
        for k in range(6):
            work[at + k] += work[force + k]
        _find_inertia(difference, j, o, work)
        _load_link(model, j, o, work)
    for j in range(n - 1, -1, -1):
        at = j * WORK_COLUMNS + FORCE
        parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
        if parent >= 0:
            for k in range(6):
                work[parent * WORK_COLUMNS + FORCE + k] += work[at + k]
        tau[j] -= _along(
            work, j * WORK_COLUMNS + AXIS, work[at], work[at + 1], work[at + 2], work[at + 3], work[at + 4], work[at + 5]
        )
        tau[j] -= difference[j, DAMPING] * v[j] + model[STEP] * difference[j, IMPLICIT_DAMPING] * a[j]


@njit_inlined
def subtract_mass(model, difference, work, M):
    """Subtracts from the lower triangle of a plant's mass matrix (n, n) what the model lacks, after `subtract_torque`."""
    n = M.shape[0]
    for j in range(n):
        if difference[j, DIFFERS] == 0.0:
            for k in range(INERTIA_AT_O, AXIS):
                work[j * WORK_COLUMNS + k] = 0.0
    for j in range(n - 1, -1, -1):
        row = j * WORK_COLUMNS
        axis = row + AXIS
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
        parent = int(model[HEADER + j * JOINT_COLUMNS + PARENT])
        if parent >= 0:
            for k in range(INERTIA_AT_O, AXIS):
                work[parent * WORK_COLUMNS + k] += work[row + k]
        i = j
        while i >= 0:
            M[j, i] -= _along(work, i * WORK_COLUMNS + AXIS, fx, fy, fz, mx, my, mz)
            i = int(model[HEADER + i * JOINT_COLUMNS + PARENT])
