"""The tip along a path of the joints, compiled: the steps of joints that follow a path, and the twists of the tip."""

from __future__ import annotations

import math

import numpy as np

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import (
    factorize,
    locate,
    place,
    quaternion,
    solve,
    tip_jacobian,
    tip_position,
    tip_rotation,
    work_size,
)

# Rows of the ranges of the joints, (2, n).
LOW = 0
RANGE = 1  # 0 for a joint without bounds

MAX_CHANGE = 0.08  # rad (m), of any joint in one step: four times as far as a step is meant to go
MAX_NEWTON_ITERATIONS = 8
NEWTON_TOLERANCE = 1e-10  # m and rad
DAMPING = 1e-12  # of the pseudo-inverse
MIN_ROOM = 1e-3  # of a joint at a limit; in the middle of its range it is 1


@njit
def slope(model, ranges, centering, q, twist, v):
    """The joint velocities v (n,) that make a twist of the tip (3,) or (6,), at the positions q (n,).

    Where the twist leaves joints free, they go to the middle of their ranges at the rate `centering`.
    """
    work = np.zeros(work_size(model, len(q)))
    J = np.zeros((6, len(q)))
    A = np.zeros((len(twist), len(twist)))
    _follow(model, ranges, centering, q, twist, work, J, A, np.zeros(len(twist)), v)


@njit
def step(model, ranges, centering, q, slope_here, length, halfway, end, goal, moved):
    """The joints a step further along a path of the tip.

    Args:
        model: The vector of `PackedDynamics`.
        ranges: (2, n).
        centering: How fast the joints go to the middle of their ranges where the path leaves them free.
        q: (n,).
        slope_here: (n,) the slope at q.
        length: Of the step.
        halfway: (3,) or (6,) twist of the tip by the length, half a step further.
        end: The same a whole step further.
        goal: (12,) position and rotation of the tip there.
        moved: (n,) result.

    Returns:
        Whether the tip is at the goal.
    """
    n = len(q)
    work = np.zeros(work_size(model, n))
    J = np.zeros((6, n))
    A = np.zeros((len(end), len(end)))
    x = np.zeros(len(end))
    change = np.zeros(n)
    v = slope_here.copy()
    for stage in range(4):
        weight = 2.0 if stage == 1 or stage == 2 else 1.0
        for i in range(n):
            change[i] += length / 6.0 * weight * v[i]
        if stage == 3:
            break
        reached = 1.0 if stage == 2 else 0.5
        for i in range(n):
            moved[i] = q[i] + reached * length * v[i]
        _follow(model, ranges, centering, moved, end if stage == 2 else halfway, work, J, A, x, v)
    for i in range(n):
        if not abs(change[i]) <= MAX_CHANGE:
            return False
        moved[i] = q[i] + change[i]
    rotation = np.zeros(9)
    quat = np.zeros(4)
    for _ in range(MAX_NEWTON_ITERATIONS):
        place(model, moved, work)
        locate(model, work)
        if _fill_error(model, goal, work, rotation, quat, x) < NEWTON_TOLERANCE:
            return True
        _invert(model, ranges, moved, x, work, J, A, v)
        for i in range(n):
            moved[i] += v[i]
    return False


@njit
def distances(model, q, goals, rows, found):
    """How far the tip at positions q (T, n) is from places (T, 12): found (T,), m and rad; the point alone with 3 rows."""
    work = np.zeros(work_size(model, q.shape[1]))
    rotation = np.zeros(9)
    quat = np.zeros(4)
    error = np.zeros(rows)
    for k in range(len(q)):
        place(model, q[k], work)
        locate(model, work)
        found[k] = _fill_error(model, goals[k], work, rotation, quat, error)


@njit
def twists(model, q, v, found):
    """The twists (T, 6) of the tip, linear first, world axes, at positions and velocities (T, n)."""
    n = q.shape[1]
    work = np.zeros(work_size(model, n))
    J = np.zeros((6, n))
    for k in range(len(q)):
        place(model, q[k], work)
        locate(model, work)
        tip_jacobian(model, work, J)
        for r in range(6):
            total = 0.0
            for i in range(n):
                total += J[r, i] * v[k, i]
            found[k, r] = total


@njit
def _follow(model, ranges, centering, q, twist, work, J, A, x, v):
    """`slope` with scratch memory: work, J (6, n), A (rows, rows) and x (rows,)."""
    rows = len(twist)
    place(model, q, work)
    locate(model, work)
    for r in range(rows):
        x[r] = twist[r]
    if centering > 0.0:
        tip_jacobian(model, work, J)
        for i in range(len(q)):
            wanted = _centering_speed(ranges, centering, q, i)
            for r in range(rows):
                x[r] -= J[r, i] * wanted
    _invert(model, ranges, q, x, work, J, A, v)
    if centering > 0.0:
        for i in range(len(q)):
            v[i] += _centering_speed(ranges, centering, q, i)


@njit
def _centering_speed(ranges, centering, q, i):
    """How fast joint i goes to the middle of its range if nothing else moves it."""
    if ranges[RANGE, i] == 0.0:
        return 0.0
    return centering * (ranges[LOW, i] + 0.5 * ranges[RANGE, i] - q[i])


@njit
def _invert(model, ranges, q, x, work, J, A, v):
    """The least joint velocities v that make the twist x, at the located joints. Those near their limits count for more."""
    n = len(q)
    rows = len(x)
    tip_jacobian(model, work, J)
    for r in range(rows):
        for c in range(r + 1):
            total = 0.0
            for i in range(n):
                total += _room(ranges, q, i) * J[r, i] * J[c, i]
            A[r, c] = total
        A[r, r] += DAMPING
    factorize(A)
    solve(A, x)
    for i in range(n):
        total = 0.0
        for r in range(rows):
            total += J[r, i] * x[r]
        v[i] = _room(ranges, q, i) * total


@njit
def _room(ranges, q, i):
    """1 in the middle of the range of joint i, less near its limits."""
    if ranges[RANGE, i] == 0.0:
        return 1.0
    share = (q[i] - ranges[LOW, i]) / ranges[RANGE, i]
    return max(4.0 * share * (1.0 - share), MIN_ROOM)


@njit
def _fill_error(model, goal, work, rotation, quat, error):
    """Fills the twist (3,) or (6,) that takes the tip, at the located joints, to a place. Returns its length."""
    x, y, z = tip_position(model, work)
    error[0] = goal[0] - x
    error[1] = goal[1] - y
    error[2] = goal[2] - z
    if len(error) == 6:
        _fill_rotation_error(model, goal, work, rotation, quat, error)
    squared = 0.0
    for r in range(len(error)):
        squared += error[r] * error[r]
    return math.sqrt(squared)


@njit
def _fill_rotation_error(model, goal, work, rotation, quat, error):
    """Fills the rotation vector, in world axes, that turns the tip to the orientation of a place."""
    tip_rotation(model, work, rotation)
    turn = np.zeros(9)
    for r in range(3):
        for c in range(3):
            for k in range(3):
                turn[3 * r + c] += goal[3 + 3 * r + k] * rotation[3 * c + k]
    quaternion(turn, quat)
    sine = math.sqrt(quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    scale = 2.0 * math.atan2(sine, quat[0]) / sine if sine > 0.0 else 2.0
    for k in range(3):
        error[3 + k] = scale * quat[1 + k]
