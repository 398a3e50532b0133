"""The compiled solver of path timing: the time-optimal speed along a given motion, by an interior-point method.

A motion q(u) runs at another speed, du/dt = w(u). The unknown is b = w^2, a quadratic B-spline over intervals of length h with
coefficients c. With ' for d/du:

    v = q' w,   a = q'' b + q' b'/2,   j = w (q''' b + 3/2 q'' b' + q' b''/2)

Speed bounds b. A torque has the form of an acceleration: alpha b'/2 + beta b + delta w. The bounds are held at both ends of
the pieces into which nodes cut the motion: the edges of the intervals, and wherever the jerk of q(u) jumps. Each bound
involves three neighbouring coefficients, so that the Hessian of time plus logarithmic barrier has five diagonals, and a Newton
step takes time in proportion to the number of nodes.

That b makes speed and acceleration convex is Verscheure et al., "Time-optimal path tracking for robots: a convex optimization
approach", IEEE Trans. Automatic Control 54(10), 2009; for barriers see Boyd and Vandenberghe, "Convex Optimization", ch. 11.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armctl.core.jit import njit
from armctl.core.validation import Array, IntArray

# Weights of the logarithmic barrier relative to the duration: the first from any start, the first from near the solution, the
# last, and the factor from one to the next.
BARRIER_COLD = 2e-5
BARRIER_WARM = 1e-7
BARRIER_LAST = 5e-9
BARRIER_FACTOR = 0.05
MAX_NEWTON_STEPS = 30
MAX_HALVINGS = 30
SMALLEST_PRODUCT = 1e-200  # a product of rooms is logged before it underflows


class Nodes(NamedTuple):
    """A motion at the N nodes that cut it into pieces, and its bounds there.

    Attributes:
        q1: (N, n) first derivative.
        q2: (N, n) second.
        q3_after: (N - 1, n) third, at the start of each piece.
        q3_before: (N - 1, n) third, at the end of each piece.
        b_max: (N,) greatest square of the path speed.
        j_max: (N, n) greatest jerk.
        alpha: (N, r) with `beta`, `delta`, `low` and `high`: low <= alpha b'/2 + beta b + delta sqrt(b) <= high.
        beta: (N, r).
        delta: (N, r).
        low: (N, r) less than 0.
        high: (N, r) greater than 0.
    """

    q1: Array
    q2: Array
    q3_after: Array
    q3_before: Array
    b_max: Array
    j_max: Array
    alpha: Array
    beta: Array
    delta: Array
    low: Array
    high: Array


class Problem(NamedTuple):
    """Bounds on the coefficients c of b. A point is an end of a piece; g . c is taken over the three of its interval.

    Attributes:
        h: s, the length of an interval.
        points: (P, 4) the weights of c in b at the point, and the greatest b (0: bounded at another point).
        ranges: (P, 3) its interval, and behind its last row in `forces` and in `jerks`.
        forces: (F, 6) rows g0, g1, g2, delta, low, high: low <= g . c + delta w <= high.
        jerks: (J, 4) rows g0, g1, g2, most: |g . c| w <= most.
    """

    h: float
    points: Array
    ranges: IntArray
    forces: Array
    jerks: Array


@njit
def _weights(x, h, weights):
    """The weights of three coefficients in b, b' and b'' at a share x of an interval."""
    weights[0, 0] = 0.5 * (1 - x) * (1 - x)
    weights[0, 1] = 0.5 + x * (1 - x)
    weights[0, 2] = 0.5 * x * x
    weights[1, 0] = (x - 1) / h
    weights[1, 1] = (1 - 2 * x) / h
    weights[1, 2] = x / h
    weights[2, 0] = 1 / (h * h)
    weights[2, 1] = -2 / (h * h)
    weights[2, 2] = 1 / (h * h)


@njit
def _steepest(nodes, k):
    """A bound on |b'| at a node, from the row that bounds it most."""
    b = nodes.b_max[k]
    w = math.sqrt(b)
    steepest = math.inf
    for i in range(nodes.alpha.shape[1]):
        side = 0.5 * abs(nodes.alpha[k, i])
        if side > 0.0:
            bound = max(nodes.high[k, i], -nodes.low[k, i])
            steepest = min(steepest, (bound + abs(nodes.beta[k, i]) * b + abs(nodes.delta[k, i]) * w) / side)
    return steepest


@njit
def _force_rows(nodes, k, steepest, weights, forces, count):
    """Adds the rows of a node that can become active; returns how many rows there are."""
    b = nodes.b_max[k]
    w = math.sqrt(b)
    for i in range(nodes.alpha.shape[1]):
        side = 0.5 * nodes.alpha[k, i]
        beta = nodes.beta[k, i]
        delta = nodes.delta[k, i]
        bound = min(nodes.high[k, i], -nodes.low[k, i])
        others = abs(beta) * b + abs(delta) * w
        if not (others if side == 0.0 else abs(side) * steepest + others) < bound:
            for r in range(3):
                forces[count, r] = side * weights[1, r] + beta * weights[0, r]
            forces[count, 3] = delta
            forces[count, 4] = nodes.low[k, i]
            forces[count, 5] = nodes.high[k, i]
            count += 1
    return count


@njit
def _jerk_rows(nodes, k, q3, steepest, weights, jerks, count):
    """Adds the rows of the jerk at an end of a piece that can become active; returns how many rows there are."""
    b = nodes.b_max[k]
    w = math.sqrt(b)
    n = len(q3)
    bend = math.inf  # a bound on |b''| w
    for i in range(n):
        side = 0.5 * abs(nodes.q1[k, i])
        if side > 0.0:
            others = w * (abs(q3[i]) * b + 1.5 * abs(nodes.q2[k, i]) * steepest)
            bend = min(bend, (nodes.j_max[k, i] + others) / side)
    for i in range(n):
        others = w * (abs(q3[i]) * b + 1.5 * abs(nodes.q2[k, i]) * steepest)
        side = 0.5 * abs(nodes.q1[k, i])
        if not (others if side == 0.0 else side * bend + others) < nodes.j_max[k, i]:
            for r in range(3):
                jerks[count, r] = (
                    q3[i] * weights[0, r] + 1.5 * nodes.q2[k, i] * weights[1, r] + 0.5 * nodes.q1[k, i] * weights[2, r]
                )
            jerks[count, 3] = nodes.j_max[k, i]
            count += 1
    return count


@njit
def bounds(h, interval, begin, end, nodes):
    """The bounds at both ends of every piece, without the rows that no path speed can make active.

    Piece k lies in an interval, from the share `begin[k]` of it to the share `end[k]`.
    """
    pieces = len(interval)
    points = np.zeros((2 * pieces, 4))
    index = np.zeros((2 * pieces, 3), dtype=np.int64)
    forces = np.empty(((pieces + 1) * nodes.alpha.shape[1], 6))
    jerks = np.empty((2 * pieces * nodes.q1.shape[1], 4))
    weights = np.empty((3, 3))
    force_count = 0
    jerk_count = 0
    for p in range(2 * pieces):
        piece = p // 2
        k = piece + p % 2
        _weights(begin[piece] if p % 2 == 0 else end[piece], h, weights)
        steepest = _steepest(nodes, k)
        for r in range(3):
            points[p, r] = weights[0, r]
        if p % 2 == 0 or p == 2 * pieces - 1:
            points[p, 3] = nodes.b_max[k]
            force_count = _force_rows(nodes, k, steepest, weights, forces, force_count)
        q3 = nodes.q3_after[piece] if p % 2 == 0 else nodes.q3_before[piece]
        jerk_count = _jerk_rows(nodes, k, q3, steepest, weights, jerks, jerk_count)
        index[p, 0] = interval[piece]
        index[p, 1] = force_count
        index[p, 2] = jerk_count
    return Problem(h, points, index, forces[:force_count], jerks[:jerk_count])


@njit
def value(c, h, points, index, forces, jerks, barrier):
    """Time plus barrier; infinite outside the bounds."""
    last = len(c) - 2
    time = 0.0
    for m in range(last):
        left = 0.5 * (c[m] + c[m + 1])
        middle = (c[m] + 6 * c[m + 1] + c[m + 2]) / 8
        right = 0.5 * (c[m + 1] + c[m + 2])
        if left <= 0 or middle <= 0 or right <= 0:
            return math.inf
        time += h / 6.0 * (1 / math.sqrt(left) + 4 / math.sqrt(middle) + 1 / math.sqrt(right))
    logs = 0.0
    product = 1.0
    force = 0
    jerk = 0
    for p in range(len(points)):
        m = index[p, 0]
        c0 = c[m]
        c1 = c[m + 1]
        c2 = c[m + 2]
        b = points[p, 0] * c0 + points[p, 1] * c1 + points[p, 2] * c2
        if b <= 0:
            return math.inf
        b_max = points[p, 3]
        if b_max > 0:
            if b >= b_max:
                return math.inf
            product *= 1 - b / b_max
        w = math.sqrt(b)
        while force < index[p, 1]:
            row = forces[force]
            y = row[0] * c0 + row[1] * c1 + row[2] * c2 + row[3] * w
            above = row[5] - y
            below = y - row[4]
            if above <= 0 or below <= 0:
                return math.inf
            width = row[5] - row[4]
            product *= above * below / (width * width)
            if product < SMALLEST_PRODUCT:
                logs += math.log(product)
                product = 1.0
            force += 1
        while jerk < index[p, 2]:
            row = jerks[jerk]
            y = (row[0] * c0 + row[1] * c1 + row[2] * c2) * w / row[3]
            room = 1 - y * y
            if room <= 0:
                return math.inf
            product *= room
            if product < SMALLEST_PRODUCT:
                logs += math.log(product)
                product = 1.0
            jerk += 1
    return time - barrier * (logs + math.log(product))


@njit
def _add(k, g0, g1, g2, slope, curvature, gradient, band):
    """A function of g . c[k : k + 3] with this slope and curvature."""
    gradient[k] += slope * g0
    gradient[k + 1] += slope * g1
    gradient[k + 2] += slope * g2
    band[k, 0] += curvature * g0 * g0
    band[k, 1] += curvature * g0 * g1
    band[k, 2] += curvature * g0 * g2
    band[k + 1, 0] += curvature * g1 * g1
    band[k + 1, 1] += curvature * g1 * g2
    band[k + 2, 0] += curvature * g2 * g2


@njit
def _add_duration(c, h, gradient, band):
    """The duration, by Simpson's rule in each interval."""
    for m in range(len(c) - 2):
        for weight, x0, x1, x2 in ((1.0, 0.5, 0.5, 0.0), (4.0, 0.125, 0.75, 0.125), (1.0, 0.0, 0.5, 0.5)):
            b = x0 * c[m] + x1 * c[m + 1] + x2 * c[m + 2]
            slope = -0.5 * weight * h / 6.0 / (b * math.sqrt(b))
            _add(m, x0, x1, x2, slope, -1.5 * slope / b, gradient, band)


@njit
def assemble(c, h, points, index, forces, jerks, barrier, gradient, band):
    """Gradient and (convex part of the) Hessian; `band[k, d]` is element (k, k + d)."""
    gradient.fill(0.0)
    band.fill(0.0)
    _add_duration(c, h, gradient, band)
    force = 0
    jerk = 0
    for p in range(len(points)):
        m = index[p, 0]
        x0 = points[p, 0]
        x1 = points[p, 1]
        x2 = points[p, 2]
        b = x0 * c[m] + x1 * c[m + 1] + x2 * c[m + 2]
        w = math.sqrt(b)
        if points[p, 3] > 0:
            room = points[p, 3] - b
            _add(m, x0, x1, x2, barrier / room, barrier / (room * room), gradient, band)
        while force < index[p, 1]:
            row = forces[force]
            y = row[0] * c[m] + row[1] * c[m + 1] + row[2] * c[m + 2] + row[3] * w
            damping = 0.5 * row[3] / w
            above = 1 / (row[5] - y)
            below = 1 / (y - row[4])
            slope = barrier * (above - below)
            curvature = barrier * (above * above + below * below)
            _add(m, row[0] + damping * x0, row[1] + damping * x1, row[2] + damping * x2, slope, curvature, gradient, band)
            force += 1
        while jerk < index[p, 2]:
            row = jerks[jerk]
            y = row[0] * c[m] + row[1] * c[m + 1] + row[2] * c[m + 2]
            bound = row[3] / w
            falls = 0.5 * bound / b  # the bound, with b
            for sign in (-1.0, 1.0):
                room = 1 / (bound - sign * y)
                g0 = sign * row[0] + falls * x0
                g1 = sign * row[1] + falls * x1
                g2 = sign * row[2] + falls * x2
                _add(m, g0, g1, g2, barrier * room, barrier * room * room, gradient, band)
            jerk += 1


@njit
def newton_step(gradient, band, step):
    """Solves band . step = -gradient by an LDL^T factorisation in place."""
    count = len(gradient)
    for k in range(count):
        step[k] = -gradient[k]
    for k in range(count):
        for r in (1, 2):
            if k + r < count:
                factor = band[k, r] / band[k, 0]
                for c in range(r, 3):
                    if k + c < count:
                        band[k + r, c - r] -= factor * band[k, c]
                step[k + r] -= factor * step[k]
    for k in range(count - 1, -1, -1):
        total = step[k]
        for c in (1, 2):
            if k + c < count:
                total -= band[k, c] * step[k + c]
        step[k] = total / band[k, 0]


@njit
def solve(p, c, first):
    """The time-optimal path speed from a feasible one; c is changed in place. Returns how many Newton steps it took.

    The first barrier is a share of the time: `BARRIER_COLD` from anywhere, `BARRIER_WARM` from near the solution.
    """
    h, points, index, forces, jerks = p
    count = len(c)
    gradient = np.empty(count)
    band = np.empty((count, 3))
    step = np.empty(count)
    trial = np.empty(count)
    time = h * (count - 2)
    barrier = first * time
    total = 0
    while True:
        cost = value(c, h, points, index, forces, jerks, barrier)
        for _ in range(MAX_NEWTON_STEPS):
            assemble(c, h, points, index, forces, jerks, barrier, gradient, band)
            newton_step(gradient, band, step)
            total += 1
            decrement = 0.0
            for k in range(count):
                decrement -= gradient[k] * step[k]
            if decrement < barrier:
                break
            share = 1.0
            trial_cost = math.inf
            for _ in range(MAX_HALVINGS):
                for k in range(count):
                    trial[k] = c[k] + share * step[k]
                trial_cost = value(trial, h, points, index, forces, jerks, barrier)
                if trial_cost < cost - 1e-4 * share * decrement:
                    break
                share *= 0.5
            if not trial_cost < cost:
                break
            for k in range(count):
                c[k] = trial[k]
            cost = trial_cost
        if barrier <= BARRIER_LAST * time:
            return total
        barrier *= BARRIER_FACTOR
