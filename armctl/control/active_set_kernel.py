"""A strictly convex quadratic program by a dual active-set method, compiled and without allocation.

    minimize x H x / 2 + f x    subject to    lower <= (x, M x) <= upper,

with x (n,), H (n, n) positive definite, M (n, n) without zero rows, and bounds (2n,).

The method is that of Goldfarb and Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
Mathematical Programming 27 (1983), on the least-distance form that daqp uses too (Arnström, Bemporad, Axehill, "A dual
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
_LOW = 0  # (2n,) bounds, scaled with the normals
_HIGH = 2  # (2n,)
_TOLERANCES = 4  # (2n,) relative violation, from which a constraint enters; infinite while it is active
_START = 6  # y0
_POINT = 7  # y
_COORDINATES = 8  # in the basis
_RATES = 9  # at which the multipliers decrease, per increase of that of the entering constraint
_ACTIVE = 10  # (3, n): of each active constraint
_VECTORS = 13

# Rows of _ACTIVE.
_MULTIPLIER = 0
_BOUND = 1
_ROW = 2  # which constraint it is

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
    factor = _matrix(work, n, _FACTOR, 1)
    normals = _matrix(work, n, _NORMALS, 2)
    low = _vector(work, n, _LOW, 2)
    high = _vector(work, n, _HIGH, 2)
    start = _vector(work, n, _START, 1)
    point = _vector(work, n, _POINT, 1)
    if not _begin(H, f, M, lower, upper, factor, normals, low, high, start):
        return False
    if not _find_nearest(normals, low, high, start, work, point):
        return False
    for i in range(n - 1, -1, -1):  # x = L^-T y
        rest = point[i]
        for k in range(i + 1, n):
            rest -= factor[k, i] * x[k]
        x[i] = rest / factor[i, i]
    return True


@njit
def _begin(H, f, M, lower, upper, factor, normals, low, high, start):
    """The least-distance form of the program; False if a lower bound is above its upper bound."""
    n = f.shape[0]
    for i in range(n):
        for k in range(n):
            factor[i, k] = H[i, k]
    factorize(factor)
    take_roots(factor)
    for i in range(n):
        start[i] = -f[i]
        for k in range(n):
            normals[i, k] = 1.0 if i == k else 0.0
            normals[n + i, k] = M[i, k]
        _forward(factor, i, normals[i])
        _forward(factor, 0, normals[n + i])
    _forward(factor, 0, start)
    for row in range(2 * n):
        scale = 1.0 / math.sqrt(_dot(normals[row], normals[row]))
        for k in range(n):
            normals[row, k] *= scale
        low[row] = scale * lower[row]
        high[row] = scale * upper[row]
        if lower[row] - upper[row] > _CONTRADICTION * (abs(lower[row]) + abs(upper[row])):
            return False
    return True


@njit
def _forward(factor, first, x):
    """Replaces x, whose numbers before `first` are zero, by L^-1 x."""
    for i in range(first, x.shape[0]):
        rest = x[i]
        for k in range(first, i):
            rest -= factor[i, k] * x[k]
        x[i] = rest / factor[i, i]


@njit
def _find_nearest(normals, low, high, start, work, point):
    """The point of the polyhedron that is nearest to the start; False if there is none."""
    n = point.shape[0]
    basis = _matrix(work, n, _BASIS, 1)
    triangle = _matrix(work, n, _TRIANGLE, 1)
    tolerances = _vector(work, n, _TOLERANCES, 2)
    coordinates = _vector(work, n, _COORDINATES, 1)
    rates = _vector(work, n, _RATES, 1)
    active = _vector(work, n, _ACTIVE, 3).reshape((3, n))
    _begin_without_constraints(start, point, basis, tolerances)
    count = 0
    entering = 0
    multiplier = 0.0  # of the entering constraint
    is_exact = True
    for _ in range(_MAX_CHANGES * 2 * n):
        if entering == 0:
            entering = _most_violated(normals, low, high, tolerances, point)
            multiplier = 0.0
        if entering == 0:
            if is_exact:
                return True
            _set_point(basis, triangle, active[_BOUND], start, count, coordinates, point)
            is_exact = True
            continue
        row = abs(entering) - 1
        side = 1.0 if entering > 0 else -1.0
        bound = side * (low[row] if entering > 0 else high[row])
        violation = bound - side * _dot(normals[row], point)
        independent = _project(basis, triangle, normals[row], side, count, coordinates, rates)
        drop = _first_zero_multiplier(rates, active[_MULTIPLIER], count)
        if drop < 0 and independent == 0.0:
            if not violation < _CONTRADICTION * (math.sqrt(_dot(point, point)) + abs(bound)):
                return False
            tolerances[row] = _CONTRADICTION
            entering = 0
            continue
        full = violation / independent if independent > 0.0 else math.inf
        step = full if drop < 0 else min(full, active[_MULTIPLIER, drop] / rates[drop])
        multiplier += step
        _decrease_multipliers(rates, active[_MULTIPLIER], count, step)
        _move(basis, coordinates, count, step, point)
        is_exact = False
        if step < full:
            tolerances[int(active[_ROW, drop])] = _ROUNDING
            _drop(basis, triangle, active, count, drop)
            count -= 1
        else:
            tolerances[row] = math.inf
            _add(basis, triangle, coordinates, count, rates)
            active[_MULTIPLIER, count] = multiplier
            active[_BOUND, count] = bound
            active[_ROW, count] = row
            count += 1
            entering = 0
    return False


@njit
def _begin_without_constraints(start, point, basis, tolerances):
    n = point.shape[0]
    for i in range(n):
        point[i] = start[i]
        tolerances[i] = _ROUNDING
        tolerances[n + i] = _ROUNDING
        for k in range(n):
            basis[i, k] = 1.0 if i == k else 0.0


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
def _decrease_multipliers(rates, multipliers, count, step):
    for j in range(count):
        multipliers[j] = max(multipliers[j] - step * rates[j], 0.0)


@njit
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit
def _most_violated(normals, low, high, tolerances, point):
    """The constraint that the point violates most, counted from 1; negative above an upper bound, 0 if there is none."""
    distance = math.sqrt(_dot(point, point))
    largest = 0.0
    found = 0
    for row in range(normals.shape[0]):
        if tolerances[row] == math.inf:
            continue
        position = _dot(normals[row], point)
        below = low[row] - position
        above = position - high[row]
        if below > max(largest, tolerances[row] * (distance + abs(low[row]))):
            largest = below
            found = row + 1
        if above > max(largest, tolerances[row] * (distance + abs(high[row]))):
            largest = above
            found = -row - 1
    return found


@njit
def _project(basis, triangle, normal, side, count, coordinates, rates):
    """Coordinates of a signed normal, rates of the multipliers, and the squared length of what the active ones do not span."""
    independent = 0.0
    for j in range(normal.shape[0]):
        coordinates[j] = side * _dot(basis[j], normal)
        if j >= count:
            independent += coordinates[j] * coordinates[j]
    if not independent > _DEPENDENT:
        independent = 0.0
        for j in range(count, normal.shape[0]):
            coordinates[j] = 0.0
    for j in range(count - 1, -1, -1):
        rest = coordinates[j]
        for k in range(j + 1, count):
            rest -= triangle[k, j] * rates[k]
        rates[j] = rest / triangle[j, j]
    return independent


@njit
def _move(basis, coordinates, count, step, point):
    """Moves the point along the part of the entering normal that the active ones do not span."""
    n = point.shape[0]
    for j in range(count, n):
        for k in range(n):
            point[k] += step * coordinates[j] * basis[j, k]


@njit
def _set_point(basis, triangle, bounds, start, count, coordinates, point):
    """The point nearest to the start on all active bounds, computed anew: the rounding of the steps does not remain."""
    n = point.shape[0]
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
def _add(basis, triangle, coordinates, count, product):
    """Adds a constraint with known coordinates to the active ones, by a Householder reflection of the other basis vectors."""
    n = coordinates.shape[0]
    square = 0.0
    for j in range(count, n):
        square += coordinates[j] * coordinates[j]
    length = -math.copysign(math.sqrt(square), coordinates[count])
    for j in range(count):
        triangle[count, j] = coordinates[j]
    triangle[count, count] = length
    coordinates[count] -= length
    scale = 1.0 / (length * coordinates[count])
    for k in range(n):
        product[k] = 0.0
    for j in range(count, n):
        for k in range(n):
            product[k] += coordinates[j] * basis[j, k]
    for j in range(count, n):
        for k in range(n):
            basis[j, k] += scale * coordinates[j] * product[k]


@njit
def _drop(basis, triangle, active, count, dropped):
    """Removes one of the active constraints, and makes the triangle one again by plane rotations."""
    n = basis.shape[0]
    for j in range(dropped, count - 1):
        for k in range(3):
            active[k, j] = active[k, j + 1]
        for k in range(j + 2):
            triangle[j, k] = triangle[j + 1, k]
    for j in range(dropped, count - 1):
        length = math.sqrt(triangle[j, j] * triangle[j, j] + triangle[j, j + 1] * triangle[j, j + 1])
        cos = triangle[j, j] / length
        sin = triangle[j, j + 1] / length
        for k in range(n):
            turned = cos * basis[j, k] + sin * basis[j + 1, k]
            basis[j + 1, k] = cos * basis[j + 1, k] - sin * basis[j, k]
            basis[j, k] = turned
        for k in range(j, count - 1):
            turned = cos * triangle[k, j] + sin * triangle[k, j + 1]
            triangle[k, j + 1] = cos * triangle[k, j + 1] - sin * triangle[k, j]
            triangle[k, j] = turned
