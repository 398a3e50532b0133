"""The compiled solver: Levenberg-Marquardt on a serial chain, joint bounds as an active set, counted random restarts.

Everything here is scalar loops over one small array, which numba compiles in seconds and runs without allocating. Lengths are
in units of the arm's reach, so that one set of constants fits an arm of three centimetres and one of three metres. All
kernels live in one file: numba's disk cache notices a change in this file only.

A damping that follows the error is Sugihara's ("Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
method", IEEE Trans. Robotics 27(5), 2011).
"""

from __future__ import annotations

import numpy as np

from armctl.core.jit import njit

# A packed chain (k + 1, 18): one row a joint and a last row for the tip: rotation 0-8, translation 9-11, and of a joint whether
# it slides, which of the n unknowns moves it, and by how much. The first n rows also hold the unknowns' bounds and periods.
SLIDE, LOW, HIGH, LEADER, RATIO, TURN = 12, 13, 14, 15, 16, 17

# What of the tip is asked for.
POSE, POSITION, FREE_X = 0, 1, 2  # the next two are free about y and about z

# Scratch memory (k + 2, 18 + 2 n). One row a joint, the first n also one an unknown:
ORIGIN, AXIS, JACOBIAN = 0, 3, 6  # (3,), (3,), (6,)
GRADIENT, STEP, HELD, BEST = 12, 13, 14, 15
RHS, PIVOT = 16, 17  # of the joints that are free, packed
NORMAL = 18  # (n,) a row of J^T J's lower triangle; behind it the n of its factor, packed
# a row for the tip: rotation 0-8, translation 9-11, error 12-17, and a row for the target: rotation, translation.
ERROR = 12
FIRST = 12  # in the target's row: the squared error at the start of a descent

NEAR, JUMP = 0.5, 0.3  # more than 0.3 rad of a joint for a target within half a reach is suspicious
ROTATION_WEIGHT = 1 / 3  # of a radian, beside an error of one reach
DESCENT_STEPS = 60
SETTLE_STEPS, SETTLE_DAMPING, SETTLE_CONVEX, SETTLED = 200, 0.1, 1e-2, 1e-7
STALL_STEPS, STALL_GAIN = 3, 0.7  # give a descent up after so many steps whose error stays above this share
HOPELESS_STARTS, HOPELESS = 150, 0.03  # give a target up after so many starts if all ended farther off than this
DAMPING, DAMPING_FLOOR = 2e-2, 1e-12
BOUND_PASSES = 3
STEP_MAX = 1.0  # rad, or reaches
STRETCH = 0.2  # every other random start lies beyond the bounds by up to this share of their range: then it is at them
NULL_PASSES, NO_ROOM, NULL_DAMPING = 4, 0.01, 1e-10
SKEW, BOTTOM = 1e-6, 1e-9  # how far a matrix may be from a rotation, and the row below it from 0 0 0 1
FARTHEST = 1e3  # reaches, up to where the solver sees the difference a step makes


@njit
def scratch(joints, unknowns):
    """The memory of one search, not initialised; a chain has fewer unknowns than joints where joints follow others."""
    return np.empty((joints + 2, NORMAL + 2 * unknowns))


@njit
def _unknowns(work):
    """How many unknowns a scratch memory is for."""
    return (work.shape[1] - NORMAL) // 2


@njit
def forward(chain, q, work):
    """Forward kinematics: fills the joints' origins and axes, and the tip's rotation and translation."""
    n = len(chain) - 1
    a, b, c, d, e, f, g, h, i = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    x, y, z = 0.0, 0.0, 0.0
    for k in range(n + 1):
        r, s, t = chain[k, 9], chain[k, 10], chain[k, 11]
        x += a * r + b * s + c * t
        y += d * r + e * s + f * t
        z += g * r + h * s + i * t
        xx, xy, xz = chain[k, 0], chain[k, 1], chain[k, 2]
        yx, yy, yz = chain[k, 3], chain[k, 4], chain[k, 5]
        zx, zy, zz = chain[k, 6], chain[k, 7], chain[k, 8]
        r, s, t = a * xx + b * yx + c * zx, a * xy + b * yy + c * zy, a * xz + b * yz + c * zz
        a, b, c = r, s, t
        r, s, t = d * xx + e * yx + f * zx, d * xy + e * yy + f * zy, d * xz + e * yz + f * zz
        d, e, f = r, s, t
        r, s, t = g * xx + h * yx + i * zx, g * xy + h * yy + i * zy, g * xz + h * yz + i * zz
        g, h, i = r, s, t
        if k < n:
            moved = chain[k, RATIO] * q[int(chain[k, LEADER])]
            if chain[k, SLIDE] > 0:
                x += c * moved
                y += f * moved
                z += i * moved
            else:
                cos, sin = np.cos(moved), np.sin(moved)
                r, s, t = a * cos + b * sin, d * cos + e * sin, g * cos + h * sin
                b, e, h = b * cos - a * sin, e * cos - d * sin, h * cos - g * sin
                a, d, g = r, s, t
            work[k, ORIGIN], work[k, ORIGIN + 1], work[k, ORIGIN + 2] = x, y, z
            work[k, AXIS], work[k, AXIS + 1], work[k, AXIS + 2] = c, f, i
    work[n, 0], work[n, 1], work[n, 2] = a, b, c
    work[n, 3], work[n, 4], work[n, 5] = d, e, f
    work[n, 6], work[n, 7], work[n, 8] = g, h, i
    work[n, 9], work[n, 10], work[n, 11] = x, y, z


@njit
def jacobian(chain, work):
    """The tip's Jacobian from what `forward` filled: a row of six for each unknown, linear first, world axes."""
    n = len(work) - 2
    for k in range(n):
        u, v, w = work[k, AXIS], work[k, AXIS + 1], work[k, AXIS + 2]
        if chain[k, SLIDE] > 0:
            work[k, JACOBIAN], work[k, JACOBIAN + 1], work[k, JACOBIAN + 2] = u, v, w
            work[k, JACOBIAN + 3], work[k, JACOBIAN + 4], work[k, JACOBIAN + 5] = 0.0, 0.0, 0.0
        else:
            x, y, z = work[n, 9] - work[k, ORIGIN], work[n, 10] - work[k, ORIGIN + 1], work[n, 11] - work[k, ORIGIN + 2]
            work[k, JACOBIAN], work[k, JACOBIAN + 1], work[k, JACOBIAN + 2] = v * z - w * y, w * x - u * z, u * y - v * x
            work[k, JACOBIAN + 3], work[k, JACOBIAN + 4], work[k, JACOBIAN + 5] = u, v, w
    if n > _unknowns(work):  # joints follow others: an unknown's row is the sum of those of its joints
        begun = 0
        for k in range(n):
            leader = int(chain[k, LEADER])
            begins = leader == begun
            begun += 1 if begins else 0
            for r in range(JACOBIAN, JACOBIAN + 6):
                work[leader, r] = chain[k, RATIO] * work[k, r] + (0.0 if begins else work[leader, r])


@njit
def rotation_error(target, asked, work):
    """Fills the rotation vector from the tip to the target; with a free axis the shortest one that lays axis on axis."""
    n = len(work) - 2
    x, y, z, cos = 0.0, 0.0, 0.0, 0.0
    for k in range(3):  # half of the sum of cross products of the columns, and the trace
        if asked == POSE or asked - FREE_X == k:
            x += work[n, 3 + k] * target[6 + k] - work[n, 6 + k] * target[3 + k]
            y += work[n, 6 + k] * target[k] - work[n, k] * target[6 + k]
            z += work[n, k] * target[3 + k] - work[n, 3 + k] * target[k]
            cos += work[n, k] * target[k] + work[n, 3 + k] * target[3 + k] + work[n, 6 + k] * target[6 + k]
    if asked == POSE:
        x, y, z, cos = 0.5 * x, 0.5 * y, 0.5 * z, 0.5 * (cos - 1.0)
    sin = np.sqrt(x * x + y * y + z * z)
    scale = 0.0
    if sin > 1e-9:
        scale = np.arctan2(sin, cos) / sin
    elif cos < 0.0:  # half a turn: about the tip's axis that turns least, or about one across the free axis
        longest, length = (asked - FREE_X + 1) % 3, -2.0
        for k in range(3):
            along = work[n, k] * target[k] + work[n, 3 + k] * target[3 + k] + work[n, 6 + k] * target[6 + k]
            if asked == POSE and along > length:
                longest, length = k, along
        x, y, z = work[n, longest], work[n, 3 + longest], work[n, 6 + longest]
        if asked == POSE:  # the middle between before and after is on the axis
            x, y, z = x + target[longest], y + target[3 + longest], z + target[6 + longest]
        scale = np.pi / np.sqrt(x * x + y * y + z * z)
    work[n, ERROR + 3], work[n, ERROR + 4], work[n, ERROR + 5] = scale * x, scale * y, scale * z


@njit
def _linearise(chain, target, asked, yields, q, work):
    """Fills error, Jacobian, J^T J and J^T e at q. Returns the position's and the rotation's error.

    A rotation counts by its weight, divided by 1 + `yields` times the position's error (up to one reach).
    """
    n, tip = len(q), len(work) - 2
    forward(chain, q, work)
    jacobian(chain, work)
    rows = 6
    if asked == POSITION:
        rows = 3
        work[tip, ERROR + 3], work[tip, ERROR + 4], work[tip, ERROR + 5] = 0.0, 0.0, 0.0
    else:
        rotation_error(target, asked, work)
    off, turned = 0.0, 0.0
    for r in range(3):
        work[tip, ERROR + r] = target[9 + r] - work[tip, 9 + r]
        off += work[tip, ERROR + r] * work[tip, ERROR + r]
        turned += work[tip, ERROR + 3 + r] * work[tip, ERROR + 3 + r]
    off, turned = np.sqrt(off), np.sqrt(turned)
    weight = ROTATION_WEIGHT / (1.0 + yields * min(1.0, off))
    for r in range(3, 6):
        work[tip, ERROR + r] *= weight
    for i in range(n):
        if asked >= FREE_X:  # a turn about the free axis costs nothing
            k = asked - FREE_X
            along = 0.0
            for r in range(3):
                along += work[tip, 3 * r + k] * work[i, JACOBIAN + 3 + r]
            for r in range(3):
                work[i, JACOBIAN + 3 + r] -= along * work[tip, 3 * r + k]
        total = 0.0
        for r in range(rows):
            if r >= 3:
                work[i, JACOBIAN + r] *= weight
            total += work[i, JACOBIAN + r] * work[tip, ERROR + r]
        work[i, GRADIENT] = total
        for j in range(i + 1):
            total = 0.0
            for r in range(rows):
                total += work[i, JACOBIAN + r] * work[j, JACOBIAN + r]
            work[i, NORMAL + j] = total
    return off, turned


@njit
def _bend(chain, asked, work):
    """Takes the chain's own curvature off J^T J: error . d^2 tip / dq_i dq_j, with z_i x dp/dq_j as the derivative for i <= j.

    What is left is the Hessian of half the squared error, for a rotation up to the error's third order. Where joints follow
    others, nothing is taken off.
    """
    n = len(work) - 2
    if n > _unknowns(work):
        return
    for i in range(n):
        if chain[i, SLIDE] > 0:
            continue
        u, v, w = work[i, AXIS], work[i, AXIS + 1], work[i, AXIS + 2]
        for row in range(0, 3 if asked == POSITION else 6, 3):
            share = 1.0 if row == 0 else 0.5
            x, y, z = work[n, ERROR + row], work[n, ERROR + row + 1], work[n, ERROR + row + 2]
            x, y, z = share * (y * w - z * v), share * (z * u - x * w), share * (x * v - y * u)
            for j in range(i, n):
                J = JACOBIAN + row
                work[j, NORMAL + i] -= x * work[j, J] + y * work[j, J + 1] + z * work[j, J + 2]


@njit
def _solve_free(damping, work):
    """(J^T J + damping I) step = gradient for the joints that are not held, by L D L^T; the held ones keep their step.

    Returns whether the matrix is positive definite, which J^T J always is, but not with the chain's own curvature.
    """
    n = _unknowns(work)
    factor, count, definite = NORMAL + n, 0, True
    for i in range(n):
        if work[i, HELD] > 0:
            continue
        total, pivot, c = work[i, GRADIENT], work[i, NORMAL + i] + damping, 0
        for j in range(n):
            if work[j, HELD] > 0:
                total -= work[max(i, j), NORMAL + min(i, j)] * work[j, STEP]
            elif j < i:
                value = work[i, NORMAL + j]
                for k in range(c):
                    value -= work[count, factor + k] * work[c, factor + k]
                work[count, factor + c] = value
                c += 1
        for c in range(count):
            value = work[count, factor + c]
            share = value * work[c, PIVOT]
            work[count, factor + c] = share
            pivot -= share * value
            total -= share * work[c, RHS]
        definite = definite and pivot > 0.5 * damping
        work[count, PIVOT] = 1.0 / max(pivot, 0.5 * damping)
        work[count, RHS] = total
        count += 1
    row = count
    for i in range(n - 1, -1, -1):
        if work[i, HELD] == 0:
            row -= 1
            total = work[row, RHS] * work[row, PIVOT]
            for k in range(row + 1, count):
                total -= work[k, factor + row] * work[k, RHS]
            work[row, RHS] = total
            work[i, STEP] = total
    return definite


@njit
def _bounded_step(chain, damping, q, work):
    """A damped step of q inside the joint bounds: joints pushed out of theirs are held there and the others solved again.

    Returns the largest move of a joint, or -1 where the damping is too small for a step that leads downhill; then none is made.
    """
    n = len(q)
    for i in range(n):
        gradient = work[i, GRADIENT]
        at_bound = (q[i] <= chain[i, LOW] and gradient < 0) or (q[i] >= chain[i, HIGH] and gradient > 0)
        work[i, HELD] = 1.0 if at_bound else 0.0
        work[i, STEP] = 0.0
    for _ in range(BOUND_PASSES):
        if not _solve_free(damping, work):
            return -1.0
        inside = True
        for i in range(n):
            wanted = q[i] + work[i, STEP]
            kept = min(max(wanted, chain[i, LOW]), chain[i, HIGH])
            if work[i, HELD] == 0 and kept != wanted:
                work[i, HELD], work[i, STEP] = 1.0, kept - q[i]
                inside = False
        if inside:
            break
    longest, moved = 0.0, 0.0
    for i in range(n):
        longest = max(longest, abs(work[i, STEP]))
    share = min(1.0, STEP_MAX / max(longest, 1e-300))
    for i in range(n):
        before = q[i]
        q[i] = min(max(before + share * work[i, STEP], chain[i, LOW]), chain[i, HIGH])
        moved = max(moved, abs(q[i] - before))
    return moved


@njit
def _descend(chain, target, asked, off_max, turned_max, q, work):
    """One descent from q, which becomes the best position met. Returns (ok, squared error, steps)."""
    n = len(q)
    best, reference, stalled, steps, ok = np.inf, np.inf, 0, 0, False
    while steps < DESCENT_STEPS and stalled < STALL_STEPS and not ok:
        steps += 1
        off, turned = _linearise(chain, target, asked, 0.0, q, work)
        size = off * off + ROTATION_WEIGHT * ROTATION_WEIGHT * turned * turned
        if steps == 1:
            work[len(work) - 1, FIRST] = size
        ok = off <= off_max and turned <= turned_max
        if ok or size < best:
            best = size
            for i in range(n):
                work[i, BEST] = q[i]
        stalled += 1
        if size < STALL_GAIN * reference:
            reference, stalled = size, 0
        if not ok:
            _bounded_step(chain, DAMPING * min(size, np.sqrt(size)) + DAMPING_FLOOR, q, work)
    for i in range(n):
        q[i] = work[i, BEST]
    return ok, best, steps


@njit
def _random_start(chain, q0, start, seed, q):
    """The random start of a number: within half a turn of q0 and inside the joint bounds or at one.

    A hinge that turns farther would come by every direction twice, and meet its bounds more often.

    The generator is splitmix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number generators", 2014).
    """
    state = np.uint64(seed) ^ (np.uint64(start) * np.uint64(0xD1B54A32D192ED03))
    stretch = STRETCH * (start % 2)
    for i in range(len(q)):
        state += np.uint64(0x9E3779B97F4A7C15)
        x = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        share = np.float64((x ^ (x >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0
        low, high = chain[i, LOW], chain[i, HIGH]
        if high - low > 2 * np.pi:
            middle = min(max(q0[i], low + np.pi), high - np.pi)
            low, high = middle - np.pi, middle + np.pi
        wanted = low + ((1 + 2 * stretch) * share - stretch) * (high - low)
        q[i] = min(max(wanted, low), high)


@njit
def _unwind(chain, q0, q):
    """Takes whole turns off the hinges, or adds them, where that comes nearer to q0 and stays inside the bounds."""
    for i in range(len(q)):
        turn = chain[i, TURN]
        if turn > 0:
            turns = np.round((q0[i] - q[i]) / turn)
            while turns != 0 and not chain[i, LOW] <= q[i] + turns * turn <= chain[i, HIGH]:
                turns -= np.sign(turns)
            q[i] += turns * turn


@njit
def _aim(chain, reach, target, work):
    """The target in reaches, as the last row of `work`; one beyond FARTHEST is pulled in along its line."""
    n = len(chain) - 1
    distance = 0.0
    for k in range(9):
        work[n + 1, k] = target[k]
    for k in range(9, 12):
        work[n + 1, k] = target[k] / reach
        distance += (work[n + 1, k] - chain[0, k]) ** 2
    share = min(1.0, FARTHEST / max(np.sqrt(distance), 1e-300))
    for k in range(9, 12):
        work[n + 1, k] = chain[0, k] + share * (work[n + 1, k] - chain[0, k])
    return work[n + 1]


@njit
def _beyond(chain, target, off_max):
    """Whether the target is farther from the first joint than the arm stretched out, which is one reach."""
    n = len(chain) - 1
    for i in range(n):
        leader = int(chain[i, LEADER])
        if chain[i, SLIDE] > 0 and not chain[leader, HIGH] - chain[leader, LOW] < np.inf:
            return False
    distance = 0.0
    for k in range(9, 12):
        distance += (target[k] - chain[0, k]) ** 2
    return np.sqrt(distance) > 1.0 + 1e-9 + off_max


@njit
def search(chain, reach, targets, asked, off_max, turned_max, q0, first, last, seed, q, tally):
    """For each target descents from the starts `first` to `last` until one is inside the tolerance; beyond reach one is enough.

    Start 0 is q (N, n), the others are random; whole turns are counted from q0. Fills q with the solutions, or else the best
    positions met, and `tally` (N, 4) with 1 for a solution, the start after the last one used, how many steps it took, and
    1 if q is far from q0 although the tip began near the target.
    """
    n = q.shape[1]
    work, trial = scratch(len(chain) - 1, n), np.empty(n)
    for t in range(len(targets)):
        target = _aim(chain, reach, targets[t], work)
        best, steps, start, ok, near = np.inf, 0, first, False, False
        end = first + 1 if _beyond(chain, target, off_max / reach) else last
        while start < end and not ok and not (first < start == HOPELESS_STARTS and best > HOPELESS * HOPELESS):
            if start == 0:
                for i in range(n):
                    trial[i] = q[t, i]
            else:
                _random_start(chain, q0[t], start, seed, trial)
            ok, size, more = _descend(chain, target, asked, off_max / reach, turned_max, trial, work)
            steps += more
            near = near or (start == 0 and work[len(work) - 1, FIRST] < NEAR * NEAR)
            start += 1
            if ok or size < best:
                best = size
                for i in range(n):
                    q[t, i] = trial[i]
        _unwind(chain, q0[t], q[t])
        farthest = 0.0
        for i in range(n):
            farthest = max(farthest, abs(q[t, i] - q0[t, i]))
        tally[t, 0], tally[t, 1], tally[t, 2] = 1 if ok else 0, start, steps
        tally[t, 3] = 1 if near and farthest > JUMP else 0


@njit
def settle(chain, reach, targets, asked, q0, pull, q, sizes):
    """Moves each q to the least squared error plus `pull` times its squared distance from q0; every step makes that smaller.

    Without a pull it ends at the nearest the tip can come to a target it cannot reach. Fills `sizes` (N,) with what is left.
    """
    n = q.shape[1]
    work = scratch(len(chain) - 1, n)
    for t in range(len(targets)):
        target, here = _aim(chain, reach, targets[t], work), q[t]
        best, damping, moved, steps = np.inf, 0.0, np.inf, 0
        while moved > SETTLED and steps < SETTLE_STEPS:
            steps += 1
            off, turned = _linearise(chain, target, asked, 0.0, here, work)
            size = off * off + ROTATION_WEIGHT * ROTATION_WEIGHT * turned * turned
            for i in range(n):
                size += pull * (q0[t, i] - here[i]) ** 2
            if not size <= best:
                damping *= 4.0
                for i in range(n):
                    here[i] = work[i, BEST]
                continue
            if best == np.inf:
                damping = SETTLE_DAMPING * np.sqrt(size)
            elif size < best:
                damping *= 0.25
            best = size
            for i in range(n):
                work[i, BEST] = here[i]
                work[i, GRADIENT] += pull * (q0[t, i] - here[i])
                work[i, NORMAL + i] += pull
            _bend(chain, asked, work)
            moved = _bounded_step(chain, damping + DAMPING_FLOOR, here, work)
            while moved < 0.0:
                damping = max(4.0 * damping, SETTLE_CONVEX * np.sqrt(size))
                moved = _bounded_step(chain, damping + DAMPING_FLOOR, here, work)
        for i in range(n):
            here[i] = work[i, BEST]
        sizes[t] = best


@njit
def objective(chain, reach, target, asked, yields, bends, q, H, gradient, J, work):
    """Half the squared error around q, to second order if it `bends`: fills the Hessian H (n, n), J^T e (n,) and J (6, n).

    Returns the error's size.
    """
    n = len(q)
    _linearise(chain, _aim(chain, reach, target, work), asked, yields, q, work)
    if bends:
        _bend(chain, asked, work)
    size = 0.0
    for r in range(6):
        size += work[len(work) - 2, ERROR + r] ** 2
    for i in range(n):
        gradient[i] = work[i, GRADIENT]
        for r in range(6):
            J[r, i] = work[i, JACOBIAN + r]
        for j in range(n):
            H[i, j] = work[max(i, j), NORMAL + min(i, j)]
    return np.sqrt(size)


@njit
def null_step(asked, wish, low, high, step, work):
    """The part of a wished step (n,) in the null space of J, shortened to its bounds; joints at theirs take no part.

    J is what `objective` left behind. A damping that is all but zero leaves of a wish what changes no error.
    """
    n, rows = len(wish), 3 if asked == POSITION else 6
    for i in range(n):
        work[i, HELD], step[i] = 0.0, 0.0
        for j in range(i + 1):
            total = 0.0
            for r in range(rows):
                total += work[i, JACOBIAN + r] * work[j, JACOBIAN + r]
            work[i, NORMAL + j] = total
    for _ in range(NULL_PASSES):
        for i in range(n):
            work[i, GRADIENT], work[i, STEP] = NULL_DAMPING * wish[i], 0.0
        _solve_free(NULL_DAMPING, work)
        share, free = 1.0, 0
        for i in range(n):
            if work[i, HELD] == 0:
                free += 1
                room = max(0.0, high[i] if work[i, STEP] > 0 else -low[i]) / max(abs(work[i, STEP]), 1e-300)
                share = min(share, room)
                work[i, HELD] = 1.0 if room <= NO_ROOM else 0.0
        if free <= rows:
            return
        if share > NO_ROOM:
            for i in range(n):
                step[i] = share * work[i, STEP]
            return


@njit
def residual(asked, target, position, rotation):
    """How far a tip (3,), (3, 3) is from its target: in the unit of length, and in rad."""
    size, chord = 0.0, 0.0
    for r in range(3):
        size += (position[r] - target[9 + r]) ** 2
        for k in range(3):
            if asked == POSE or asked - FREE_X == k:
                chord += (rotation[r, k] - target[3 * r + k]) ** 2
    return np.sqrt(size), 2.0 * np.arcsin(min(1.0, np.sqrt(chord / (8.0 if asked == POSE else 4.0))))


@njit
def residuals(asked, targets, positions, rotations, off, turned):
    """`residual` of N tips (N, 3), (N, 3, 3): fills (N,) and (N,)."""
    for t in range(len(targets)):
        off[t], turned[t] = residual(asked, targets[t], positions[t], rotations[t])


@njit
def read_transforms(T, targets):
    """Fills targets (N, 12) from homogeneous transforms (N, 4, 4). Returns how many come before the first that is not rigid."""
    for t in range(len(T)):
        skew, bottom = 0.0, abs(T[t, 3, 3] - 1.0)
        for i in range(3):
            for k in range(3):
                targets[t, 3 * i + k] = T[t, i, k]
                dot = T[t, i, 0] * T[t, k, 0] + T[t, i, 1] * T[t, k, 1] + T[t, i, 2] * T[t, k, 2]
                skew = max(skew, abs(dot - (1.0 if i == k else 0.0)))
            targets[t, 9 + i] = T[t, i, 3]
            bottom = max(bottom, abs(T[t, 3, i]))
        x, y, z = T[t, 0, 0], T[t, 0, 1], T[t, 0, 2]
        a, b, c, d, e, f = T[t, 1, 0], T[t, 1, 1], T[t, 1, 2], T[t, 2, 0], T[t, 2, 1], T[t, 2, 2]
        if skew > SKEW or bottom > BOTTOM or x * (b * f - c * e) + y * (c * d - a * f) + z * (a * e - b * d) < 0:
            return t
    return len(T)
