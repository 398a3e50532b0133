"""The compiled solver of path timing: the time-optimal speed along a given motion, by an interior-point method.

A motion q(u) runs at another speed, du/dt = w(u). The unknown is b = w^2, a quadratic B-spline over intervals of length h with
coefficients c. With ' for d/du:

    v = q' w,   a = q'' b + q' b'/2,   j = w (q''' b + 3/2 q'' b' + q' b''/2)

Speed bounds b. A torque has the form of an acceleration: alpha b'/2 + beta b + delta w. All bounds are held at the edges of the
intervals, that on jerk on either side. Each involves three neighbouring coefficients, so that the Hessian of time plus
logarithmic barrier has five diagonals, and a Newton step takes time in proportion to the number of intervals.

That b makes speed and acceleration convex is Verscheure et al., "Time-optimal path tracking for robots: a convex optimization
approach", IEEE Trans. Automatic Control 54(10), 2009; for barriers see Boyd and Vandenberghe, "Convex Optimization", ch. 11.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armctl.core.jit import njit
from armctl.core.validation import Array

# Weights of the logarithmic barrier relative to the duration: the first from any start, the first from near the solution, the
# last, and the factor from one to the next.
BARRIER_COLD = 1e-4
BARRIER_WARM = 1e-6
BARRIER_LAST = 1e-9
BARRIER_FACTOR = 0.2
MAX_NEWTON_STEPS = 12
MAX_HALVINGS = 30


class Problem(NamedTuple):
    """A motion at the edges of intervals, and its bounds there.

    Attributes:
        h: s, the length of an interval.
        b_max: (N,) greatest square of the path speed.
        q1: (N, n) first derivative.
        q2: (N, n) second.
        q3: (N, n) third.
        j_max: (N, n) greatest jerk.
        alpha: (N, r) with `beta`, `delta`, `low` and `high`: low <= alpha b'/2 + beta b + delta sqrt(b) <= high.
        beta: (N, r).
        delta: (N, r).
        low: (N, r) less than 0.
        high: (N, r) greater than 0.
    """

    h: float
    b_max: Array
    q1: Array
    q2: Array
    q3: Array
    j_max: Array
    alpha: Array
    beta: Array
    delta: Array
    low: Array
    high: Array


@njit
def value(c, p, barrier):
    """Time plus barrier; infinite outside the bounds."""
    last = len(c) - 2
    logs = 0.0
    time = 0.0
    for e in range(last + 1):
        b = 0.5 * (c[e] + c[e + 1])
        first = (c[e + 1] - c[e]) / p.h
        room = p.b_max[e] - b
        if room <= 0 or b <= 0:
            return math.inf
        w = math.sqrt(b)
        logs += math.log(room / p.b_max[e])
        time += (1.0 if e == 0 or e == last else 2.0) * p.h / (6.0 * w)
        for i in range(p.alpha.shape[1]):
            y = 0.5 * p.alpha[e, i] * first + p.beta[e, i] * b + p.delta[e, i] * w
            above = p.high[e, i] - y
            below = y - p.low[e, i]
            if above <= 0 or below <= 0:
                return math.inf
            logs += math.log(above * below / (p.high[e, i] * p.high[e, i]))
        for m in range(max(e - 1, 0), min(e, last - 1) + 1):
            second = (c[m + 2] - 2 * c[m + 1] + c[m]) / (p.h * p.h)
            for i in range(p.q1.shape[1]):
                y = (p.q3[e, i] * b + 1.5 * p.q2[e, i] * first + 0.5 * p.q1[e, i] * second) * w / p.j_max[e, i]
                if abs(y) >= 1.0:
                    return math.inf
                logs += math.log(1.0 - y * y)
    for m in range(last):
        b = (c[m] + 6 * c[m + 1] + c[m + 2]) / 8
        if b <= 0:
            return math.inf
        time += 4.0 * p.h / (6.0 * math.sqrt(b))
    return time - barrier * logs


@njit
def assemble(c, p, barrier, gradient, band):
    """Gradient and (convex part of the) Hessian; `band[k, d]` is element (k, k + d)."""
    last = len(c) - 2
    gradient[:] = 0.0
    band[:] = 0.0
    g = np.zeros(3)
    for e in range(last + 1):
        b = 0.5 * (c[e] + c[e + 1])
        first = (c[e + 1] - c[e]) / p.h
        w = math.sqrt(b)
        share = (1.0 if e == 0 or e == last else 2.0) * p.h / 6.0
        room = p.b_max[e] - b
        g[0] = 0.5
        g[1] = 0.5
        g[2] = 0.0
        _add(e, g, -0.5 * share / (b * w) + barrier / room, 0.75 * share / (b * b * w) + barrier / room**2, gradient, band)
        for i in range(p.alpha.shape[1]):
            y = 0.5 * p.alpha[e, i] * first + p.beta[e, i] * b + p.delta[e, i] * w
            side = 0.5 * p.alpha[e, i] / p.h
            middle = 0.5 * (p.beta[e, i] + 0.5 * p.delta[e, i] / w)
            g[0] = middle - side
            g[1] = middle + side
            above = p.high[e, i] - y
            below = y - p.low[e, i]
            _add(e, g, barrier / above - barrier / below, barrier / above**2 + barrier / below**2, gradient, band)
        for m in range(max(e - 1, 0), min(e, last - 1) + 1):
            second = (c[m + 2] - 2 * c[m + 1] + c[m]) / (p.h * p.h)
            at = e - m  # the edge is the interval's left or right one
            for i in range(p.q1.shape[1]):
                y = p.q3[e, i] * b + 1.5 * p.q2[e, i] * first + 0.5 * p.q1[e, i] * second
                bound = p.j_max[e, i] / w
                slope = -0.25 * p.j_max[e, i] / (w * b)
                bend = 0.5 * p.q1[e, i] / (p.h * p.h)
                side = 1.5 * p.q2[e, i] / p.h
                for sign in (-1.0, 1.0):
                    room = bound - sign * y
                    g[0] = sign * bend
                    g[1] = -2 * sign * bend
                    g[2] = sign * bend
                    g[at] += sign * (0.5 * p.q3[e, i] - side) - slope
                    g[at + 1] += sign * (0.5 * p.q3[e, i] + side) - slope
                    _add(m, g, barrier / room, barrier / room**2, gradient, band)
    for m in range(last):
        b = (c[m] + 6 * c[m + 1] + c[m + 2]) / 8
        w = math.sqrt(b)
        share = 4.0 * p.h / 6.0
        g[0] = 0.125
        g[1] = 0.75
        g[2] = 0.125
        _add(m, g, -0.5 * share / (b * w), 0.75 * share / (b * b * w), gradient, band)


@njit
def _add(k, g, slope, curvature, gradient, band):
    """A function of g . c[k : k + 3] with this slope and curvature."""
    for r in range(3):
        if g[r] != 0.0:
            gradient[k + r] += slope * g[r]
            for d in range(3 - r):
                band[k + r, d] += curvature * g[r] * g[r + d]


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
    count = len(c)
    gradient = np.empty(count)
    band = np.empty((count, 3))
    step = np.empty(count)
    trial = np.empty(count)
    time = p.h * (count - 2)
    barrier = first * time
    total = 0
    while True:
        cost = value(c, p, barrier)
        for _ in range(MAX_NEWTON_STEPS):
            assemble(c, p, barrier, gradient, band)
            newton_step(gradient, band, step)
            total += 1
            decrement = -np.dot(gradient, step)
            if decrement < barrier:
                break
            share = 1.0
            trial_cost = math.inf
            for _ in range(MAX_HALVINGS):
                trial[:] = c + share * step
                trial_cost = value(trial, p, barrier)
                if trial_cost < cost - 1e-4 * share * decrement:
                    break
                share *= 0.5
            if not trial_cost < cost:
                break
            c[:] = trial
            cost = trial_cost
        if barrier <= BARRIER_LAST * time:
            return total
        barrier *= BARRIER_FACTOR
