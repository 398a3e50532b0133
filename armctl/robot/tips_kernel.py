"""The tip at many positions of the joints, a block of rows at once: compilers turn the loops over a block into vector code."""

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
    PLACEMENT,
    TIP,
    _ratio,
    _to_parent,
    quaternion,
)

BLOCK = 64  # rows
_FRAME_SIZE = 12 * BLOCK  # rotation (9,) and origin (3,) in the world, each for all rows of a block

# pi / 2 in three parts, of which the first two have 33 bits: their products with small integers are exact.
_QUARTER = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_MAX_ANGLE = 1e6  # rad, up to which they are


def scratch_size(joints: int) -> int:
    """Numbers of scratch memory of `tips` for a model of so many joints, besides that of the dynamics and a rotation (9,)."""
    return 3 * BLOCK * joints + _FRAME_SIZE


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
    frames = scratch[3 * size : 3 * size + _FRAME_SIZE]
    for first in range(0, rows.shape[0], BLOCK):
        count = min(BLOCK, rows.shape[0] - first)
        for j in range(joints):
            for k in range(count):
                angle = model[HEADER + j * JOINT_COLUMNS + OFFSET]
                if is_plain:
                    angle = rows[first + k, j]
                else:
                    for i in range(n):
                        angle += _ratio(model, n, j, i) * rows[first + k, i]
                angles[j * count + k] = angle
        sines_and_cosines(angles[: count * joints], sines, cosines)
        for j in range(int(model[CHAIN_LENGTH])):
            own = slice(j * count, (j + 1) * count)
            _place_joints(model, j, frames, count)
            if model[HEADER + j * JOINT_COLUMNS + IS_SLIDE] != 0.0:
                _slide_joints(angles[own], frames)
            else:
                _turn_joints(sines[own], cosines[own], frames)
        for k in range(count):
            for c in range(12):
                work[c] = frames[c * BLOCK + k]
            x, y, z = _to_parent(work, 0, model[TIP + 9], model[TIP + 10], model[TIP + 11])
            positions[first + k, 0] = work[9] + x
            positions[first + k, 1] = work[10] + y
            positions[first + k, 2] = work[11] + z
            for c in range(3):
                x, y, z = _to_parent(work, 0, model[TIP + c], model[TIP + 3 + c], model[TIP + 6 + c])
                rotation[c] = x
                rotation[3 + c] = y
                rotation[6 + c] = z
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
def _place_joints(model, j, frames, count):
    """The frames in the world of a joint of the chain at position zero, from those of the joint below it."""
    at = HEADER + j * JOINT_COLUMNS + PLACEMENT
    if j == 0:
        for c in range(12):
            for k in range(count):
                frames[c * BLOCK + k] = model[at + c]
        return
    x = model[at + 9]
    y = model[at + 10]
    z = model[at + 11]
    xx = model[at]
    xy = model[at + 1]
    xz = model[at + 2]
    yx = model[at + 3]
    yy = model[at + 4]
    yz = model[at + 5]
    zx = model[at + 6]
    zy = model[at + 7]
    zz = model[at + 8]
    for row in range(3):
        start = 3 * row * BLOCK
        for k in range(count):
            a = frames[start + k]
            b = frames[start + BLOCK + k]
            c = frames[start + 2 * BLOCK + k]
            frames[start + k] = a * xx + b * yx + c * zx
            frames[start + BLOCK + k] = a * xy + b * yy + c * zy
            frames[start + 2 * BLOCK + k] = a * xz + b * yz + c * zz
            frames[(9 + row) * BLOCK + k] += a * x + b * y + c * z


@njit
def _slide_joints(positions, frames):
    """Moves the frames of a joint along their z axes."""
    for row in range(3):
        for k in range(positions.shape[0]):
            frames[(9 + row) * BLOCK + k] += positions[k] * frames[(3 * row + 2) * BLOCK + k]


@njit
def _turn_joints(sines, cosines, frames):
    """Turns the frames of a joint about their z axes."""
    for row in range(3):
        start = 3 * row * BLOCK
        for k in range(sines.shape[0]):
            x = frames[start + k]
            y = frames[start + BLOCK + k]
            frames[start + k] = cosines[k] * x + sines[k] * y
            frames[start + BLOCK + k] = cosines[k] * y - sines[k] * x
