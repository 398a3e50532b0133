"""Compiled joint targets whose tip follows a goal, for cartesian actions."""

# pyright: reportCallIssue=false

from __future__ import annotations

import math

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import factorize, locate, place, solve, tip_jacobian, tip_position, tip_rotation

_MAX_ITERATIONS = 4
_REACHED = 1e-10  # square of the error in m and rad: a full action is more than a thousand times its root


@njit
def rotate(vector, rotation, out):
    """out = exp(vector) rotation, (9,) each, by Rodrigues' formula."""
    angle = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if angle < 1e-12:
        for k in range(9):
            out[k] = rotation[k]
        return
    x = vector[0] / angle
    y = vector[1] / angle
    z = vector[2] / angle
    sine = math.sin(angle)
    rest = 1.0 - math.cos(angle)
    for k in range(3):
        a = rotation[k]
        b = rotation[3 + k]
        c = rotation[6 + k]
        along = (x * a + y * b + z * c) * rest
        out[k] = math.cos(angle) * a + sine * (y * c - z * b) + x * along
        out[3 + k] = math.cos(angle) * b + sine * (z * a - x * c) + y * along
        out[6 + k] = math.cos(angle) * c + sine * (x * b - y * a) + z * along


@njit
def find_tip(model, q, work, tip):
    """The tip's position and rotation matrix, (12,)."""
    place(model, q, work)
    locate(model, work)
    x, y, z = tip_position(model, work)
    tip[0] = x
    tip[1] = y
    tip[2] = z
    tip_rotation(model, work, tip[3:])


@njit
def _tip_error(goal, tip, error):
    """The twist (6,) from a tip to a goal: the difference of positions, and the sine of the angle times the axis."""
    for k in range(3):
        error[k] = goal[k] - tip[k]
        error[3 + k] = 0.0
    for k in range(3):
        ax = tip[3 + k]
        ay = tip[6 + k]
        az = tip[9 + k]
        bx = goal[3 + k]
        by = goal[6 + k]
        bz = goal[9 + k]
        error[3] += 0.5 * (ay * bz - az * by)
        error[4] += 0.5 * (az * bx - ax * bz)
        error[5] += 0.5 * (ax * by - ay * bx)


@njit
def follow_tip(model, goal, size, damping, limits, way, start, target, work, J, A, error, tip):
    """Moves a target by damped least squares until its tip is at a goal, at most `way` from `start`.

    The joints are located at the target already, and `tip` is there.

    Nakamura, Hanafusa, "Inverse kinematic solutions with singularity robustness for robot manipulator control" (1986).
    """
    n = target.shape[0]
    for iteration in range(_MAX_ITERATIONS):
        if iteration > 0:
            find_tip(model, target, work, tip)
        _tip_error(goal, tip, error)
        rest = 0.0
        for k in range(size):
            rest += error[k] * error[k]
        if rest < _REACHED:
            return
        tip_jacobian(model, work, J)
        for r in range(size):
            for c in range(size):
                total = damping if r == c else 0.0
                for i in range(n):
                    total += J[r, i] * J[c, i]
                A[r, c] = total
        factorize(A)
        solve(A, error[:size])
        for i in range(n):
            change = 0.0
            for r in range(size):
                change += J[r, i] * error[r]
            moved = min(max(target[i] + change, start[i] - way[i]), start[i] + way[i])
            target[i] = min(max(moved, limits[0, i]), limits[1, i])
