"""Which positions of a motion in free space are looked at for contacts, and which joints reach their limits, in one pass."""

from __future__ import annotations

import math

from armctl.core.jit import njit_borrowing


@njit_borrowing
def inspect(rows, now, joints, limits, distance, is_spaced, is_beyond):
    """Marks rows of a motion, and joints.

    `rows` (T, nq) are positions of the model, `now` (nq,) is the position after them, `joints` (n,) are the addresses of the
    joints, and `limits` (2, n) bounds them. `is_spaced` (T + 1,) marks the first row, the last, and rows between which no joint
    moves farther than the distance; `is_beyond` (n,) marks joints that reach a bound.
    """
    way = 0.0
    steps = -1.0
    before = rows[0] if len(rows) else now
    for k in range(len(rows) + 1):
        row = rows[k] if k < len(rows) else now
        farthest = 0.0
        for i in range(len(joints)):
            q = row[joints[i]]
            if not limits[0, i] < q < limits[1, i]:
                is_beyond[i] = True
            moved = abs(q - before[joints[i]])
            if not moved <= farthest:  # also if it is not a number
                farthest = moved
        way += farthest
        if math.floor(way / distance) != steps:
            is_spaced[k] = True
        steps = math.floor(way / distance)
        before = row
    is_spaced[len(rows)] = True
