"""The compiled solver: Levenberg-Marquardt on a serial chain, joint bounds as an active set, counted random restarts.

Everything here is scalar loops over small arrays, for numba. Lengths are in units of the arm's reach, so that one set of
constants fits an arm of three centimetres and one of three metres. All kernels live in one file: numba's disk cache notices
a change in this file only.

Levenberg-Marquardt with a damping that follows the error is Sugihara's ("Solvability-unconcerned inverse kinematics by the
Levenberg-Marquardt method", IEEE Trans. Robotics 27(5), 2011).
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from armctl.arrays import Array, BoolArray

# Columns of a packed chain, one row a joint and a last row for the tip: 0-8 rotation, 9-11 translation, then
SLIDE, LOW, HIGH = 12, 13, 14
COLUMNS = 15
# What of the tip is asked for.
POSE, POSITION, FREE_X, FREE_Y, FREE_Z = 0, 1, 2, 3, 4
ROTATION_WEIGHT = 0.5  # of a radian, beside an error of one reach
MAX_STEPS = 60  # of one descent
SETTLE_STEPS = 200  # of the last one, to the nearest that can be had
STALL_STEPS, STALL_GAIN = 4, 0.7  # give a descent up after so many steps whose error stays above this share
DAMPING, DAMPING_FLOOR = 1e-2, 1e-12
BOUND_PASSES = 3


def _njit(function):
    """Compiles, with a cache on disk wherever a folder for it can be written."""
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # numba finds no writable folder: compile in every process
        return numba.njit(nogil=True, error_model="numpy")(function)


class Scratch(NamedTuple):
    """Memory that one search needs, so that no step allocates."""

    origin: Array  # (n, 3) joint origins
    axis: Array  # (n, 3) joint axes
    tip: Array  # (12,) rotation, translation
    error: Array  # (6,)
    jacobian: Array  # (6, n)
    normal: Array  # (n, n) J^T J
    factor: Array  # (n, n) its Cholesky factor
    gradient: Array  # (n,) J^T e
    step: Array  # (n,)
    rhs: Array  # (n,)
    held: BoolArray  # (n,)
    best: Array  # (n,)


@_njit
def make_scratch(n):
    return Scratch(
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty(12),
        np.zeros(6),
        np.zeros((6, n)),
        np.empty((n, n)),
        np.empty((n, n)),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n, np.bool_),
        np.empty(n),
    )


@_njit
def forward(chain, q, origin, axis, tip):
    """Forward kinematics: fills the joints' origins and axes, and the tip's rotation and translation."""
    n = len(q)
    a, b, c, d, e, f, g, h, i = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    x, y, z = 0.0, 0.0, 0.0
    for k in range(n + 1):
        X = chain[k]
        x += a * X[9] + b * X[10] + c * X[11]
        y += d * X[9] + e * X[10] + f * X[11]
        z += g * X[9] + h * X[10] + i * X[11]
        a, b, c = a * X[0] + b * X[3] + c * X[6], a * X[1] + b * X[4] + c * X[7], a * X[2] + b * X[5] + c * X[8]
        d, e, f = d * X[0] + e * X[3] + f * X[6], d * X[1] + e * X[4] + f * X[7], d * X[2] + e * X[5] + f * X[8]
        g, h, i = g * X[0] + h * X[3] + i * X[6], g * X[1] + h * X[4] + i * X[7], g * X[2] + h * X[5] + i * X[8]
        if k == n:
            break
        axis[k, 0], axis[k, 1], axis[k, 2] = c, f, i
        if X[SLIDE] > 0:
            x, y, z = x + c * q[k], y + f * q[k], z + i * q[k]
        else:
            cos, sin = np.cos(q[k]), np.sin(q[k])
            a, b = a * cos + b * sin, b * cos - a * sin
            d, e = d * cos + e * sin, e * cos - d * sin
            g, h = g * cos + h * sin, h * cos - g * sin
        origin[k, 0], origin[k, 1], origin[k, 2] = x, y, z
    tip[0], tip[1], tip[2], tip[3], tip[4], tip[5], tip[6], tip[7], tip[8] = a, b, c, d, e, f, g, h, i
    tip[9], tip[10], tip[11] = x, y, z


@_njit
def fill_jacobian(chain, origin, axis, tip, jacobian):
    """The tip's Jacobian from what `forward` filled: (6, n), linear first, world axes."""
    for k in range(len(origin)):
        u, v, w = axis[k, 0], axis[k, 1], axis[k, 2]
        if chain[k, SLIDE] > 0:
            jacobian[0, k], jacobian[1, k], jacobian[2, k] = u, v, w
            jacobian[3, k], jacobian[4, k], jacobian[5, k] = 0.0, 0.0, 0.0
        else:
            x, y, z = tip[9] - origin[k, 0], tip[10] - origin[k, 1], tip[11] - origin[k, 2]
            jacobian[0, k], jacobian[1, k], jacobian[2, k] = v * z - w * y, w * x - u * z, u * y - v * x
            jacobian[3, k], jacobian[4, k], jacobian[5, k] = u, v, w


@_njit
def fill_error(target, tip, asked, error):
    """What is left to the target: (6,) translation and rotation vector, world axes, from tip to target."""
    for r in range(3):
        error[r] = target[9 + r] - tip[9 + r]
        error[3 + r] = 0.0
    if asked == POSITION:
        return
    x, y, z, cos = 0.0, 0.0, 0.0, 0.0
    if asked == POSE:  # of R_target R_tip^T: the antisymmetric part, and the trace
        for k in range(3):
            x += target[6 + k] * tip[3 + k] - target[3 + k] * tip[6 + k]
            y += target[k] * tip[6 + k] - target[6 + k] * tip[k]
            z += target[3 + k] * tip[k] - target[k] * tip[3 + k]
            cos += target[k] * tip[k] + target[3 + k] * tip[3 + k] + target[6 + k] * tip[6 + k]
        x, y, z, cos = 0.5 * x, 0.5 * y, 0.5 * z, 0.5 * (cos - 1.0)
    else:  # the shortest turn that lays the tip's axis on the target's
        k = asked - FREE_X
        x = tip[3 + k] * target[6 + k] - tip[6 + k] * target[3 + k]
        y = tip[6 + k] * target[k] - tip[k] * target[6 + k]
        z = tip[k] * target[3 + k] - tip[3 + k] * target[k]
        cos = tip[k] * target[k] + tip[3 + k] * target[3 + k] + tip[6 + k] * target[6 + k]
    sin = np.sqrt(x * x + y * y + z * z)
    if sin > 1e-9:
        scale = np.arctan2(sin, cos) / sin
        error[3], error[4], error[5] = scale * x, scale * y, scale * z
    elif cos < 0.0:
        _half_turn(target, tip, asked, error)


@_njit
def _half_turn(target, tip, asked, error):
    """The rotation vector of half a turn: its axis is the longest column of R_target R_tip^T + I, or any normal of the axis."""
    if asked != POSE:
        k = asked - FREE_X
        other = (k + 1) % 3
        for r in range(3):
            error[3 + r] = np.pi * tip[3 * r + other]
        return
    longest, length = 0, -1.0
    for r in range(3):
        diagonal = 0.0
        for k in range(3):
            diagonal += target[3 * r + k] * tip[3 * r + k]
        if diagonal > length:
            longest, length = r, diagonal
    norm = 0.0
    for r in range(3):
        value = 1.0 if r == longest else 0.0
        for k in range(3):
            value += target[3 * r + k] * tip[3 * longest + k]
        error[3 + r] = value
        norm += value * value
    for r in range(3):
        error[3 + r] *= np.pi / np.sqrt(norm)


@_njit
def _linearise(chain, target, q, asked, s):
    """Fills error, Jacobian, J^T J and J^T e at q. Returns the position's and the rotation's error."""
    n = len(q)
    forward(chain, q, s.origin, s.axis, s.tip)
    fill_error(target, s.tip, asked, s.error)
    fill_jacobian(chain, s.origin, s.axis, s.tip, s.jacobian)
    e, J = s.error, s.jacobian
    off = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    turned = np.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    rows = 3 if asked == POSITION else 6
    if asked >= FREE_X:  # a turn about the free axis costs nothing
        k = asked - FREE_X
        u, v, w = s.tip[k], s.tip[3 + k], s.tip[6 + k]
        for i in range(n):
            along = u * J[3, i] + v * J[4, i] + w * J[5, i]
            J[3, i], J[4, i], J[5, i] = J[3, i] - along * u, J[4, i] - along * v, J[5, i] - along * w
    for r in range(3, rows):
        e[r] *= ROTATION_WEIGHT
        for i in range(n):
            J[r, i] *= ROTATION_WEIGHT
    for i in range(n):
        total = 0.0
        for r in range(rows):
            total += J[r, i] * e[r]
        s.gradient[i] = total
        for j in range(i + 1):
            total = 0.0
            for r in range(rows):
                total += J[r, i] * J[r, j]
            s.normal[i, j] = total
            s.normal[j, i] = total
    return off, turned


@_njit
def _solve_free(s, damping):
    """(J^T J + damping I) step = gradient for the joints that are not held; those keep their step."""
    n = len(s.step)
    A, L, x = s.normal, s.factor, s.step
    for i in range(n):
        if s.held[i]:
            continue
        total = s.gradient[i]
        for j in range(n):
            if s.held[j]:
                total -= A[i, j] * x[j]
        for j in range(i):
            if s.held[j]:
                continue
            value = A[i, j]
            for k in range(j):
                if not s.held[k]:
                    value -= L[i, k] * L[j, k]
            L[i, j] = value / L[j, j]
            total -= L[i, j] * s.rhs[j]
        value = A[i, i] + damping
        for k in range(i):
            if not s.held[k]:
                value -= L[i, k] * L[i, k]
        L[i, i] = np.sqrt(max(value, 1e-300))
        s.rhs[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        if s.held[i]:
            continue
        total = s.rhs[i]
        for k in range(i + 1, n):
            if not s.held[k]:
                total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@_njit
def _bounded_step(chain, q, damping, s):
    """A damped step inside the joint bounds: joints pushed out of theirs are held there and the others solved again."""
    n = len(q)
    for i in range(n):
        at_low, at_high = q[i] <= chain[i, LOW], q[i] >= chain[i, HIGH]
        s.held[i] = (at_low and s.gradient[i] < 0) or (at_high and s.gradient[i] > 0)
        s.step[i] = 0.0
    for _ in range(BOUND_PASSES):
        _solve_free(s, damping)
        inside = True
        for i in range(n):
            if not s.held[i] and not chain[i, LOW] <= q[i] + s.step[i] <= chain[i, HIGH]:
                s.held[i] = True
                s.step[i] = min(max(s.step[i], chain[i, LOW] - q[i]), chain[i, HIGH] - q[i])
                inside = False
        if inside:
            break
    for i in range(n):
        q[i] = min(max(q[i] + s.step[i], chain[i, LOW]), chain[i, HIGH])


@_njit
def _descend(chain, target, q, asked, off_max, turned_max, s):
    """One descent from q, which becomes the best position met. Returns (ok, squared error, steps)."""
    n = len(q)
    best, reference, stalled, steps = np.inf, np.inf, 0, 0
    for steps in range(1, MAX_STEPS + 1):
        off, turned = _linearise(chain, target, q, asked, s)
        size = off * off + ROTATION_WEIGHT * ROTATION_WEIGHT * turned * turned
        if size < best:
            best = size
            for i in range(n):
                s.best[i] = q[i]
        if off <= off_max and turned <= turned_max:
            return True, best, steps
        if size < STALL_GAIN * reference:
            reference, stalled = size, 0
        else:
            stalled += 1
            if stalled >= STALL_STEPS:
                break
        _bounded_step(chain, q, DAMPING * min(size, np.sqrt(size)) + DAMPING_FLOOR, s)
    for i in range(n):
        q[i] = s.best[i]
    return False, best, steps


@_njit
def _random(state):
    """The next state of a splitmix64 generator (Steele, Lea, Flood 2014) and its number in [0, 1)."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    x = state
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return state, np.float64(x >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@_njit
def _random_start(chain, q0, start, seed, q):
    """The start of a number: anywhere inside the joint bounds; half a turn around q0 for a joint without bounds."""
    state = np.uint64(seed) ^ (np.uint64(start) * np.uint64(0xD1B54A32D192ED03))
    for i in range(len(q)):
        state, share = _random(state)
        low, high = max(chain[i, LOW], q0[i] - np.pi), min(chain[i, HIGH], q0[i] + np.pi)
        if np.isfinite(chain[i, LOW]) and np.isfinite(chain[i, HIGH]):
            low, high = chain[i, LOW], chain[i, HIGH]
        q[i] = low + share * (high - low)


@_njit
def search(chain, target, asked, off_max, turned_max, q0, first, last, seed, q):
    """Descents from the starts `first` to `last` (start 0 is q0, the others are random) until one is inside the tolerance.

    Returns (ok, starts used, steps); q is the solution, or else the best position met.
    """
    n = len(q0)
    s = make_scratch(n)
    trial = np.empty(n)
    best, steps = np.inf, 0
    for start in range(first, last):
        if start == 0:
            trial[:] = q0
        else:
            _random_start(chain, q0, start, seed, trial)
        ok, size, more = _descend(chain, target, trial, asked, off_max, turned_max, s)
        steps += more
        if ok or size < best:
            best = size
            for i in range(n):
                q[i] = trial[i]
        if ok:
            return True, start + 1 - first, steps
    return False, last - first, steps


@_njit
def settle(chain, target, asked, q):
    """Moves q to the nearest it can come to a target it cannot reach: a descent whose every step makes the error smaller."""
    n = len(q)
    s = make_scratch(n)
    trial = q.copy()
    off, turned = _linearise(chain, target, trial, asked, s)
    best = off * off + ROTATION_WEIGHT * ROTATION_WEIGHT * turned * turned
    damping = np.sqrt(best)  # the curvature that J^T J leaves out is as large as the error
    for _ in range(SETTLE_STEPS):
        _bounded_step(chain, trial, damping + DAMPING_FLOOR, s)
        moved = 0.0
        for i in range(n):
            moved = max(moved, abs(trial[i] - q[i]))
        off, turned = _linearise(chain, target, trial, asked, s)
        size = off * off + ROTATION_WEIGHT * ROTATION_WEIGHT * turned * turned
        if size < best:
            best, damping = size, 0.5 * damping
            q[:] = trial
        else:
            damping *= 4.0
            trial[:] = q
            _linearise(chain, target, trial, asked, s)
        if moved < 1e-9:
            break
