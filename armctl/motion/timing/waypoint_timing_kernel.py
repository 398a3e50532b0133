"""The compiled search behind `move_through`: times of the sections and velocities and accelerations at the waypoints.

A joint with given states at both ends of a section of given time can cover any displacement between a least and a greatest one.
The greatest is concave in those states: its acceleration rises to its limit, falls along a line c - j t and rises again, and if
that is too fast it cruises at its greatest speed. So a motion is possible exactly if the displacement of every joint in every
section lies between the two, and the fastest one is found by an interior-point method: the sum of the times plus a logarithmic
barrier. A bound involves the two ends of a section and its time only, so that a Newton step factorizes a band matrix, in time
in proportion to the number of waypoints. The Hessian leaves out the curvature of the bounds.

For barriers see Boyd and Vandenberghe, "Convex Optimization", ch. 11; that optimal profiles are such ramps and plateaus is
Pontryagin's principle, e.g. Bryson and Ho, "Applied Optimal Control", ch. 3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armctl.core.jit import njit
from armctl.core.validation import Array

# Weights of all logarithmic barriers together, relative to the duration: the first, the last, the factor from one to the next.
BARRIER_FIRST = 10.0
BARRIER_LAST = 3e-4
BARRIER_FACTOR = 0.2
MAX_NEWTON_STEPS = 30
CENTERED_SHARE = 0.3  # of the barrier: a Newton step that promises less ends the centering
MAX_HALVINGS = 30
MARGIN_RAD = 1e-9  # kept from every displacement, against rounding
RIDGE = 1e-10  # of the Hessian's diagonal, against rounding


class Problem(NamedTuple):
    """Waypoints and what the joints can do.

    Attributes:
        q: (k, n) rad, the waypoints.
        v_max: (n,) rad/s.
        a_max: (n,) rad/s^2.
        j_max: (n,) rad/s^3.
        most: (k, n, 2) rad/s and rad/s^2, the greatest velocity and acceleration at each waypoint; 0 holds it at 0.
    """

    q: Array
    v_max: Array
    a_max: Array
    j_max: Array
    most: Array


@njit
def _line(time, v0, a0, v1, a1, a_max, j_max):
    """The c of the falling line c - j t of the acceleration that goes furthest; NaN if no acceleration makes this change."""
    below = a0
    above = a1 + j_max * time
    if above < below or a1 - j_max * time > a0:
        return math.nan
    flat_top = 2 * a_max - a0  # c above and below which a limit is reached
    flat_bottom = j_max * time - a1 - 2 * a_max
    left = below
    for right in (min(flat_top, flat_bottom), max(flat_top, flat_bottom), above):
        right = min(max(right, below), above)
        top = min(a_max, 0.5 * (right + a0))
        bottom = max(-a_max, 0.5 * (right + a1) - 0.5 * j_max * time)
        change = (2 * (top * top - bottom * bottom) + a1 * a1 - a0 * a0) / (2 * j_max)
        change += a_max * (max(0.0, right - flat_top) - max(0.0, flat_bottom - right)) / j_max
        if change >= v1 - v0:  # between left and right the change of velocity is quadratic in c
            middle = 0.5 * (left + right)
            bend = (0.5 if middle < flat_top else 0.0) - (0.5 if middle > flat_bottom else 0.0)
            slope = top - bottom
            over = j_max * (change - v1 + v0)
            root = slope + math.sqrt(max(slope * slope - 2 * bend * over, 0.0))
            c = right - (2 * over / root if over > 0 else 0.0)
            return c if c >= left - 1e-9 * (1 + abs(left)) else math.nan
        left = right
    return math.nan


@njit
def _lag(u, a, a_max, j_max):
    """How far behind a joint falls on its way to a speed u above its own, with acceleration a; the slopes for u and a."""
    top = math.sqrt(max(j_max * u + 0.5 * a * a, 0.0))
    if top < 1e-12:
        return 0.0, 0.0, 0.0
    flat = 0.0
    if top > a_max:
        top = a_max
        flat = (u - (a_max * a_max - 0.5 * a * a) / j_max) / a_max
    rise = (top - a) / j_max
    lag = top * top / (2 * j_max)
    behind = lag * top / (3 * j_max) + flat * (lag + 0.5 * top * flat)
    behind += rise * (lag + top * flat + rise * (0.5 * top - j_max * rise / 6))
    if flat > 0.0:
        slope = (lag + top * flat + top * rise) / top
    else:
        slope = (lag / j_max + top * rise / j_max + 0.5 * rise * rise + u / j_max) * j_max / (2 * top)
    return behind, slope, slope * a / j_max - u / j_max


@njit
def farthest(time, v0, a0, v1, a1, v_max, a_max, j_max, slopes):
    """The greatest displacement in a time from one velocity and acceleration to another; NaN if there is none.

    `slopes` (5,) becomes its derivatives with respect to the first five arguments.
    """
    c = _line(time, v0, a0, v1, a1, a_max, j_max)
    if math.isnan(c):
        return c
    top = min(a_max, 0.5 * (c + a0))
    bottom = max(-a_max, 0.5 * (c + a1) - 0.5 * j_max * time)
    rise = (top - a0) / j_max
    fall = (top - bottom) / j_max
    end = (a1 - bottom) / j_max
    high = max(0.0, (c + a0 - 2 * a_max) / j_max)
    low = max(0.0, (j_max * time - a1 - 2 * a_max - c) / j_max)
    if top > 0.0 > bottom and v0 + (2 * top * top - a0 * a0) / (2 * j_max) + top * high > v_max:
        before, slopes[1], slope = _lag(v_max - v0, a0, a_max, j_max)
        after, slopes[3], slopes[4] = _lag(v_max - v1, -a1, a_max, j_max)
        slopes[0] = v_max
        slopes[2] = -slope
        return v_max * time - before - after
    q = 0.0
    v = v0
    a = a0
    for h, j in ((rise, j_max), (high, 0.0), (fall, -j_max), (low, 0.0), (end, j_max)):
        q += h * (v + h * (a / 2 + h * j / 6))
        v += h * (a + h * j / 2)
        a += h * j
    middle = rise + high + 0.5 * fall  # of the fall: what an earlier or later line moves
    left = time - middle
    slopes[0] = v1 - 0.5 * j_max * end * end - left * bottom
    slopes[1] = middle
    slopes[2] = rise * (middle - 0.5 * rise)
    slopes[3] = left
    slopes[4] = -end * (left - 0.5 * end)
    return q


@njit
def _room(p, x, times, k, i, sign, slopes):
    """How much further a joint could go in a section, forwards (sign 1) or backwards (-1); NaN if it cannot."""
    v0 = sign * x[k, i, 0]
    a0 = sign * x[k, i, 1]
    v1 = sign * x[k + 1, i, 0]
    a1 = sign * x[k + 1, i, 1]
    way = sign * (p.q[k + 1, i] - p.q[k, i])
    return farthest(times[k], v0, a0, v1, a1, p.v_max[i], p.a_max[i], p.j_max[i], slopes) - way - MARGIN_RAD


@njit
def value(x, times, p, barrier):
    """Time plus barrier; infinite outside the bounds."""
    slopes = np.empty(5)
    logs = 0.0
    for k in range(len(p.q)):
        for i in range(len(p.v_max)):
            for r in range(2):
                if p.most[k, i, r] > 0.0:
                    share = x[k, i, r] / p.most[k, i, r]
                    room = 1.0 - share * share
                    if room <= 0.0:
                        return math.inf
                    logs += math.log(room)
            for sign in (-1.0, 1.0):
                room = 1.0 - (sign * x[k, i, 0] + x[k, i, 1] * x[k, i, 1] / (2 * p.j_max[i])) / p.v_max[i]
                if room <= 0.0:
                    return math.inf
                logs += math.log(room)
                if k < len(times):
                    room = _room(p, x, times, k, i, sign, slopes)
                    if not room > 0.0:
                        return math.inf
                    logs += math.log(room)
    total = 0.0
    for time in times:
        total += time
    return total - barrier * logs


@njit
def _add(rows, slopes, barrier, room, gradient, band):
    """The barrier of a bound with these slopes for the unknowns in these rows, in ascending order."""
    for r in range(len(rows)):
        slope = barrier / room * slopes[r]
        if slope != 0.0:
            gradient[rows[r]] -= slope
            for c in range(r, len(rows)):
                band[rows[r], rows[c] - rows[r]] += slope * slopes[c] / room


@njit
def _add_waypoint(k, i, x, p, barrier, rows, slopes, gradient, band):
    """The barriers on the velocity and acceleration of a joint at a waypoint."""
    j_max = p.j_max[i]
    first = _row(p, k, i)
    for r in range(2):
        y = x[k, i, r]
        most = p.most[k, i, r]
        if most == 0.0:
            band[first + r, 0] += 1.0
        else:
            room = most * most - y * y
            gradient[first + r] += barrier * 2 * y / room
            band[first + r, 0] += barrier * 2 * (most * most + y * y) / (room * room)
    rows[0] = first
    rows[1] = first + 1
    for sign in (-1.0, 1.0):
        room = p.v_max[i] - sign * x[k, i, 0] - x[k, i, 1] * x[k, i, 1] / (2 * j_max)
        slopes[0] = -sign if p.most[k, i, 0] > 0.0 else 0.0
        slopes[1] = -x[k, i, 1] / j_max if p.most[k, i, 1] > 0.0 else 0.0
        _add(rows[:2], slopes, barrier, room, gradient, band)
        if p.most[k, i, 1] > 0.0:
            band[first + 1, 0] += barrier / room / j_max


@njit
def _row(p, k, i):
    """The row of the velocity of a joint at a waypoint; the row of the time of section k is that of joint n."""
    n = len(p.v_max)
    return k * (2 * n + 1) + 2 * i


@njit
def assemble(x, times, p, barrier, gradient, band):
    """Gradient and Hessian, `band[r, d]` its element (r, r + d). Waypoint by waypoint: all joints, and the section after it."""
    gradient.fill(0.0)
    band.fill(0.0)
    n = len(p.v_max)
    slopes = np.empty(5)
    ordered = np.empty(5)
    rows = np.empty(5, dtype=np.int64)
    for k in range(len(p.q)):
        for i in range(n):
            _add_waypoint(k, i, x, p, barrier, rows, ordered, gradient, band)
    for k in range(len(times)):
        rows[2] = _row(p, k, n)
        gradient[rows[2]] += 1.0
        for i in range(n):
            rows[0] = _row(p, k, i)
            rows[1] = rows[0] + 1
            rows[3] = _row(p, k + 1, i)
            rows[4] = rows[3] + 1
            for sign in (-1.0, 1.0):
                room = _room(p, x, times, k, i, sign, slopes)
                ordered[0] = sign * slopes[1] if p.most[k, i, 0] > 0.0 else 0.0
                ordered[1] = sign * slopes[2] if p.most[k, i, 1] > 0.0 else 0.0
                ordered[2] = slopes[0]
                ordered[3] = sign * slopes[3] if p.most[k + 1, i, 0] > 0.0 else 0.0
                ordered[4] = sign * slopes[4] if p.most[k + 1, i, 1] > 0.0 else 0.0
                _add(rows, ordered, barrier, room, gradient, band)
    for r in range(len(band)):
        band[r, 0] *= 1.0 + RIDGE


@njit
def newton_step(gradient, band, step):
    """Solves band . step = -gradient by an LDL^T factorisation in place; returns what the step promises."""
    count, width = band.shape
    for r in range(count):
        step[r] = -gradient[r]
    for r in range(count):
        for d in range(1, min(width, count - r)):
            factor = band[r, d] / band[r, 0]
            if factor != 0.0:
                for e in range(d, min(width, count - r)):
                    band[r + d, e - d] -= factor * band[r, e]
                step[r + d] -= factor * step[r]
    promise = 0.0
    for r in range(count - 1, -1, -1):
        total = step[r]
        for d in range(1, min(width, count - r)):
            total -= band[r, d] * step[r + d]
        step[r] = total / band[r, 0]
        promise -= gradient[r] * step[r]
    return promise


@njit
def _move(x, times, step, share, to_x, to_times):
    """A share of a step from x and times."""
    points, n, _ = x.shape
    for k in range(points):
        row = k * (2 * n + 1)
        for i in range(n):
            to_x[k, i, 0] = x[k, i, 0] + share * step[row + 2 * i]
            to_x[k, i, 1] = x[k, i, 1] + share * step[row + 2 * i + 1]
        if k < len(times):
            to_times[k] = times[k] + share * step[row + 2 * n]


@njit
def solve(p, x, times):
    """The fastest motion from a feasible one; x (k, n, 2) and times (k - 1,) are changed in place."""
    points, n = p.q.shape
    count = points * (2 * n + 1) - 1
    gradient = np.empty(count)
    band = np.empty((count, 2 * n + 3))
    step = np.empty(count)
    to_x = np.empty_like(x)
    to_times = np.empty_like(times)
    barriers = 4.0 * len(times) * n
    total = 0.0
    for time in times:
        total += time
    barrier = BARRIER_FIRST * total / barriers
    while True:
        cost = value(x, times, p, barrier)
        for _ in range(MAX_NEWTON_STEPS):
            assemble(x, times, p, barrier, gradient, band)
            promise = newton_step(gradient, band, step)
            if not promise > CENTERED_SHARE * barrier:
                break
            share = 1.0
            trial = math.inf
            for _ in range(MAX_HALVINGS):
                _move(x, times, step, share, to_x, to_times)
                trial = value(to_x, to_times, p, barrier)
                if trial < cost - 1e-4 * share * promise:
                    break
                share *= 0.5
            if not trial < cost:
                break
            _move(x, times, step, share, x, times)
            cost = trial
        total = 0.0
        for time in times:
            total += time
        if barriers * barrier <= BARRIER_LAST * total:
            return
        barrier *= BARRIER_FACTOR
