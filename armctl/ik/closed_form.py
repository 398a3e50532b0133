"""The closed form of six hinges of which three in a row meet in a point or are parallel, compiled.

E_k are the joints' motions about their axes in the zero configuration, and X is the target's pose times the inverse of the
tip's pose in the zero configuration: E_1 E_2 ... E_6 = X. This loop may begin at any joint: an axis moved from its front to its
end is transformed by the inverse of X. So the three special joints (a, b, c) can be anywhere, and with the other three
(f, g, h) in the order of the loop

    (E_a E_b E_c)^-1 = E_f E_g E_h X^-1.

If the axes a, b, c meet in a point, both sides leave this point where it is; if they are parallel, both sides leave their
direction and the heights along it as they are. These are three equations for the other three joints, which have two to four
solutions. Then E_a E_b E_c is known, and each time two configurations of the special joints remain. The first three equations
are a quadratic equation after another if two neighbours of f, g, h meet or are parallel, otherwise a quartic one.

Sources: Pieper, "The kinematics of manipulators under computer control", 1968; Elias and Wen, "IK-Geo: unified robot inverse
kinematics using subproblem decomposition", Mech. Mach. Theory 209, 2025, whose subproblems 1 to 6 are used here.

Seven hinges are swept: one of them is held at sampled positions, and the other six have a closed form.

All kernels are in one file (hence its length) because they share the layout of the scratch memory.
"""

from __future__ import annotations

import math

import numpy as np

from armctl.core.jit import njit
from armctl.ik.geometry import FIRST, HELD, HIGH, KIND, LOW, MEET, NEITHER, PAIR_FIRST, PAIR_KIND, PARALLEL, POINT
from armctl.ik.kernel import polish

MAX_SOLUTIONS = 16  # that `_solve_six` writes: eight for the first three joints, and two for each of them
WORK = 14  # numbers: the roots of a polynomial of degree four, and two equations of five numbers
TINY = 1e-9  # reaches, or sine of an angle: a circle with that radius is a point
NEAR_DOUBLE_ROOT = 1e-6  # of a cosine from 1: the two roots are closer than 3e-3 rad, and may be one
MAX_ROOT_ITERATIONS = 60
ROOT_TOLERANCE = 1e-14
UNIT_CIRCLE_BAND = 1e-3  # of a root's modulus from 1: rounding moves a double root off the circle, as a pair
NEWTON_ITERATIONS = 3
EXACT_ROOT = 1e-10  # relative


@njit
def _vector(array, row, column):
    return array[row, column], array[row, column + 1], array[row, column + 2]


@njit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit
def _add(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit
def _times(factor, a):
    return factor * a[0], factor * a[1], factor * a[2]


@njit
def _across(axis, a):
    """The part of a vector across an axis."""
    return _minus(a, _times(_dot(axis, a), axis))


@njit
def _turn(axis, cos, sin, a):
    """A vector turned about an axis by an angle with this cosine and sine (Rodrigues)."""
    along = (1.0 - cos) * _dot(axis, a)
    side = _cross(axis, a)
    return (
        along * axis[0] + cos * a[0] + sin * side[0],
        along * axis[1] + cos * a[1] + sin * side[1],
        along * axis[2] + cos * a[2] + sin * side[2],
    )


@njit
def _move(axis, point, cos, sin, a):
    """A point turned about the line through `point`."""
    return _add(point, _turn(axis, cos, sin, _minus(a, point)))


@njit
def _rotate(rotation, a):
    return _dot(rotation[0], a), _dot(rotation[1], a), _dot(rotation[2], a)


@njit
def _rotate_back(rotation, a):
    return _add(_add(_times(a[0], rotation[0]), _times(a[1], rotation[1])), _times(a[2], rotation[2]))


@njit
def _angle_between(axis, a, b, preferred):
    """The angle about an axis from a to b, and whether it is undetermined because one of them is on the axis."""
    u = _across(axis, a)
    v = _across(axis, b)
    if min(_dot(u, u), _dot(v, v)) < TINY * TINY:
        return preferred, True
    return math.atan2(_dot(axis, _cross(u, v)), _dot(u, v)), False


@njit
def _linear_roots(a, b, d, slack, preferred):
    """The angles with a cos + b sin = d: their number, the two, and whether the number is doubtful.

    A cosine up to 1 + slack counts as 1. If every angle is a solution, the preferred one is returned.
    """
    radius = np.sqrt(a * a + b * b)
    if radius < TINY:
        return (1 if abs(d) <= TINY + slack else 0), preferred, preferred, True
    cos = d / radius
    middle = math.atan2(b, a)
    doubtful = abs(cos) > 1.0 - NEAR_DOUBLE_ROOT and abs(cos) <= 1.0 + max(slack, NEAR_DOUBLE_ROOT)
    if abs(cos) > 1.0:
        if abs(cos) > 1.0 + slack:
            return 0, middle, middle, doubtful
        angle = middle if cos > 0 else middle + np.pi
        return 1, angle, angle, True
    half = math.acos(cos)
    return 2, middle + half, middle - half, doubtful


@njit
def _product(a, b):
    """Of two complex numbers, each (real, imaginary). Those of Python and of NumPy have other bits than those of numba."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


@njit
def _quotient(a, b):
    """Of two complex numbers; the divisor's smaller part is divided by the larger one (Smith, Algorithm 116, 1962)."""
    if abs(b[0]) >= abs(b[1]):
        ratio = b[1] / b[0]
        divisor = b[0] + b[1] * ratio
        return (a[0] + a[1] * ratio) / divisor, (a[1] - a[0] * ratio) / divisor
    ratio = b[0] / b[1]
    divisor = b[0] * ratio + b[1]
    return (a[0] * ratio + a[1]) / divisor, (a[1] * ratio - a[0]) / divisor


@njit
def _sum(a, b):
    return a[0] + b[0], a[1] + b[1]


@njit
def _scaled(factor, a):
    return factor * a[0], factor * a[1]


@njit
def _modulus(a):
    return abs(complex(a[0], a[1]))


@njit
def _polynomial_roots(a3, a2, a1, a0, z):
    """Fills z (4, 2) with the complex roots of z^4 + a3 z^3 + a2 z^2 + a1 z + a0, all at once (Aberth)."""
    for i in range(4):
        z[i, 0] = (0.9 + 0.1 * i) * math.cos(0.4 + 1.57 * i)
        z[i, 1] = (0.9 + 0.1 * i) * math.sin(0.4 + 1.57 * i)
    for _ in range(MAX_ROOT_ITERATIONS):
        largest = 0.0
        for i in range(4):
            x = (z[i, 0], z[i, 1])
            value = _sum(_product(_sum(_product(_sum(_product(_sum(x, a3), x), a2), x), a1), x), a0)
            slope = _sum(_scaled(4.0, x), _scaled(3.0, a3))
            slope = _sum(_product(_sum(_product(slope, x), _scaled(2.0, a2)), x), a1)
            if slope[0] == 0 and slope[1] == 0:
                slope = (1e-300, 0.0)
            newton = _quotient(value, slope)
            others = (0.0, 0.0)
            for j in range(4):
                away = (x[0] - z[j, 0], x[1] - z[j, 1])
                if j != i and (away[0] != 0 or away[1] != 0):
                    others = _sum(others, _quotient((1.0, 0.0), away))
            repelled = _product(newton, others)
            repelled = (1.0 - repelled[0], -repelled[1])
            step = newton
            if repelled[0] != 0 or repelled[1] != 0:
                step = _quotient(newton, repelled)
            x = (x[0] - step[0], x[1] - step[1])
            z[i, 0] = x[0]
            z[i, 1] = x[1]
            largest = max(largest, _modulus(step) / max(_modulus(x), 1e-300))
        if largest < ROOT_TOLERANCE:
            break


@njit
def _trigonometric_roots(k0, k1, k2, k3, k4, slack, roots):
    """The angles with k0 + k1 cos t + k2 sin t + k3 cos 2t + k4 sin 2t = 0: their number, and whether it is doubtful.

    They are the roots on the unit circle of a polynomial of degree four.
    """
    scale = abs(k0) + abs(k1) + abs(k2) + abs(k3) + abs(k4)
    if scale < TINY * TINY:
        return 0, True
    if abs(k3) + abs(k4) < 1e-12 * scale:
        count, first, second, doubtful = _linear_roots(k1, k2, -k0, slack, 0.0)
        roots[0] = first
        roots[1] = second
        return count, doubtful
    lead = (0.5 * k3, -0.5 * k4)
    z = np.empty((4, 2))
    _polynomial_roots(
        _quotient((0.5 * k1, -0.5 * k2), lead),
        _quotient((k0, 0.0), lead),
        _quotient((0.5 * k1, 0.5 * k2), lead),
        _quotient((0.5 * k3, 0.5 * k4), lead),
        z,
    )
    count = 0
    doubtful = False
    for i in range(4):
        if not abs(_modulus((z[i, 0], z[i, 1])) - 1.0) < UNIT_CIRCLE_BAND:
            continue
        for j in range(i):
            doubtful = doubtful or _modulus((z[i, 0] - z[j, 0], z[i, 1] - z[j, 1])) < 2.0 * UNIT_CIRCLE_BAND
        angle = math.atan2(z[i, 1], z[i, 0])
        best = angle
        least = np.inf
        for _ in range(NEWTON_ITERATIONS):
            c = math.cos(angle)
            s = math.sin(angle)
            value = k0 + k1 * c + k2 * s + k3 * (c * c - s * s) + 2.0 * k4 * s * c
            slope = -k1 * s + k2 * c - 4.0 * k3 * s * c + 2.0 * k4 * (c * c - s * s)
            if abs(value) < least:
                least = abs(value)
                best = angle
            if abs(slope) < TINY * scale:
                break
            angle -= value / slope
        if least <= max(EXACT_ROOT, slack) * scale:
            roots[count] = best
            count += 1
    return count, doubtful


@njit
def _quadratic_form(form, p, q, r, factor):
    """Adds factor (p + q cos t + r sin t)^2 to the coefficients (1, cos t, sin t, cos 2t, sin 2t)."""
    return (
        form[0] + factor * (p * p + 0.5 * (q * q + r * r)),
        form[1] + factor * 2.0 * p * q,
        form[2] + factor * 2.0 * p * r,
        form[3] + factor * 0.5 * (q * q - r * r),
        form[4] + factor * q * r,
    )


@njit
def _common_normal(f1, p1, f2, p2):
    """The foot points of the common normal of two lines that are neither parallel nor meet."""
    across = _cross(f1, f2)
    square = _dot(across, across)
    between = _minus(p2, p1)
    return (
        _add(p1, _times(_dot(_cross(between, f2), across) / square, f1)),
        _add(p2, _times(_dot(_cross(between, f1), across) / square, f2)),
    )


@njit
def _last_angles(f1, p1, f2, p2, f3, centre, u, v, goal, kind, slack, preferred, roots):
    """Angle 3 of `_point_roots`, where axes 2 and 1 can turn the point to the goal."""
    if kind == MEET:
        out = _minus(centre, p1)
        to_goal = _minus(goal, p1)
        square = 0.5 * (_dot(to_goal, to_goal) - _dot(out, out) - _dot(u, u))
        count, roots[0], roots[1], doubtful = _linear_roots(_dot(out, u), _dot(out, v), square, slack, preferred)
        return count, doubtful
    if kind == PARALLEL:
        height = _dot(f1, goal) - _dot(f1, centre)
        count, roots[0], roots[1], doubtful = _linear_roots(_dot(f1, u), _dot(f1, v), height, slack, preferred)
        return count, doubtful
    # With the common normal w from p1 to p2, the goal's height along axis 1 and its distance determine the part of the point
    # across axis 2. Its length is known, too.
    w = _minus(p2, p1)
    across = _across(f2, f1)
    to_goal = _minus(goal, p1)
    out = _minus(centre, p2)
    cos = _dot(f1, f2)
    along = (_dot(f2, out), _dot(f2, u), _dot(f2, v))
    square = (_dot(out, out) + _dot(u, u), 2.0 * _dot(out, u), 2.0 * _dot(out, v))
    rest = _dot(to_goal, to_goal) - _dot(w, w)
    form = (-square[0], -square[1], -square[2], 0.0, 0.0)
    height = _dot(f1, to_goal) - cos * along[0]
    form = _quadratic_form(form, height, -cos * along[1], -cos * along[2], 1.0 / _dot(across, across))
    form = _quadratic_form(form, 0.5 * (rest - square[0]), -0.5 * square[1], -0.5 * square[2], 1.0 / _dot(w, w))
    form = _quadratic_form(form, along[0], along[1], along[2], 1.0)
    return _trigonometric_roots(form[0], form[1], form[2], form[3], form[4], slack, roots)


@njit
def _middle_angles(f1, p1, f2, p2, x, goal, kind, slack, preferred):
    """Angle 2 of `_point_roots`, which turns the point x to where axis 1 can turn it to the goal."""
    to_goal = _minus(goal, p1)
    r = _minus(x, p2)
    if kind == MEET:
        height = _dot(f1, to_goal) - _dot(f1, f2) * _dot(f2, r)
        return _linear_roots(_dot(f1, _across(f2, r)), _dot(f1, _cross(f2, r)), height, slack, preferred)
    if kind == PARALLEL:
        w = _across(f1, _minus(p2, p1))
        r = _across(f1, r)
        to_goal = _across(f1, to_goal)
        square = 0.5 * (_dot(to_goal, to_goal) - _dot(w, w) - _dot(r, r))
        return _linear_roots(_dot(w, r), _dot(w, _cross(f2, r)), square, slack, preferred)
    w = _minus(p2, p1)
    across = _across(f2, f1)
    height = _dot(f1, to_goal) - _dot(f1, f2) * _dot(f2, r)
    square = 0.5 * (_dot(to_goal, to_goal) - _dot(w, w) - _dot(r, r))
    turned = _add(_times(height / _dot(across, across), across), _times(square / _dot(w, w), w))
    angle, doubtful = _angle_between(f2, r, turned, preferred)
    return 1, angle, angle, doubtful


@njit
def _point_roots(f1, p1, f2, p2, f3, p3, start, goal, kind, slack, preferred, order, work, roots):
    """The angles (count, 3) with E_1 E_2 E_3 start = goal; `kind` is that of the first two axes.

    `order` 1 writes the angles as they are, -1 from last to first: for a chain that is gone through backwards.
    Returns their number and whether it is doubtful.
    """
    centre = _add(p3, _times(_dot(f3, _minus(start, p3)), f3))
    u = _minus(start, centre)
    v = _cross(f3, u)
    if kind == NEITHER:
        p1, p2 = _common_normal(f1, p1, f2, p2)
    angles3, doubtful = _last_angles(f1, p1, f2, p2, f3, centre, u, v, goal, kind, slack, preferred[2], work)
    count = 0
    for i in range(angles3):
        x = _add(centre, _add(_times(math.cos(work[i]), u), _times(math.sin(work[i]), v)))
        angles2, first2, second2, doubt = _middle_angles(f1, p1, f2, p2, x, goal, kind, slack, preferred[1])
        doubtful = doubtful or doubt
        for k in range(angles2):
            angle2 = first2 if k == 0 else second2
            y = _move(f2, p2, math.cos(angle2), math.sin(angle2), x)
            angle1, doubt = _angle_between(f1, _minus(y, p1), _minus(goal, p1), preferred[0])
            doubtful = doubtful or doubt
            roots[count, 1 - order] = angle1
            roots[count, 1] = angle2
            roots[count, 1 + order] = work[i]
            count += 1
    return count, doubtful


@njit
def _plane_equations(f1, p1, f2, p2, f3, p3, h, u, offset, equations):
    """Fills the equations (2, 5) of the turn and of the height, without the angle of the joint in the middle.

    They are f2 . (E_3 u) = f2 . (E_1^-1 h) and h . (E_1 p2) = u . (E_3^-1 p2) + offset. A row holds the factors of the cosines
    and sines of angle 1 and angle 3, and the right-hand side.
    """
    r1 = _minus(p2, p1)
    r3 = _minus(p2, p3)
    equations[0, 0] = -_dot(f2, _across(f1, h))
    equations[0, 1] = _dot(f2, _cross(f1, h))
    equations[0, 2] = _dot(f2, _across(f3, u))
    equations[0, 3] = _dot(f2, _cross(f3, u))
    equations[0, 4] = _dot(f2, f1) * _dot(f1, h) - _dot(f2, f3) * _dot(f3, u)
    equations[1, 0] = _dot(h, _across(f1, r1))
    equations[1, 1] = _dot(h, _cross(f1, r1))
    equations[1, 2] = -_dot(u, _across(f3, r3))
    equations[1, 3] = _dot(u, _cross(f3, r3))
    equations[1, 4] = offset + _dot(u, p3) - _dot(h, p1) + _dot(u, f3) * _dot(f3, r3) - _dot(h, f1) * _dot(f1, r1)


@njit
def _determinant(equations, i, j):
    return equations[0, i] * equations[1, j] - equations[0, j] * equations[1, i]


@njit
def _plane_roots(f1, p1, f2, p2, f3, p3, h, u, offset, kind, pair_first, slack, preferred, work, roots):
    """The angles (count, 3) with which E_1 E_2 E_3 turns the direction u into h and keeps the heights along them.

    `kind` is that of two neighbours, of which `pair_first` is the first; p2 must be the point in which f2 meets its neighbour.
    `offset` is the difference of the heights: h . (X x) is u . x + offset for all x. Returns their number and whether it is
    doubtful.
    """
    equations = work[4:14].reshape(2, 5)
    _plane_equations(f1, p1, f2, p2, f3, p3, h, u, offset, equations)
    decisive = 1 if kind == MEET else 0  # the row that holds only one angle if two axes meet or are parallel
    doubtful = False
    det = 1.0
    if kind != NEITHER:
        one = 2 if pair_first == 0 else 0  # columns of the angle that is found first
        other = 2 - one
        row = equations[decisive]
        found, work[0], work[1], doubtful = _linear_roots(row[one], row[one + 1], row[4], slack, preferred[one])
    else:
        other = 0 if abs(_determinant(equations, 0, 1)) >= abs(_determinant(equations, 2, 3)) else 2
        one = 2 - other
        det = _determinant(equations, other, other + 1)
        if abs(det) < TINY:
            return 0, True
        form = (-det * det, 0.0, 0.0, 0.0, 0.0)
        for k in range(other, other + 2):  # det times the sine, and det times the cosine of the other angle (Cramer)
            form = _quadratic_form(
                form,
                _determinant(equations, k, 4),
                -_determinant(equations, k, one),
                -_determinant(equations, k, one + 1),
                1.0,
            )
        found, doubtful = _trigonometric_roots(form[0], form[1], form[2], form[3], form[4], slack, work)
    count = 0
    for i in range(found):
        cos = math.cos(work[i])
        sin = math.sin(work[i])
        turn = equations[0, 4] - equations[0, one] * cos - equations[0, one + 1] * sin
        height = equations[1, 4] - equations[1, one] * cos - equations[1, one + 1] * sin
        if kind == NEITHER:
            others = 1
            first = math.atan2(
                (equations[0, other] * height - equations[1, other] * turn) / det,
                (turn * equations[1, other + 1] - height * equations[0, other + 1]) / det,
            )
            second = first
        else:
            row = equations[1 - decisive]
            rest = turn if decisive == 1 else height
            others, first, second, doubt = _linear_roots(row[other], row[other + 1], rest, slack, preferred[other])
            doubtful = doubtful or doubt
        for k in range(others):
            found_last = first if k == 0 else second
            angle1 = found_last if other == 0 else work[i]
            angle3 = work[i] if other == 0 else found_last
            before = _turn(f3, math.cos(angle3), math.sin(angle3), u)
            after = _turn(f1, math.cos(angle1), -math.sin(angle1), h)
            angle2, doubt = _angle_between(f2, before, after, preferred[1])
            doubtful = doubtful or doubt
            roots[count, 0] = angle1
            roots[count, 1] = angle2
            roots[count, 2] = angle3
            count += 1
    return count, doubtful


@njit
def _first_three(axes, points, rotation, translation, structure, preferred, slack, work, roots):
    """The angles (count, 3) of the three joints that are not special, in the order of the loop.

    Fills rows 6 to 8 of `axes` and `points` with their axes, of which those at the front of the loop are moved to its end.
    """
    first = int(structure[FIRST])
    pair_kind = int(structure[PAIR_KIND])
    pair_first = int(structure[PAIR_FIRST])
    for k in range(6, 9):
        joint = first + k - 3
        axis = _vector(axes, joint % 6, 0)
        point = _vector(points, joint % 6, 0)
        if joint >= 6:
            axis = _rotate_back(rotation, axis)
            point = _rotate_back(rotation, _minus(point, translation))
        axes[k, 0], axes[k, 1], axes[k, 2] = axis
        points[k, 0], points[k, 1], points[k, 2] = point
    f1 = _vector(axes, 6, 0)
    f2 = _vector(axes, 7, 0)
    f3 = _vector(axes, 8, 0)
    p1 = _vector(points, 6, 0)
    p2 = _vector(points, 7, 0)
    p3 = _vector(points, 8, 0)
    near = (preferred[(first + 3) % 6], preferred[(first + 4) % 6], preferred[(first + 5) % 6])
    if structure[KIND] == PARALLEL:
        axis = _vector(axes, first, 0)
        u = _rotate_back(rotation, axis)
        offset = _dot(axis, translation)
        return _plane_roots(f1, p1, f2, p2, f3, p3, axis, u, offset, pair_kind, pair_first, slack, near, work, roots)
    goal = _vector(points, first, 0)
    start = _rotate_back(rotation, _minus(goal, translation))
    if pair_kind == NEITHER or pair_first == 0:
        return _point_roots(f1, p1, f2, p2, f3, p3, start, goal, pair_kind, slack, near, 1, work, roots)
    back = (near[2], near[1], near[0])
    f1 = _times(-1.0, f1)
    f2 = _times(-1.0, f2)
    f3 = _times(-1.0, f3)
    return _point_roots(f3, p3, f2, p2, f1, p1, goal, start, pair_kind, slack, back, -1, work, roots)


@njit
def _store_trigonometry(angles, trig):
    """Fills trig (6,) with the cosines and sines of three angles."""
    for k in range(3):
        trig[k] = math.cos(angles[k])
        trig[3 + k] = math.sin(angles[k])


@njit
def _turned_back(axes, rotation, trig, a):
    """A vector turned by E_a E_b E_c, which is X (E_f E_g E_h)^-1."""
    a = _turn(_vector(axes, 6, 0), trig[0], -trig[3], a)
    a = _turn(_vector(axes, 7, 0), trig[1], -trig[4], a)
    a = _turn(_vector(axes, 8, 0), trig[2], -trig[5], a)
    return _rotate(rotation, a)


@njit
def _moved_back(axes, points, rotation, translation, trig, a):
    """A point moved by E_a E_b E_c."""
    a = _move(_vector(axes, 6, 0), _vector(points, 6, 0), trig[0], -trig[3], a)
    a = _move(_vector(axes, 7, 0), _vector(points, 7, 0), trig[1], -trig[4], a)
    a = _move(_vector(axes, 8, 0), _vector(points, 8, 0), trig[2], -trig[5], a)
    return _add(_rotate(rotation, a), translation)


@njit
def _meeting_angles(axes, first, rotation, trig, preferred, slack, out):
    """The angles (count, 3) of three joints whose axes meet in a point, and whether their number is doubtful."""
    a = _vector(axes, first, 0)
    b = _vector(axes, first + 1, 0)
    c = _vector(axes, first + 2, 0)
    moved_b = _turned_back(axes, rotation, trig, b)
    moved_c = _turned_back(axes, rotation, trig, c)
    height = _dot(a, moved_c) - _dot(a, b) * _dot(b, c)
    near = preferred[first + 1]
    count, angle, second, doubtful = _linear_roots(_dot(a, _across(b, c)), _dot(a, _cross(b, c)), height, slack, near)
    for k in range(count):
        cos = math.cos(angle)
        sin = math.sin(angle)
        angle_a, doubt = _angle_between(a, _turn(b, cos, sin, c), moved_c, preferred[first])
        doubtful = doubtful or doubt
        turned = _turn(b, cos, -sin, _turn(a, math.cos(angle_a), -math.sin(angle_a), moved_b))
        angle_c, _ = _angle_between(c, b, turned, preferred[first + 2])
        out[k, 0] = angle_a
        out[k, 1] = angle
        out[k, 2] = angle_c
        angle = second
    return count, doubtful


@njit
def _parallel_angles(axes, points, first, rotation, translation, trig, preferred, slack, out):
    """The angles (count, 3) of three joints whose axes are parallel, and whether their number is doubtful."""
    a = _vector(axes, first, 0)
    b = _vector(axes, first + 1, 0)
    point_a = _vector(points, first, 0)
    point_b = _vector(points, first + 1, 0)
    point_c = _vector(points, first + 2, 0)
    w = _across(a, _minus(point_b, point_a))
    r = _across(a, _minus(point_c, point_b))
    to_c = _across(a, _minus(_moved_back(axes, points, rotation, translation, trig, point_c), point_a))
    whole, doubtful = _angle_between(a, w, _turned_back(axes, rotation, trig, w), 0.0)
    square = 0.5 * (_dot(to_c, to_c) - _dot(w, w) - _dot(r, r))
    near = preferred[first + 1]
    count, angle, second, doubt = _linear_roots(_dot(w, r), _dot(w, _cross(b, r)), square, slack, near)
    doubtful = doubtful or doubt
    for k in range(count):
        angle_a, doubt = _angle_between(a, _add(w, _turn(b, math.cos(angle), math.sin(angle), r)), to_c, preferred[first])
        doubtful = doubtful or doubt
        out[k, 0] = angle_a
        out[k, 1] = angle
        out[k, 2] = _dot(a, _vector(axes, first + 2, 0)) * (whole - angle_a - _dot(a, b) * angle)
        angle = second
    return count, doubtful


@njit
def _solve_six(axes, points, rotation, translation, structure, preferred, slack, memory, out):
    """All angles (count, 6) with E_1 ... E_6 = X, and whether their number is doubtful.

    X is given by the rows of its rotation and its translation.
    """
    work = memory[:WORK]
    trig = memory[WORK : WORK + 6]
    roots = memory[WORK + 6 : WORK + 30].reshape(8, 3)
    special = memory[WORK + 30 :].reshape(2, 3)
    first = int(structure[FIRST])
    solved, doubtful = _first_three(axes, points, rotation, translation, structure, preferred, slack, work, roots)
    count = 0
    for i in range(solved):
        _store_trigonometry(roots[i], trig)
        if structure[KIND] == MEET:
            angles, doubt = _meeting_angles(axes, first, rotation, trig, preferred, slack, special)
        else:
            angles, doubt = _parallel_angles(axes, points, first, rotation, translation, trig, preferred, slack, special)
        doubtful = doubtful or doubt
        for k in range(angles):
            for j in range(3):
                out[count, first + j] = special[k, j]
                out[count, (first + 3 + j) % 6] = roots[i, j]
            count += 1
    return count, doubtful


@njit
def _hold(form, held, angle, axes, points):
    """The axes of the other joints with one held at an angle, and the tip's pose in their zero configuration."""
    n = len(form) - 2
    tip = (_vector(form, n, 0), _vector(form, n, 3), _vector(form, n, 6))
    position = _vector(form, n, 9)
    if held < 0:
        for k in range(n):
            for r in range(3):
                axes[k, r] = form[k, r]
                points[k, r] = form[k, POINT + r]
        return tip, position
    cos = math.cos(angle)
    sin = math.sin(angle)
    held_axis = _vector(form, held, 0)
    held_point = _vector(form, held, POINT)
    row = 0
    for k in range(n):
        if k == held:
            continue
        axis = _vector(form, k, 0)
        point = _vector(form, k, POINT)
        if k > held:
            axis = _turn(held_axis, cos, sin, axis)
            point = _move(held_axis, held_point, cos, sin, point)
        for r in range(3):
            axes[row, r] = axis[r]
            points[row, r] = point[r]
        row += 1
    x = _turn(held_axis, cos, sin, (tip[0][0], tip[1][0], tip[2][0]))
    y = _turn(held_axis, cos, sin, (tip[0][1], tip[1][1], tip[2][1]))
    z = _turn(held_axis, cos, sin, (tip[0][2], tip[1][2], tip[2][2]))
    tip = ((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]))
    return tip, _move(held_axis, held_point, cos, sin, position)


@njit
def _wind(angle, near, low, high):
    """An angle turned by whole turns to the position nearest to `near` inside the bounds, if there is one."""
    turn = 2.0 * np.pi
    angle += turn * np.round((near - angle) / turn)
    if angle > high:
        angle -= turn * np.ceil((angle - high) / turn)
    if angle < low:
        angle += turn * np.ceil((low - angle) / turn)
    return angle


@njit
def _van_der_corput(k):
    """The k-th number of the sequence in base 2, in (0, 1): any beginning of it is spread evenly."""
    value = 0.0
    digit = 0.5
    while k > 0:
        value += digit * (k % 2)
        digit *= 0.5
        k //= 2
    return value


@njit
def find(form, reach, target, q0, slack, margin, min_samples, max_samples, wanted, seeds):
    """Fills `seeds` (M, n) with the configurations inside the bounds, up to `margin`, for a target (12,).

    Six joints are solved once. Of seven joints one is held at q0 first and then at sampled positions, until there are `wanted`
    configurations after `min_samples`, or after `max_samples`. Returns the number of configurations, whether the number of
    solutions is doubtful, and the number of samples.
    """
    n = len(form) - 2
    structure = form[n + 1]
    held = int(structure[HELD])
    axes = np.empty((9, 3))
    points = np.empty((9, 3))
    memory = np.empty(WORK + 36)
    solutions = np.empty((MAX_SOLUTIONS, 6))
    preferred = np.empty(6)
    row = 0
    for k in range(n):
        if k != held:
            preferred[row] = q0[k]
            row += 1
    goal = ((target[0], target[1], target[2]), (target[3], target[4], target[5]), (target[6], target[7], target[8]))
    goal_position = (target[9] / reach, target[10] / reach, target[11] / reach)
    low = 0.0
    span = 0.0
    if held >= 0:
        low = form[held, LOW]
        span = form[held, HIGH] - low
        if not span <= 2.0 * np.pi:  # also if the joint has no bounds
            low = max(low, min(q0[held] - np.pi, form[held, HIGH] - 2.0 * np.pi))
            span = 2.0 * np.pi
    count = 0
    sample = 0
    doubtful = False
    while sample < (max_samples if held >= 0 else 1) and (sample < min_samples or count < wanted):
        angle = q0[held] if sample == 0 else low + span * _van_der_corput(sample)
        tip, position = _hold(form, held, angle, axes, points)
        rotation = (  # of the target, times the transpose of the tip's
            (_dot(goal[0], tip[0]), _dot(goal[0], tip[1]), _dot(goal[0], tip[2])),
            (_dot(goal[1], tip[0]), _dot(goal[1], tip[1]), _dot(goal[1], tip[2])),
            (_dot(goal[2], tip[0]), _dot(goal[2], tip[1]), _dot(goal[2], tip[2])),
        )
        translation = _minus(goal_position, _rotate(rotation, position))
        solved, doubt = _solve_six(axes, points, rotation, translation, structure, preferred, slack, memory, solutions)
        doubtful = doubtful or doubt
        sample += 1
        for i in range(solved):
            if count == len(seeds):
                return count, doubtful, sample
            inside = True
            row = 0
            for k in range(n):
                if k == held:
                    seeds[count, k] = angle
                    continue
                wound = _wind(solutions[i, row], q0[k], form[k, LOW] - margin, form[k, HIGH] + margin)
                inside = inside and wound >= form[k, LOW] - margin and wound <= form[k, HIGH] + margin
                seeds[count, k] = wound
                row += 1
            if inside:
                count += 1
    return count, doubtful, sample


@njit
def find_first(form, reach, targets, slack, margin, max_samples, q, found):
    """Fills q (N, n) with a configuration for each of the targets (N, 12), and `found` (N,) with whether there is one."""
    seeds = np.empty((MAX_SOLUTIONS, q.shape[1]))
    for t in range(len(targets)):
        count, _, _ = find(form, reach, targets[t], q[t], slack, margin, 1, max_samples, 1, seeds)
        found[t] = count > 0
        if count > 0:
            q[t] = seeds[0]


@njit
def solve_all(form, chain, reach, rows, q0, tolerance, orientation_tolerance, slack, margin, samples, most, wanted, q, details):
    """`find`, from `samples` to `most` of them, and `kernel.polish`, for a target (4, 3): fills q (M, n) and `details` (3, M).

    Returns the number of solutions, the steps, the number of samples, and whether no solution can be missing.
    """
    seeds = np.empty(q.shape)
    target = rows.reshape(12)
    count, doubtful, samples = find(form, reach, target, q0, slack, margin, samples, most, wanted, seeds)
    found, steps, lost = polish(chain, reach, target, tolerance, orientation_tolerance, q0, seeds[:count], q, details)
    return found, steps, samples, lost == 0 and not doubtful
