"""The tip at many positions of the joints: sines and cosines of many rows at once, which compilers turn into vector code."""

from __future__ import annotations

import math

from armctl.core.jit import njit, njit_borrowing
from armctl.robot.dynamics_kernel import (
    CHAIN_LENGTH,
    HEADER,
    IS_PLAIN,
    IS_SLIDE,
    JOINT_COLUMNS,
    JOINTS,
    OFFSET,
    PARENT,
    PLACEMENT,
    WORK_COLUMNS,
    WORLD,
    _ratio,
    _to_parent,
    quaternion,
    tip_position,
    tip_rotation,
)

BLOCK = 64  # rows

# pi / 2 in three parts, of which the first two have 33 bits: their products with small integers are exact.
_QUARTER = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_MAX_ANGLE = 1e6  # rad, up to which they are


def scratch_size(joints: int) -> int:
    """Numbers of scratch memory of `tips` for a model of so many joints, besides that of the dynamics and a rotation (9,)."""
    return 3 * BLOCK * joints


@njit_borrowing
def tips(model, rows, scratch, work, positions, quats):
    """The tip at every row of positions of the arm's joints, (T, n): positions (T, 3) and quaternions (T, 4)."""
    n = rows.shape[1]
    joints = int(model[JOINTS])
    is_plain = model[IS_PLAIN] != 0.0
    rotation = work[work.shape[0] - 9 :]
    size = BLOCK * joints
    angles = scratch[:size]
    sines = scratch[size : 2 * size]
    cosines = scratch[2 * size : 3 * size]
    for first in range(0, rows.shape[0], BLOCK):
        count = min(BLOCK, rows.shape[0] - first)
        for k in range(count):
            for j in range(joints):
                angle = model[HEADER + j * JOINT_COLUMNS + OFFSET]
                if is_plain:
                    angle = rows[first + k, j]
                else:
                    for i in range(n):
                        angle += _ratio(model, n, j, i) * rows[first + k, i]
                angles[k * joints + j] = angle
        sines_and_cosines(angles[: count * joints], sines, cosines)
        for k in range(count):
            at = k * joints
            _locate_chain(model, angles[at : at + joints], sines[at : at + joints], cosines[at : at + joints], work)
            x, y, z = tip_position(model, work)
            positions[first + k, 0] = x
            positions[first + k, 1] = y
            positions[first + k, 2] = z
            tip_rotation(model, work, rotation)
            quaternion(rotation, quats[first + k])


@njit
def sines_and_cosines(angles, sines, cosines):
    """Sines and cosines of angles, rad, to one unit in the last place, by the polynomials of fdlibm (Sun, 1993).

    The loop has no branches and calls nothing.
    """
    for i in range(angles.shape[0]):
        quarters = math.floor(angles[i] * (2.0 / math.pi) + 0.5)
        far = angles[i] - quarters * _QUARTER[0]
        part = quarters * _QUARTER[1]
        x = far - part
        rest = (far - x) - part - quarters * _QUARTER[2]
        z = x * x
        tail = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
        tail = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * tail)
        sine = x + (z * x) * (-1.66666666666666324348e-01 + z * tail) + rest * (1.0 - 0.5 * z)
        tail = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
        tail = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * tail))
        near = 1.0 - 0.5 * z
        cosine = near + (((1.0 - near) - 0.5 * z) + (z * z * tail - x * rest))
        turn = quarters - 4.0 * math.floor(0.25 * quarters)  # 0, 1, 2 or 3
        is_odd = (turn == 1.0) | (turn == 3.0)
        first = cosine if is_odd else sine
        second = sine if is_odd else cosine
        sines[i] = -first if turn >= 2.0 else first
        cosines[i] = -second if (turn == 1.0) | (turn == 2.0) else second
    for i in range(angles.shape[0]):
        if not abs(angles[i]) < _MAX_ANGLE:
            sines[i] = math.sin(angles[i])
            cosines[i] = math.cos(angles[i])


@njit
def _locate_chain(model, angles, sines, cosines, work):
    """The frames in the world of the joints from the base to the tip, as `place` and `locate`."""
    for j in range(int(model[CHAIN_LENGTH])):
        row = j * WORK_COLUMNS + WORLD
        joint = HEADER + j * JOINT_COLUMNS
        at = joint + PLACEMENT
        parent = int(model[joint + PARENT])
        if parent < 0:
            for k in range(12):
                work[row + k] = model[at + k]
        else:
            above = parent * WORK_COLUMNS + WORLD
            for k in range(3):
                x, y, z = _to_parent(work, above, model[at + k], model[at + 3 + k], model[at + 6 + k])
                work[row + k] = x
                work[row + 3 + k] = y
                work[row + 6 + k] = z
            x, y, z = _to_parent(work, above, model[at + 9], model[at + 10], model[at + 11])
            work[row + 9] = work[above + 9] + x
            work[row + 10] = work[above + 10] + y
            work[row + 11] = work[above + 11] + z
        if model[joint + IS_SLIDE] != 0.0:
            for k in range(3):
                work[row + 9 + k] += angles[j] * work[row + 3 * k + 2]
            continue
        for k in range(3):
            x = work[row + 3 * k]
            y = work[row + 3 * k + 1]
            work[row + 3 * k] = cosines[j] * x + sines[j] * y
            work[row + 3 * k + 1] = cosines[j] * y - sines[j] * x
