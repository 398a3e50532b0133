"""A strictly convex quadratic program by a dual active-set method, compiled and without allocation.

    minimize x H x / 2 + f x    subject to    lower <= (x, M x) <= upper,

with x (n,), H (n, n) positive definite, M (n, n) without zero rows, and bounds (2n,).

The method is that of Goldfarb and Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
Mathematical Programming 27 (1983), on the least-distance form that daqp uses too (Arnstrom, Bemporad, Axehill, "A dual
active-set solver for embedded quadratic programming using recursive LDL^T updates", IEEE Transactions on Automatic Control 67,
2022). With H = L L^T and y = L^T x, the solution is the point of a polyhedron that is nearest to y0 = -L^-1 f. The normals of
the polyhedron are the rows of (1, M) L^-T, scaled to unit length. The method begins at y0, without active constraints. It adds
the constraint that the point violates most, and drops those whose multipliers become zero on the way, so each point is the
nearest one that its active constraints allow. The normals of the active constraints are kept as an orthogonal factorization,
N^T = T P, with T lower triangular and P orthogonal, which remains accurate if normals are almost parallel.
"""

from __future__ import annotations

import math

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import factorize, take_roots

UNBOUNDED = 1e30  # bounds that the solution does not reach

# Rows (n,) of the work memory: matrices, of which NORMALS has 2n rows and the others n, then vectors.
_FACTOR = 0  # L
_NORMALS = 1
_BASIS = 3  # P: its first rows span the normals of the active constraints
_TRIANGLE = 4  # T: its row j gives the normal of active constraint j in the basis
_MATRICES = 5
_LENGTHS = 0  # (2n,) of the normals before scaling
_TOLERANCES = 2  # (2n,) relative violation, from which a constraint enters; infinite while it is active
_START = 4  # y0
_POINT = 5  # y
_COORDINATES = 6  # in the basis
_RATES = 7  # at which the multipliers decrease, per increase of that of the entering constraint
_MULTIPLIERS = 8  # this and the rows below: of each active constraint
_BOUNDS = 9
_ROWS = 10  # which constraint it is
_VECTORS = 11

_ROUNDING = 1e-12  # violation of a bound, relative to point and bound, that does not count
# As above, for a constraint that contradicts the active ones: the rounding of a point that almost parallel normals determine.
_CONTRADICTION = 1e-9
# Squared sine between a normal and the span of the active ones, below which it counts as dependent: rounding of the normals
# leaves 1e-22 if H has a condition number of 1e10.
_DEPENDENT = 1e-20
_NEGLIGIBLE_RATE = 1e-12  # what rounding leaves of a rate that is zero; normals have unit length
# Changes of the active set per constraint. In exact arithmetic, the method ends by itself; random programs needed at most 3.
_MAX_CHANGES = 10


@njit
def work_size(n):
    """Numbers of work memory for n unknowns."""
    return _MATRICES * n * n + _VECTORS * n


@njit
def _matrix(work, n, k, blocks):
    return work[k * n * n : (k + blocks) * n * n].reshape((blocks * n, n))


@njit
def _vector(work, n, k, blocks):
    start = _MATRICES * n * n
    return work[start + k * n : start + (k + blocks) * n]


@njit
def solve_program(H, f, M, lower, upper, work, x):
    """Solves the program, if it can be solved.

    Args:
        H: (n, n), of which the lower triangle counts.
        f: (n,)
        M: (n, n)
        lower: (2n,) bounds of x and of M x; -`UNBOUNDED` where there is none.
        upper: (2n,)
        work: Scratch, `work_size(n)`.
        x: (n,) result, if there is a solution.

    Returns:
        Whether there is a solution. False if the constraints contradict each other, and after too many changes of the active
        set, which no test found. If a number of the program is not finite, the result is arbitrary.
    """
    n = x.shape[0]
    if not _begin(H, f, M, lower, upper, work, n):
        return False
    point = _vector(work, n, _POINT, 1)
    rates = _vector(work, n, _RATES, 1)
    coordinates = _vector(work, n, _COORDINATES, 1)
    multipliers = _vector(work, n, _MULTIPLIERS, 1)
    lengths = _vector(work, n, _LENGTHS, 2)
    tolerances = _vector(work, n, _TOLERANCES, 2)
    count = 0
    row = -1
    side = 0.0
    multiplier = 0.0  # of the entering constraint
    for _ in range(_MAX_CHANGES * 2 * n):
        if row < 0:
            found = _most_violated(lower, upper, work, n)
            if found == 0:
                _unknowns(work, n, x)
                return True
            row = abs(found) - 1
            side = 1.0 if found > 0 else -1.0
            multiplier = 0.0
        bound = side * (lower[row] if side > 0.0 else upper[row]) / lengths[row]
        normal = _matrix(work, n, _NORMALS, 2)[row]
        independent = _project(work, n, count, normal, side)
        drop = _first_zero_multiplier(rates, multipliers, count)
        shortest = multipliers[drop] / rates[drop] if drop >= 0 else math.inf
        step = math.inf
        violation = bound - side * _dot(normal, point)
        if independent > _DEPENDENT:
            step = violation / independent
        elif drop < 0:
            if not violation < _CONTRADICTION * (math.sqrt(_dot(point, point)) + abs(bound)):
                return False
            tolerances[row] = _CONTRADICTION
            row = -1
            continue
        is_full = step <= shortest
        if not is_full:
            step = shortest
        multiplier += step
        for j in range(count):
            multipliers[j] = max(multipliers[j] - step * rates[j], 0.0)
        if is_full:
            multipliers[count] = multiplier
            _add(work, n, count, row, bound)
            count += 1
            _nearest_point(work, n, count)
            row = -1
        else:
            if independent > _DEPENDENT:
                _move(work, n, count, step, coordinates, point)
            _drop(work, n, count, drop)
            count -= 1
    return False


@njit
def _first_zero_multiplier(rates, multipliers, count):
    """The active constraint whose multiplier becomes zero first, or -1 if none decreases."""
    first = -1
    shortest = math.inf
    for j in range(count):
        if rates[j] > _NEGLIGIBLE_RATE and multipliers[j] < shortest * rates[j]:
            shortest = multipliers[j] / rates[j]
            first = j
    return first


@njit
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit
def _forward(factor, first, x):
    """Replaces x, whose numbers before `first` are zero, by L^-1 x."""
    for i in range(first, x.shape[0]):
        rest = x[i]
        for k in range(first, i):
            rest -= factor[i, k] * x[k]
        x[i] = rest / factor[i, i]


@njit
def _begin(H, f, M, lower, upper, work, n):
    """The least-distance form, with no active constraint; False if a lower bound is above its upper bound."""
    factor = _matrix(work, n, _FACTOR, 1)
    normals = _matrix(work, n, _NORMALS, 2)
    basis = _matrix(work, n, _BASIS, 1)
    lengths = _vector(work, n, _LENGTHS, 2)
    tolerances = _vector(work, n, _TOLERANCES, 2)
    start = _vector(work, n, _START, 1)
    point = _vector(work, n, _POINT, 1)
    for i in range(n):
        for k in range(n):
            factor[i, k] = H[i, k]
    factorize(factor)
    take_roots(factor)
    for i in range(n):
        start[i] = -f[i]
        for k in range(n):
            unit = 1.0 if i == k else 0.0
            normals[i, k] = unit
            basis[i, k] = unit
            normals[n + i, k] = M[i, k]
        _forward(factor, i, normals[i])
        _forward(factor, 0, normals[n + i])
    _forward(factor, 0, start)
    for i in range(n):
        point[i] = start[i]
    for row in range(2 * n):
        lengths[row] = math.sqrt(_dot(normals[row], normals[row]))
        for k in range(n):
            normals[row, k] /= lengths[row]
        tolerances[row] = _ROUNDING
        if lower[row] - upper[row] > _CONTRADICTION * (abs(lower[row]) + abs(upper[row])):
            return False
    return True


@njit
def _unknowns(work, n, x):
    """x = L^-T y."""
    factor = _matrix(work, n, _FACTOR, 1)
    point = _vector(work, n, _POINT, 1)
    for i in range(n - 1, -1, -1):
        rest = point[i]
        for k in range(i + 1, n):
            rest -= factor[k, i] * x[k]
        x[i] = rest / factor[i, i]


@njit
def _most_violated(lower, upper, work, n):
    """The constraint that the point violates most, counted from 1; negative above an upper bound, 0 if there is none."""
    normals = _matrix(work, n, _NORMALS, 2)
    lengths = _vector(work, n, _LENGTHS, 2)
    tolerances = _vector(work, n, _TOLERANCES, 2)
    point = _vector(work, n, _POINT, 1)
    distance = math.sqrt(_dot(point, point))
    largest = 0.0
    found = 0
    for row in range(2 * n):
        if tolerances[row] == math.inf:
            continue
        position = _dot(normals[row], point)
        low = lower[row] / lengths[row]
        high = upper[row] / lengths[row]
        if low - position > max(largest, tolerances[row] * (distance + abs(low))):
            largest = low - position
            found = row + 1
        if position - high > max(largest, tolerances[row] * (distance + abs(high))):
            largest = position - high
            found = -row - 1
    return found


@njit
def _project(work, n, count, normal, side):
    """Coordinates of a signed normal, rates of the multipliers, and the squared length of what the active ones do not span."""
    basis = _matrix(work, n, _BASIS, 1)
    triangle = _matrix(work, n, _TRIANGLE, 1)
    coordinates = _vector(work, n, _COORDINATES, 1)
    rates = _vector(work, n, _RATES, 1)
    independent = 0.0
    for j in range(n):
        coordinates[j] = side * _dot(basis[j], normal)
        if j >= count:
            independent += coordinates[j] * coordinates[j]
    for j in range(count - 1, -1, -1):
        rest = coordinates[j]
        for k in range(j + 1, count):
            rest -= triangle[k, j] * rates[k]
        rates[j] = rest / triangle[j, j]
    return independent


@njit
def _move(work, n, count, step, coordinates, point):
    """Moves the point along the part of the entering normal that the active ones do not span."""
    basis = _matrix(work, n, _BASIS, 1)
    for j in range(count, n):
        for k in range(n):
            point[k] += step * coordinates[j] * basis[j, k]


@njit
def _nearest_point(work, n, count):
    """The point nearest to the start on all active bounds, computed anew: rounding of earlier steps does not add up."""
    basis = _matrix(work, n, _BASIS, 1)
    triangle = _matrix(work, n, _TRIANGLE, 1)
    bounds = _vector(work, n, _BOUNDS, 1)
    start = _vector(work, n, _START, 1)
    point = _vector(work, n, _POINT, 1)
    coordinates = _vector(work, n, _COORDINATES, 1)
    for k in range(n):
        point[k] = 0.0
    for j in range(n):
        if j < count:
            rest = bounds[j]
            for k in range(j):
                rest -= triangle[j, k] * coordinates[k]
            coordinates[j] = rest / triangle[j, j]
        else:
            coordinates[j] = _dot(basis[j], start)
        for k in range(n):
            point[k] += coordinates[j] * basis[j, k]


@njit
def _rotate(a, b, cos, sin, first, end):
    """Replaces two rows by cos a + sin b and cos b - sin a."""
    for k in range(first, end):
        turned = cos * a[k] + sin * b[k]
        b[k] = cos * b[k] - sin * a[k]
        a[k] = turned


@njit
def _add(work, n, count, row, bound):
    """Adds the constraint whose coordinates are known to the active ones."""
    basis = _matrix(work, n, _BASIS, 1)
    triangle = _matrix(work, n, _TRIANGLE, 1)
    coordinates = _vector(work, n, _COORDINATES, 1)
    for j in range(n - 1, count, -1):
        length = math.sqrt(coordinates[j - 1] ** 2 + coordinates[j] ** 2)
        if length > 0.0:
            _rotate(basis[j - 1], basis[j], coordinates[j - 1] / length, coordinates[j] / length, 0, n)
        coordinates[j - 1] = length
    for j in range(count + 1):
        triangle[count, j] = coordinates[j]
    _vector(work, n, _BOUNDS, 1)[count] = bound
    _vector(work, n, _ROWS, 1)[count] = row
    _vector(work, n, _TOLERANCES, 2)[row] = math.inf


@njit
def _drop(work, n, count, dropped):
    """Removes one of the active constraints."""
    basis = _matrix(work, n, _BASIS, 1)
    triangle = _matrix(work, n, _TRIANGLE, 1)
    rows = _vector(work, n, _ROWS, 1)
    _vector(work, n, _TOLERANCES, 2)[int(rows[dropped])] = _ROUNDING
    for k in (_MULTIPLIERS, _BOUNDS, _ROWS):
        vector = _vector(work, n, k, 1)
        for j in range(dropped, count - 1):
            vector[j] = vector[j + 1]
    for j in range(dropped, count - 1):
        for k in range(j + 2):
            triangle[j, k] = triangle[j + 1, k]
    for j in range(dropped, count - 1):
        length = math.sqrt(triangle[j, j] ** 2 + triangle[j, j + 1] ** 2)
        cos = triangle[j, j] / length
        sin = triangle[j, j + 1] / length
        _rotate(basis[j], basis[j + 1], cos, sin, 0, n)
        for k in range(j, count - 1):
            turned = cos * triangle[k, j] + sin * triangle[k, j + 1]
            triangle[k, j + 1] = cos * triangle[k, j + 1] - sin * triangle[k, j]
            triangle[k, j] = turned
