"""The compiled solver: Levenberg-Marquardt on a serial chain, joint bounds as an active set, counted random restarts.

The kernels are scalar loops over one small array: numba compiles them in seconds, and they run without allocating memory.
Lengths are in units of the arm's reach, so that one set of constants fits an arm of three centimetres and one of three metres.
All kernels are in one file (hence its length) because they share the layouts of the chain and of the scratch memory.

The damping follows the error as proposed by Sugihara ("Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
method", IEEE Trans. Robotics 27(5), 2011).
"""

from __future__ import annotations

import math

import numpy as np

from armctl.core.jit import njit
from armctl.ik.geometry import MEET, NEITHER, PARALLEL

# A packed chain (k + 1, CHAIN_COLUMNS) has one row per joint and a last row for the tip. Columns: rotation 0-8, translation
# 9-11, whether the joint slides, which of the n unknowns moves it, and the ratio between the two. The first n rows also hold
# the bounds of the unknowns, their period (0 if an unknown has none), and the bounds of a free descent, which unknowns with a
# period do not have, and how far along the joint's axis the point is in which it meets others.
CHAIN_COLUMNS = 21
IS_SLIDE = 12
LOW = 13
HIGH = 14
LEADER = 15
RATIO = 16
PERIOD = 17
FREE_LOW = 18
FREE_HIGH = 19
MEETING_POINT = 20
# If the chain has a closed form, the tip's row holds the structure of the axes, which `armctl.ik.geometry` explains.
AXES_KIND = 12  # of the three special axes: MEET, PARALLEL, or NEITHER without a closed form
AXES_FIRST = 13  # the first of the three
AXES_OTHERS = 14  # (3,) the other joints, in the order of the loop
PAIR_KIND = 17  # of two neighbours among the others: MEET, PARALLEL or NEITHER
PAIR_FIRST = 18  # 0 if these are the first two, 1 if the last two
NO_BRANCH = 27
SINGULAR = 1e-6  # a factor of the Jacobian's determinant, in reaches and sines: below it, its sign means nothing

# Which parts of the tip's pose are constrained. FREE_X + 1 and FREE_X + 2 leave the turn about y and about z free.
POSE = 0
POSITION = 1
FREE_X = 2

# Scratch memory (k + 2, NORMAL + 2 n). There is one row per joint; the first n rows also belong to the unknowns.
ORIGIN = 0  # (3,) of the joint
AXIS = 3  # (3,) of the joint
JACOBIAN = 6  # (6,) derivative of the tip by the unknown
GRADIENT = 12
STEP = 13
AT_BOUND = 14  # 1 while the unknown is fixed at a bound
BEST = 15  # the unknown in the best configuration of a descent
RHS = 16  # right-hand side of the linear system, packed: only free unknowns
PIVOT = 17  # inverse diagonal of its factor, packed
NORMAL = 18  # (n,) a row of the lower triangle of J^T J; behind it (n,) the row of the packed factor
# Then follow a row for the tip (rotation 0-8, translation 9-11, error 12-17) and one for the target (rotation, translation).
ERROR = 12
FIRST_ERROR = 12  # in the target's row: the squared error at the start of a descent

# Rows of what `search` reports, with a column per target.
SEARCH_ROWS = 4
SOLVED = 0
NEXT_START = 1
ITERATIONS = 2
JUMPED = 3

ROTATION_WEIGHT = 1 / 3  # reaches per rad: an error of 3 rad counts like an error of one reach
# A solution that moves a joint by more than 0.3 rad although the tip started within half a reach of the target may be a
# needless change of posture. The caller then looks for a nearer one.
NEAR_TARGET_REACHES = 0.5
JUMP_RAD = 0.3

MAX_DESCENT_STEPS = 60
STALL_STEPS = 3  # a descent ends after so many steps ...
STALL_RATIO = 0.7  # ... in which the squared error stays above this share of what it was
DAMPING = 2e-2
MIN_DAMPING = 1e-12
ACTIVE_SET_PASSES = 3
MAX_STEP = 1.0  # rad, or reaches for a slide joint
# Every other random start lies beyond the bounds by up to this share of their range and is clamped to them: solutions at bounds
# are found faster from there. The others begin with a descent without bounds, turned back into them by whole turns: it passes
# local minima at the bounds. Of 5 000 targets on six-joint chains with narrow bounds, the slowest needs 270 starts, not 3 000.
START_STRETCH = 0.2
# The search gives up if no descent without bounds has solved the target by then: then no configuration does. Of 90 000 targets
# with joints at their bounds, on 16 arms, the slowest needed 54 starts.
MAX_STARTS_WITHOUT_FREE_SOLUTION = 110
# It also gives up if the best error is still this large. Of 760 000 such targets on 38 arms, those that needed more than 280
# starts were nearer by then.
MAX_STARTS_FAR = 300
FAR_ERROR = 0.03  # reaches

EXACT = 1e-10  # reaches or rad: tolerance of the solutions that `find_all` compares with each other
SAME_SOLUTION = 1e-3  # rad, or reaches: at a double root, EXACT leaves 1e-5

NEIGHBOURS = 16  # seeds of one sample of a sweep, of which two may lead to the same solution
LIMIT_ROUNDING = 1e-6  # rad, or reaches: a solution that much outside the limits is moved to the limit

MAX_REFINE_STEPS = 200
REFINE_DAMPING = 0.1  # initial, relative to the error
REFINE_CONVEX_DAMPING = 1e-2  # smallest that makes the Hessian definite, relative to the error
REFINE_MIN_MOVE = 1e-7  # rad, or reaches: a smaller step ends the refinement

MAX_NULL_PASSES = 4
MIN_NULL_SHARE = 0.01  # a null-space step shorter than this share of the desired one frees no joint from its bound
NULL_DAMPING = 1e-10

MAX_SKEW = 1e-6  # of a matrix that is accepted as a rotation
MAX_LAST_ROW_ERROR = 1e-9  # of a homogeneous transform's last row from 0 0 0 1
# A target farther away is moved to this distance on its line: beyond it, the error is so large that a step's gain is lost to
# rounding.
MAX_TARGET_REACHES = 1e3
MAX_SQUARED_LENGTH = 1e140  # m: the square of a greater length may overflow; such numbers are scaled first
MAX_LENGTH = 1.7e308  # m: the errors of a result are finite
MIN_SINE = 1e-9  # below it a rotation's axis is lost to rounding


@njit
def scratch(joints, unknowns):
    """Uninitialized memory for one search. A chain has fewer unknowns than joints if joints follow others."""
    return np.empty((joints + 2, NORMAL + 2 * unknowns))


@njit
def _count_unknowns(work):
    return (work.shape[1] - NORMAL) // 2


@njit
def _times_link(a, b, c, chain, k):
    """The row (a, b, c) of a rotation times the rotation of link k."""
    return (
        a * chain[k, 0] + b * chain[k, 3] + c * chain[k, 6],
        a * chain[k, 1] + b * chain[k, 4] + c * chain[k, 7],
        a * chain[k, 2] + b * chain[k, 5] + c * chain[k, 8],
    )


@njit
def _store(work, row, column, x, y, z):
    work[row, column] = x
    work[row, column + 1] = y
    work[row, column + 2] = z


@njit
def _vector(x, y, z):
    return x, y, z


@njit
def _turned(x, y, cos, sin):
    """Two columns of a rotation's row, turned about the third."""
    return x * cos + y * sin, y * cos - x * sin


@njit
def _squared(position_error, orientation_error, rotation_weight):
    """The weighted squared error, in squared reaches."""
    return position_error * position_error + rotation_weight * rotation_weight * orientation_error * orientation_error


@njit
def forward(chain, q, work):
    """Forward kinematics: fills the joints' origins and axes, and the tip's rotation and translation.

    The rotation so far has the rows (a, b, c), (d, e, f), (g, h, i), the translation is (x, y, z).
    """
    n = len(chain) - 1
    a, b, c = _vector(1.0, 0.0, 0.0)
    d, e, f = _vector(0.0, 1.0, 0.0)
    g, h, i = _vector(0.0, 0.0, 1.0)
    x, y, z = _vector(0.0, 0.0, 0.0)
    for k in range(n + 1):
        r, s, t = _vector(chain[k, 9], chain[k, 10], chain[k, 11])
        x += a * r + b * s + c * t
        y += d * r + e * s + f * t
        z += g * r + h * s + i * t
        a, b, c = _times_link(a, b, c, chain, k)
        d, e, f = _times_link(d, e, f, chain, k)
        g, h, i = _times_link(g, h, i, chain, k)
        if k < n:
            displacement = chain[k, RATIO] * q[int(chain[k, LEADER])]
            if chain[k, IS_SLIDE] > 0:
                x += c * displacement
                y += f * displacement
                z += i * displacement
            else:
                cos = math.cos(displacement)
                sin = math.sin(displacement)
                a, b = _turned(a, b, cos, sin)
                d, e = _turned(d, e, cos, sin)
                g, h = _turned(g, h, cos, sin)
            _store(work, k, ORIGIN, x, y, z)
            _store(work, k, AXIS, c, f, i)
    _store(work, n, 0, a, b, c)
    _store(work, n, 3, d, e, f)
    _store(work, n, 6, g, h, i)
    _store(work, n, 9, x, y, z)


@njit
def jacobian(chain, work):
    """The tip's Jacobian from what `forward` filled: a row of six for each unknown, linear first, world axes."""
    n = len(work) - 2
    for k in range(n):
        u, v, w = _vector(work[k, AXIS], work[k, AXIS + 1], work[k, AXIS + 2])
        if chain[k, IS_SLIDE] > 0:
            _store(work, k, JACOBIAN, u, v, w)
            _store(work, k, JACOBIAN + 3, 0.0, 0.0, 0.0)
        else:
            x = work[n, 9] - work[k, ORIGIN]
            y = work[n, 10] - work[k, ORIGIN + 1]
            z = work[n, 11] - work[k, ORIGIN + 2]
            _store(work, k, JACOBIAN, v * z - w * y, w * x - u * z, u * y - v * x)
            _store(work, k, JACOBIAN + 3, u, v, w)
    if n > _count_unknowns(work):  # joints follow others: an unknown's row is the sum of the rows of its joints
        unknowns_met = 0
        for k in range(n):
            leader = int(chain[k, LEADER])
            is_first = leader == unknowns_met
            unknowns_met += 1 if is_first else 0
            for r in range(JACOBIAN, JACOBIAN + 6):
                work[leader, r] = chain[k, RATIO] * work[k, r] + (0.0 if is_first else work[leader, r])


@njit
def _half_turn(target, constraint, work):
    """The axis and the scale of a rotation vector of pi: about the tip's axis that moves least, or across the free axis."""
    n = len(work) - 2
    column = (constraint - FREE_X + 1) % 3
    if constraint == POSE:
        largest = -2.0
        for k in range(3):
            cos = work[n, k] * target[k] + work[n, 3 + k] * target[3 + k] + work[n, 6 + k] * target[6 + k]
            if cos > largest:
                column = k
                largest = cos
    x, y, z = _vector(work[n, column], work[n, 3 + column], work[n, 6 + column])
    if constraint == POSE:  # the middle between the two directions of that axis is on the axis of rotation
        x += target[column]
        y += target[3 + column]
        z += target[6 + column]
    return x, y, z, np.pi / np.sqrt(x * x + y * y + z * z)


@njit
def rotation_error(target, constraint, work):
    """Fills the rotation vector from the tip to the target; with a free axis the shortest one that aligns the two axes."""
    n = len(work) - 2
    x, y, z = _vector(0.0, 0.0, 0.0)
    cos = 0.0
    for k in range(3):  # half of the sum of cross products of the columns, and the trace
        if constraint == POSE or constraint - FREE_X == k:
            x += work[n, 3 + k] * target[6 + k] - work[n, 6 + k] * target[3 + k]
            y += work[n, 6 + k] * target[k] - work[n, k] * target[6 + k]
            z += work[n, k] * target[3 + k] - work[n, 3 + k] * target[k]
            cos += work[n, k] * target[k] + work[n, 3 + k] * target[3 + k] + work[n, 6 + k] * target[6 + k]
    if constraint == POSE:
        x *= 0.5
        y *= 0.5
        z *= 0.5
        cos = 0.5 * (cos - 1.0)
    sin = np.sqrt(x * x + y * y + z * z)
    scale = 0.0
    if sin > MIN_SINE:
        scale = math.atan2(sin, cos) / sin
    elif cos < 0.0:
        x, y, z, scale = _half_turn(target, constraint, work)
    _store(work, n, ERROR + 3, scale * x, scale * y, scale * z)


@njit
def _remove_free_axis(constraint, i, work):
    """Removes the turn about the free axis from row i of the Jacobian, because it costs nothing."""
    tip = len(work) - 2
    k = constraint - FREE_X
    along = 0.0
    for r in range(3):
        along += work[tip, 3 * r + k] * work[i, JACOBIAN + 3 + r]
    for r in range(3):
        work[i, JACOBIAN + 3 + r] -= along * work[tip, 3 * r + k]


@njit
def _linearize(chain, target, constraint, rotation_weight, position_priority, q, work):
    """Fills error, Jacobian, J^T J and J^T e at q. Returns the errors of position and orientation.

    The weight of the rotation is divided by 1 + `position_priority` times the position error (up to one reach).
    """
    n = len(q)
    tip = len(work) - 2
    forward(chain, q, work)
    jacobian(chain, work)
    rows = 6
    if constraint == POSITION:
        rows = 3
        _store(work, tip, ERROR + 3, 0.0, 0.0, 0.0)
    else:
        rotation_error(target, constraint, work)
    position_error = 0.0
    orientation_error = 0.0
    for r in range(3):
        work[tip, ERROR + r] = target[9 + r] - work[tip, 9 + r]
        position_error += work[tip, ERROR + r] * work[tip, ERROR + r]
        orientation_error += work[tip, ERROR + 3 + r] * work[tip, ERROR + 3 + r]
    position_error = np.sqrt(position_error)
    orientation_error = np.sqrt(orientation_error)
    weight = rotation_weight / (1.0 + position_priority * min(1.0, position_error))
    for r in range(3, 6):
        work[tip, ERROR + r] *= weight
    for i in range(n):
        if constraint >= FREE_X:
            _remove_free_axis(constraint, i, work)
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
    return position_error, orientation_error


@njit
def _add_curvature(chain, constraint, work):
    """Adds the chain's own curvature to J^T J: minus error . d^2 tip / dq_i dq_j, which is z_i x dp/dq_j for i <= j.

    The result is the Hessian of half the squared error, for a rotation up to the error's third order. If joints follow others,
    nothing is added.
    """
    n = len(work) - 2
    if n > _count_unknowns(work):
        return
    for i in range(n):
        if chain[i, IS_SLIDE] > 0:
            continue
        u, v, w = _vector(work[i, AXIS], work[i, AXIS + 1], work[i, AXIS + 2])
        for row in range(0, 3 if constraint == POSITION else 6, 3):
            factor = 1.0 if row == 0 else 0.5
            ex, ey, ez = _vector(work[n, ERROR + row], work[n, ERROR + row + 1], work[n, ERROR + row + 2])
            x = factor * (ey * w - ez * v)
            y = factor * (ez * u - ex * w)
            z = factor * (ex * v - ey * u)
            for j in range(i, n):
                J = JACOBIAN + row
                work[j, NORMAL + i] -= x * work[j, J] + y * work[j, J + 1] + z * work[j, J + 2]


@njit
def _solve_free(damping, work):
    """Solves (J^T J + damping I) step = gradient by L D L^T for the unknowns not at a bound; the others keep their step.

    Returns whether the matrix is positive definite, which J^T J always is, but not with the chain's own curvature.
    """
    n = _count_unknowns(work)
    factor = NORMAL + n
    count = 0
    definite = True
    for i in range(n):
        if work[i, AT_BOUND] > 0:
            continue
        total = work[i, GRADIENT]
        pivot = work[i, NORMAL + i] + damping
        c = 0
        for j in range(n):
            if work[j, AT_BOUND] > 0:
                total -= work[max(i, j), NORMAL + min(i, j)] * work[j, STEP]
            elif j < i:
                value = work[i, NORMAL + j]
                for k in range(c):
                    value -= work[count, factor + k] * work[c, factor + k]
                work[count, factor + c] = value
                c += 1
        for c in range(count):
            value = work[count, factor + c]
            scaled = value * work[c, PIVOT]
            work[count, factor + c] = scaled
            pivot -= scaled * value
            total -= scaled * work[c, RHS]
        definite = definite and pivot > 0.5 * damping
        work[count, PIVOT] = 1.0 / max(pivot, 0.5 * damping)
        work[count, RHS] = total
        count += 1
    row = count
    for i in range(n - 1, -1, -1):
        if work[i, AT_BOUND] == 0:
            row -= 1
            total = work[row, RHS] * work[row, PIVOT]
            for k in range(row + 1, count):
                total -= work[k, factor + row] * work[k, RHS]
            work[row, RHS] = total
            work[i, STEP] = total
    return definite


@njit
def _bounded_step(chain, bounds, damping, q, work):
    """A damped step of q inside the bounds: unknowns pushed out of them are fixed there and the others solved again.

    `bounds` is LOW or FREE_LOW, the column of the lower bounds; the next column holds the upper ones.

    Returns the largest move of a joint, or -1 if the damping is too small for a step that leads downhill; then none is made.
    """
    n = len(q)
    for i in range(n):
        gradient = work[i, GRADIENT]
        pushed_out = (q[i] <= chain[i, bounds] and gradient < 0) or (q[i] >= chain[i, bounds + 1] and gradient > 0)
        work[i, AT_BOUND] = 1.0 if pushed_out else 0.0
        work[i, STEP] = 0.0
    for _ in range(ACTIVE_SET_PASSES):
        if not _solve_free(damping, work):
            return -1.0
        inside = True
        for i in range(n):
            desired = q[i] + work[i, STEP]
            clamped = min(max(desired, chain[i, bounds]), chain[i, bounds + 1])
            if work[i, AT_BOUND] == 0 and clamped != desired:
                work[i, AT_BOUND] = 1.0
                work[i, STEP] = clamped - q[i]
                inside = False
        if inside:
            break
    longest = 0.0
    for i in range(n):
        longest = max(longest, abs(work[i, STEP]))
    factor = min(1.0, MAX_STEP / max(longest, 1e-300))
    moved = 0.0
    for i in range(n):
        before = q[i]
        q[i] = min(max(before + factor * work[i, STEP], chain[i, bounds]), chain[i, bounds + 1])
        moved = max(moved, abs(q[i] - before))
    return moved


@njit
def _descend(chain, bounds, target, constraint, position_tolerance, orientation_tolerance, q, work):
    """One descent from q within the bounds of column `bounds`; q becomes the best configuration met.

    Returns (solved, squared error, steps).
    """
    n = len(q)
    best = np.inf
    reference = np.inf
    stalled = 0
    steps = 0
    solved = False
    while steps < MAX_DESCENT_STEPS and stalled < STALL_STEPS and not solved:
        steps += 1
        position_error, orientation_error = _linearize(chain, target, constraint, ROTATION_WEIGHT, 0.0, q, work)
        size = _squared(position_error, orientation_error, ROTATION_WEIGHT)
        if steps == 1:
            work[len(work) - 1, FIRST_ERROR] = size
        solved = position_error <= position_tolerance and orientation_error <= orientation_tolerance
        if solved or size < best:
            best = size
            for i in range(n):
                work[i, BEST] = q[i]
        stalled += 1
        if size < STALL_RATIO * reference:
            reference = size
            stalled = 0
        if not solved:
            _bounded_step(chain, bounds, DAMPING * min(size, np.sqrt(size)) + MIN_DAMPING, q, work)
    for i in range(n):
        q[i] = work[i, BEST]
    return solved, best, steps


@njit
def _random_start(chain, q0, start, seed, q):
    """The random start of a number: within half a turn of q0 and inside the joint bounds or at one.

    A hinge that turns farther would offer every direction twice, and meet its bounds more often.

    The generator is splitmix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number generators", 2014).
    """
    state = np.uint64(seed) ^ (np.uint64(start) * np.uint64(0xD1B54A32D192ED03))
    stretch = START_STRETCH * (start % 2)
    for i in range(len(q)):
        state += np.uint64(0x9E3779B97F4A7C15)
        x = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        fraction = np.float64((x ^ (x >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0
        low = chain[i, LOW]
        high = chain[i, HIGH]
        if high - low > 2 * np.pi:
            middle = min(max(q0[i], low + np.pi), high - np.pi)
            low = middle - np.pi
            high = middle + np.pi
        drawn = low + ((1 + 2 * stretch) * fraction - stretch) * (high - low)
        q[i] = min(max(drawn, low), high)


@njit
def _turn_inside(chain, q):
    """Turns the hinges by whole turns towards the middle of their bounds, and clamps what is still outside."""
    for i in range(len(q)):
        low = chain[i, LOW]
        high = chain[i, HIGH]
        period = chain[i, PERIOD]
        if period > 0 and high - low < np.inf:
            q[i] += period * np.round((0.5 * (low + high) - q[i]) / period)
        q[i] = min(max(q[i], low), high)


@njit
def _unwind(chain, q0, q):
    """Adds or removes whole turns of the hinges if that is nearer to q0 and inside the bounds. Returns whether q changed."""
    changed = False
    for i in range(len(q)):
        period = chain[i, PERIOD]
        if period > 0:
            turns = np.round((q0[i] - q[i]) / period)
            while turns != 0 and not chain[i, LOW] <= q[i] + turns * period <= chain[i, HIGH]:
                turns -= np.sign(turns)
            q[i] += turns * period
            changed = changed or turns != 0
    return changed


@njit
def _aim(chain, reach, target, work):
    """Writes the target in reaches to the last row of `work`; one beyond MAX_TARGET_REACHES is moved nearer on its line."""
    n = len(chain) - 1
    for k in range(9):
        work[n + 1, k] = target[k]
    largest = 0.0
    for k in range(9, 12):
        largest = max(largest, abs(target[k]))
    shrink = 1.0 if largest < MAX_SQUARED_LENGTH else 1.0 / largest
    distance = 0.0
    for k in range(9, 12):
        work[n + 1, k] = shrink * target[k] / reach
        along = work[n + 1, k] - shrink * chain[0, k]
        distance += along * along
    factor = min(1.0 / shrink, MAX_TARGET_REACHES / max(np.sqrt(distance), 1e-300))
    for k in range(9, 12):
        work[n + 1, k] = chain[0, k] + factor * (work[n + 1, k] - shrink * chain[0, k])


@njit
def _beyond(chain, target, position_tolerance):
    """Whether the target is farther from the first joint than the arm stretched out, which is one reach."""
    n = len(chain) - 1
    for i in range(n):
        leader = int(chain[i, LEADER])
        if chain[i, IS_SLIDE] > 0 and not chain[leader, HIGH] - chain[leader, LOW] < np.inf:
            return False
    distance = 0.0
    for k in range(9, 12):
        along = target[k] - chain[0, k]
        distance += along * along
    return np.sqrt(distance) > 1.0 + 1e-9 + position_tolerance


@njit
def _is_promising(starts, free_solved, squared_error):
    """Whether a search goes on after so many starts, with the best squared error so far."""
    if starts >= MAX_STARTS_WITHOUT_FREE_SOLUTION and not free_solved:
        return False
    return starts < MAX_STARTS_FAR or squared_error < FAR_ERROR * FAR_ERROR


@njit
def _huge_distance(target, position):
    """The distance of a target whose square overflows, in the unit of length."""
    largest = 0.0
    for r in range(3):
        largest = max(largest, abs(position[r] - target[9 + r]))
    total = 0.0
    for r in range(3):
        share = (position[r] - target[9 + r]) / largest
        total += share * share
    return min(largest * np.sqrt(total), MAX_LENGTH)


@njit
def residual(constraint, target, position, rotation):
    """The errors of a tip (3,), (3, 3): in the unit of length, and in rad."""
    squared = 0.0
    squared_chord = 0.0
    for r in range(3):
        along = position[r] - target[9 + r]
        squared += along * along
        for k in range(3):
            if constraint == POSE or constraint - FREE_X == k:
                chord = rotation[r, k] - target[3 * r + k]
                squared_chord += chord * chord
    distance = np.sqrt(squared) if squared < np.inf else _huge_distance(target, position)
    return distance, 2.0 * math.asin(min(1.0, np.sqrt(squared_chord / (8.0 if constraint == POSE else 4.0))))


@njit
def _axis(k, work):
    return work[k, AXIS], work[k, AXIS + 1], work[k, AXIS + 2]


@njit
def _meeting_point(chain, k, work):
    """The point on a joint's axis in which it meets others."""
    along = chain[k, MEETING_POINT]
    return (
        work[k, ORIGIN] + along * work[k, AXIS],
        work[k, ORIGIN + 1] + along * work[k, AXIS + 1],
        work[k, ORIGIN + 2] + along * work[k, AXIS + 2],
    )


@njit
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit
def _volume(a, b, c):
    """The triple product a . (b x c)."""
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


@njit
def _sign_code(value):
    if abs(value) < SINGULAR:
        return 0
    return 1 if value > 0 else 2


@njit
def _branch(chain, work):
    """The signs of the factors of the Jacobian's determinant, as a number that `geometry.branch_names` names.

    `forward` filled `work`. If two of the other three axes meet or are parallel there are three factors, else two. Of an arm
    with seven joints it is the Jacobian without the joint that is swept.
    """
    tip = len(chain) - 1
    kind = int(chain[tip, AXES_KIND])
    if kind == NEITHER:
        return NO_BRANCH
    a = int(chain[tip, AXES_FIRST])
    f = int(chain[tip, AXES_OTHERS])
    g = int(chain[tip, AXES_OTHERS + 1])
    h = int(chain[tip, AXES_OTHERS + 2])
    pair_kind = int(chain[tip, PAIR_KIND])
    is_first_pair = chain[tip, PAIR_FIRST] == 0
    third = 1.0
    if kind == MEET:
        special = _volume(_axis(a, work), _axis(a + 1, work), _axis(a + 2, work))
        point = _meeting_point(chain, a, work)
        u = f if is_first_pair else g
        v = g if is_first_pair else h
        w = h if is_first_pair else f
        to_u = _minus(point, _meeting_point(chain, u, work))
        to_v = _minus(point, _meeting_point(chain, v, work))
        to_w = _minus(point, _meeting_point(chain, w, work))
        if pair_kind == MEET:
            second = _volume(to_u, _axis(u, work), _axis(v, work))
            third = _volume(to_u, _axis(w, work), to_w)
        elif pair_kind == PARALLEL:
            second = _volume(_axis(u, work), to_u, to_v)
            third = _volume(_axis(u, work), _axis(w, work), to_w)
        else:  # the volume of axis x arm of the three joints, by (a x b) x (c x d) = b [a c d] - a [b c d]
            across = _volume(_axis(u, work), _axis(v, work), to_v)
            along = _volume(to_u, _axis(v, work), to_v)
            second = across * _volume(to_u, _axis(w, work), to_w) - along * _volume(_axis(u, work), _axis(w, work), to_w)
    else:
        point = _meeting_point(chain, a, work)
        axis = _axis(a, work)
        special = _volume(
            axis, _minus(_meeting_point(chain, a + 1, work), point), _minus(_meeting_point(chain, a + 2, work), point)
        )
        middle = _meeting_point(chain, g, work)
        turn_f = _volume(_axis(g, work), _axis(f, work), axis)
        turn_h = _volume(_axis(g, work), _axis(h, work), axis)
        height_f = _volume(axis, _axis(f, work), _minus(middle, _meeting_point(chain, f, work)))
        height_h = _volume(axis, _axis(h, work), _minus(middle, _meeting_point(chain, h, work)))
        if pair_kind == NEITHER:
            second = turn_f * height_h - turn_h * height_f
        elif is_first_pair == (pair_kind == MEET):
            second = height_h
            third = turn_f
        else:
            second = height_f
            third = turn_h
    return 9 * _sign_code(special) + 3 * _sign_code(second) + _sign_code(third)


@njit
def branches(chain, q, codes):
    """Fills codes (N,) with the branches of the configurations (N, n)."""
    work = scratch(len(chain) - 1, q.shape[1])
    for t in range(len(q)):
        forward(chain, q[t], work)
        codes[t] = _branch(chain, work)


@njit
def _search_target(chain, reach, target, constraint, tolerance, orientation_tolerance, q0, first, last, seed, q, trial, work):
    """Descends from the starts `first` to `last` until one is solved; beyond the reach one start is enough.

    Start 0 is q, the others are random; whole turns are counted from q0. Fills q with the solution, or else the best
    configuration met. `tolerance` is in reaches. Returns whether q is a solution, the start after the last one used, the steps,
    whether q is far from q0 although the tip began near the target, and whether `work` holds the tip at q.
    """
    n = len(q)
    _aim(chain, reach, target, work)
    target = work[len(chain)]
    best = np.inf
    steps = 0
    start = first
    solved = False
    near = False
    free_solved = False
    end = first + 1 if _beyond(chain, target, tolerance) else last
    while start < end and not solved and _is_promising(start - first, free_solved, best):
        if start == 0:
            for i in range(n):
                trial[i] = q[i]
        else:
            _random_start(chain, q0, start, seed, trial)
        if start > 0 and start % 2 == 0:
            solved, size, more = _descend(chain, FREE_LOW, target, constraint, tolerance, orientation_tolerance, trial, work)
            steps += more
            free_solved = free_solved or solved
            _turn_inside(chain, trial)
        solved, size, more = _descend(chain, LOW, target, constraint, tolerance, orientation_tolerance, trial, work)
        steps += more
        near = near or (start == 0 and work[len(work) - 1, FIRST_ERROR] < NEAR_TARGET_REACHES * NEAR_TARGET_REACHES)
        start += 1
        if solved or size < best:
            best = size
            for i in range(n):
                q[i] = trial[i]
    unwound = _unwind(chain, q0, q)
    farthest = 0.0
    for i in range(n):
        farthest = max(farthest, abs(q[i] - q0[i]))
    return solved, start, steps, near and farthest > JUMP_RAD, solved and not unwound


@njit
def search(chain, reach, targets, constraint, position_tolerance, orientation_tolerance, q0, first, last, seed, q, report):
    """`_search_target` for each of N targets (N, 12), from q (N, n): fills q, and `report` (SEARCH_ROWS, N)."""
    n = q.shape[1]
    work = scratch(len(chain) - 1, n)
    trial = np.empty(n)
    tolerance = position_tolerance / reach
    for t in range(len(targets)):
        solved, start, steps, jumped, _ = _search_target(
            chain,
            reach,
            targets[t],
            constraint,
            tolerance,
            orientation_tolerance,
            q0[t],
            first,
            last,
            seed,
            q[t],
            trial,
            work,
        )
        report[SOLVED, t] = 1 if solved else 0
        report[NEXT_START, t] = start
        report[ITERATIONS, t] = steps
        report[JUMPED, t] = 1 if jumped else 0


@njit
def search_one(chain, reach, rows, constraint, position_tolerance, orientation_tolerance, q0, last, seed, q):
    """`search` for one target (4, 3), from q (n,), and the errors of its answer: all of a `solve_ik` call that succeeds.

    It allocates its own scratch memory, so that threads share nothing. Fills q. Returns
    whether q is a solution, whether it is far from q0 although the tip began near the target, the start after the last one
    used, the steps, the errors of position, m, and orientation, rad, and the branch.
    """
    n = len(q)
    joints = len(chain) - 1
    work = scratch(joints, n)
    trial = np.empty(n)
    target = rows.reshape(12)
    solved, start, steps, jumped, tip_is_known = _search_target(
        chain,
        reach,
        target,
        constraint,
        position_tolerance / reach,
        orientation_tolerance,
        q0,
        0,
        last,
        seed,
        q,
        trial,
        work,
    )
    if not tip_is_known:
        forward(chain, q, work)
    branch = _branch(chain, work)
    for k in range(9, 12):
        work[joints, k] *= reach
    errors = residual(constraint, target, work[joints, 9:12], work[joints, :9].reshape(3, 3))
    return solved, jumped, start, steps, errors[0], errors[1], branch


@njit
def _is_known(chain, q, known, count):
    """Whether q is one of the first `count` rows of `known`, up to whole turns of the hinges."""
    for k in range(count):
        same = True
        for i in range(len(q)):
            difference = abs(q[i] - known[k, i])
            if difference >= SAME_SOLUTION and chain[i, PERIOD] > 0:
                difference = abs(difference - chain[i, PERIOD] * np.round(difference / chain[i, PERIOD]))
            if difference >= SAME_SOLUTION:
                same = False
                break
        if same:
            return True
    return False


@njit
def _add_solution(chain, target, constraint, tolerance, orientation_tolerance, q, known, count, work):
    """Descends from q without bounds and appends the solution to `known` if it is new. Returns their number and the steps."""
    solved, _, steps = _descend(chain, FREE_LOW, target, constraint, EXACT, EXACT, q, work)
    if not solved:  # next to a singularity convergence is slow: an answer within the tolerances is a solution all the same
        position_error, orientation_error = _linearize(chain, target, constraint, ROTATION_WEIGHT, 0.0, q, work)
        solved = position_error <= tolerance and orientation_error <= orientation_tolerance
    if solved and count < len(known) and not _is_known(chain, q, known, count):
        for i in range(len(q)):
            known[count, i] = q[i]
        return count + 1, steps
    return count, steps


@njit
def _tip_errors(q, chain, target, reach, work):
    """The errors of the tip at q, m and rad, for a target (12,) in m."""
    n = len(chain) - 1
    forward(chain, q, work)
    for k in range(9, 12):
        work[n, k] *= reach
    return residual(POSE, target, work[n, 9:12], work[n, :9].reshape(3, 3))


@njit
def _wind_inside(chain, q0, q):
    """Turns the hinges by whole turns to the positions nearest to q0 inside the bounds; returns whether q is inside then.

    What is outside by rounding is moved to the bounds.
    """
    for i in range(len(q)):
        low = chain[i, LOW] - LIMIT_ROUNDING
        high = chain[i, HIGH] + LIMIT_ROUNDING
        period = chain[i, PERIOD]
        if period > 0:
            if abs(q0[i] - q[i]) > 0.5 * period:
                q[i] += period * np.round((q0[i] - q[i]) / period)
            if q[i] > high:
                q[i] -= period * np.ceil((q[i] - high) / period)
            if q[i] < low:
                q[i] += period * np.ceil((low - q[i]) / period)
        if not low <= q[i] <= high:
            return False
        q[i] = min(max(q[i], chain[i, LOW]), chain[i, HIGH])
    return True


@njit
def polish(chain, reach, rows, position_tolerance, orientation_tolerance, q0, seeds, q, details):
    """Refines the seeds (M, n) of a target (4, 3), and keeps those that are solutions inside the bounds, nearest first.

    The seeds are nearly exact, and equal ones are at most NEIGHBOURS apart. Fills q (M, n), and `details` (3, M): the errors in
    m and rad, and the branches. Returns how many solutions there are, the steps, and how many seeds led to no solution.
    """
    n = seeds.shape[1]
    joints = len(chain) - 1
    work = scratch(joints, n)
    trial = np.empty(n)
    kept = np.empty((len(seeds), n + 4))  # configuration, errors, branch, squared distance
    target = rows.reshape(12)
    count = 0
    steps = 0
    lost = 0
    for s in range(len(seeds)):
        for i in range(n):
            trial[i] = seeds[s, i]
        position_error, orientation_error = _tip_errors(trial, chain, target, reach, work)
        moved = False
        if position_error > EXACT * reach or orientation_error > EXACT:
            _aim(chain, reach, target, work)
            goal = work[len(chain)]
            _, _, more = _descend(chain, FREE_LOW, goal, POSE, EXACT, EXACT, trial, work)
            steps += more
            moved = True
        if not _wind_inside(chain, q0, trial):
            continue
        for i in range(n):
            moved = moved or trial[i] != seeds[s, i]
        if moved:
            position_error, orientation_error = _tip_errors(trial, chain, target, reach, work)
        if not (position_error <= position_tolerance and orientation_error <= orientation_tolerance):
            lost += 1
            continue
        first = max(0, count - NEIGHBOURS)
        if _is_known(chain, trial, kept[first:count], count - first):
            continue
        square = 0.0
        for i in range(n):
            kept[count, i] = trial[i]
            away = trial[i] - q0[i]
            square += away * away
        kept[count, n] = position_error
        kept[count, n + 1] = orientation_error
        kept[count, n + 2] = _branch(chain, work)
        kept[count, n + 3] = square
        count += 1
    for k in range(count):
        nearest = 0
        for j in range(1, count):
            if kept[j, n + 3] < kept[nearest, n + 3]:
                nearest = j
        kept[nearest, n + 3] = np.inf
        for i in range(n):
            q[k, i] = kept[nearest, i]
        for r in range(3):
            details[r, k] = kept[nearest, n + r]
    return count, steps, lost


@njit
def find_all(
    chain,
    whole,
    reach,
    target,
    constraint,
    position_tolerance,
    orientation_tolerance,
    q0,
    begin,
    bound,
    patience,
    quarters,
    seed,
    known,
):
    """Fills `known` (M, n) with distinct solutions, without regard to the bounds of hinges; their whole turns are arbitrary.

    Descends from each row of `begin` (B, n); then from random configurations, in turns inside the bounds of `chain` and of
    `whole`, whose hinges turn fully; and with `quarters` from every solution with one joint turned by quarters. It ends with
    `bound` solutions, or when `patience` random starts in a row found nothing new. Returns the numbers of solutions, starts
    and steps.
    """
    n = len(q0)
    work = scratch(len(chain) - 1, n)
    trial = np.empty(n)
    _aim(chain, reach, target, work)
    goal = work[len(chain)]
    tolerance = position_tolerance / reach
    count = 0
    starts = 0
    steps = 0
    fruitless = 0
    turned = 0  # solutions whose joints have been turned
    drawn = 0
    bound = min(bound, len(known))
    while count < bound and (fruitless < patience or (quarters and turned < count)):
        before = count
        if starts < len(begin):
            trial[:] = begin[starts]
            starts += 1
            count, more = _add_solution(chain, goal, constraint, tolerance, orientation_tolerance, trial, known, count, work)
            steps += more
        elif fruitless < patience:
            drawn += 1
            _random_start(chain if drawn % 2 == 1 else whole, q0, 2 * drawn, seed, trial)
            starts += 1
            count, more = _add_solution(chain, goal, constraint, tolerance, orientation_tolerance, trial, known, count, work)
            steps += more
            fruitless = 0 if count > before else fruitless + 1
        else:
            for i in range(n):
                for quarter in range(1, 4):
                    if chain[i, PERIOD] > 0:
                        trial[:] = known[turned]
                        trial[i] += 0.25 * quarter * chain[i, PERIOD]
                        starts += 1
                        count, more = _add_solution(
                            chain, goal, constraint, tolerance, orientation_tolerance, trial, known, count, work
                        )
                        steps += more
            turned += 1
            fruitless = 0 if count > before else fruitless
    return count, starts, steps


@njit
def refine(chain, reach, targets, constraint, rotation_weight, q0, pull, q, sizes):
    """Moves each q to a minimum of the squared error plus `pull` times its squared distance from q0; every step decreases that.

    Without a pull it ends where the tip is nearest to a target it cannot reach. Fills `sizes` (N,) with what is left.
    """
    n = q.shape[1]
    work = scratch(len(chain) - 1, n)
    for t in range(len(targets)):
        _aim(chain, reach, targets[t], work)
        target = work[len(chain)]
        here = q[t]
        best = np.inf
        damping = 0.0
        moved = np.inf
        steps = 0
        while moved > REFINE_MIN_MOVE and steps < MAX_REFINE_STEPS:
            steps += 1
            position_error, orientation_error = _linearize(chain, target, constraint, rotation_weight, 0.0, here, work)
            size = _squared(position_error, orientation_error, rotation_weight)
            for i in range(n):
                away = q0[t, i] - here[i]
                size += pull * (away * away)
            if not size <= best:
                damping *= 4.0
                for i in range(n):
                    here[i] = work[i, BEST]
                continue
            if best == np.inf:
                damping = REFINE_DAMPING * np.sqrt(size)
            elif size < best:
                damping *= 0.25
            best = size
            for i in range(n):
                work[i, BEST] = here[i]
                work[i, GRADIENT] += pull * (q0[t, i] - here[i])
                work[i, NORMAL + i] += pull
            _add_curvature(chain, constraint, work)
            moved = _bounded_step(chain, LOW, damping + MIN_DAMPING, here, work)
            while moved < 0.0:
                damping = max(4.0 * damping, REFINE_CONVEX_DAMPING * np.sqrt(size))
                moved = _bounded_step(chain, LOW, damping + MIN_DAMPING, here, work)
        for i in range(n):
            here[i] = work[i, BEST]
        sizes[t] = best


@njit
def objective(chain, reach, target, constraint, position_priority, second_order, q, H, gradient, J, work):
    """Half the squared error around q, optionally to second order: fills the Hessian H (n, n), J^T e (n,) and J (6, n).

    Returns the norm of the error.
    """
    n = len(q)
    _aim(chain, reach, target, work)
    _linearize(chain, work[len(chain)], constraint, ROTATION_WEIGHT, position_priority, q, work)
    if second_order:
        _add_curvature(chain, constraint, work)
    size = 0.0
    for r in range(6):
        error = work[len(work) - 2, ERROR + r]
        size += error * error
    for i in range(n):
        gradient[i] = work[i, GRADIENT]
        for r in range(6):
            J[r, i] = work[i, JACOBIAN + r]
        for j in range(n):
            H[i, j] = work[max(i, j), NORMAL + min(i, j)]
    return np.sqrt(size)


@njit
def null_step(constraint, desired, low, high, step, work):
    """The part of a desired step (n,) in the null space of J, shortened to its bounds; joints at theirs take no part.

    J is what `objective` left behind. With the tiny damping only that part of the desired step is left that changes no error.
    """
    n = len(desired)
    rows = 3 if constraint == POSITION else 6
    for i in range(n):
        work[i, AT_BOUND] = 0.0
        step[i] = 0.0
        for j in range(i + 1):
            total = 0.0
            for r in range(rows):
                total += work[i, JACOBIAN + r] * work[j, JACOBIAN + r]
            work[i, NORMAL + j] = total
    for _ in range(MAX_NULL_PASSES):
        for i in range(n):
            work[i, GRADIENT] = NULL_DAMPING * desired[i]
            work[i, STEP] = 0.0
        _solve_free(NULL_DAMPING, work)
        share = 1.0
        free = 0
        for i in range(n):
            if work[i, AT_BOUND] == 0:
                free += 1
                room = max(0.0, high[i] if work[i, STEP] > 0 else -low[i]) / max(abs(work[i, STEP]), 1e-300)
                share = min(share, room)
                work[i, AT_BOUND] = 1.0 if room <= MIN_NULL_SHARE else 0.0
        if free <= rows:
            return
        if share > MIN_NULL_SHARE:
            for i in range(n):
                step[i] = share * work[i, STEP]
            return


@njit
def manipulabilities(chain, reach, rows, q, out):
    """Fills out (N,) with sqrt(det(J J^T)) at each q (N, n), lengths in the unit of `reach`; J has 3 rows (a point) or 6.

    With fewer unknowns than rows it is sqrt(det(J^T J)) (Yoshikawa, "Manipulability of robotic mechanisms", Int. J. Robotics
    Research 4(2), 1985).
    """
    n = q.shape[1]
    work = scratch(len(chain) - 1, n)
    size = min(n, rows)
    A = np.empty((size, size))
    J = np.empty((rows, n))
    for t in range(len(q)):
        forward(chain, q[t], work)
        jacobian(chain, work)
        for k in range(rows):
            for i in range(n):
                J[k, i] = work[i, JACOBIAN + k] * (reach if k < 3 else 1.0)
        for i in range(size):
            for j in range(i + 1):
                A[i, j] = 0.0
                for k in range(max(n, rows)):
                    A[i, j] += J[i, k] * J[j, k] if n >= rows else J[k, i] * J[k, j]
        product = 1.0
        for i in range(size):  # L D L^T in place
            for j in range(i):
                for k in range(j):
                    A[i, j] -= A[i, k] * A[j, k] * A[k, k]
                A[i, j] /= max(A[j, j], 1e-300)
            for k in range(i):
                A[i, i] -= A[i, k] * A[i, k] * A[k, k]
            product *= max(A[i, i], 0.0)
        out[t] = np.sqrt(product)


@njit
def residuals(constraint, targets, positions, rotations, position_errors, orientation_errors):
    """`residual` of N tips (N, 3), (N, 3, 3): fills (N,) and (N,)."""
    for t in range(len(targets)):
        errors = residual(constraint, targets[t], positions[t], rotations[t])
        position_errors[t] = errors[0]
        orientation_errors[t] = errors[1]


@njit
def _determinant(T):
    """Of the rotation of a homogeneous transform (4, 4)."""
    x = T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1]
    y = T[1, 2] * T[2, 0] - T[1, 0] * T[2, 2]
    z = T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0]
    return T[0, 0] * x + T[0, 1] * y + T[0, 2] * z


@njit
def read_transforms(T, targets):
    """Fills targets (N, 12) from homogeneous transforms (N, 4, 4). Returns how many come before the first that is not rigid."""
    for t in range(len(T)):
        skew = 0.0
        last_row_error = abs(T[t, 3, 3] - 1.0)
        for i in range(3):
            for k in range(3):
                targets[t, 3 * i + k] = T[t, i, k]
                dot = T[t, i, 0] * T[t, k, 0] + T[t, i, 1] * T[t, k, 1] + T[t, i, 2] * T[t, k, 2]
                skew = max(skew, abs(dot - (1.0 if i == k else 0.0)))
            targets[t, 9 + i] = T[t, i, 3]
            last_row_error = max(last_row_error, abs(T[t, 3, i]))
        if skew > MAX_SKEW or last_row_error > MAX_LAST_ROW_ERROR or _determinant(T[t]) < 0:
            return t
    return len(T)
