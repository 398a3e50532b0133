"""The closed form of six hinges of which three in a row meet in a point or are parallel, compiled.

With the joints' motions E_k about their axes in the zero configuration, and X the target's pose times the inverse of the tip's
pose in the zero configuration, E_1 E_2 ... E_6 = X. This loop may begin at any joint: an axis moved from its front to its end is
transformed by the inverse of X. So the three special joints (a, b, c) can be anywhere, and with the other three (f, g, h) in the
order of the loop

    (E_a E_b E_c)^-1 = E_f E_g E_h X^-1.

If the axes a, b, c meet in a point, both sides leave this point where it is; if they are parallel, both sides leave their
direction and the heights along it as they are. These are three equations for the other three joints, which have two to four
solutions. Then E_a E_b E_c is known, and each time two configurations of the special joints remain. The first three equations
are a quadratic equation after another if two neighbours of f, g, h meet or are parallel, otherwise a quartic one.

Sources: Pieper, "The kinematics of manipulators under computer control", 1968; Elias and Wen, "IK-Geo: unified robot inverse
kinematics using subproblem decomposition", Mech. Mach. Theory 209, 2025, whose subproblems 1 to 6 are used here.

Seven hinges are swept: one of them is held at sampled positions, and the other six have a closed form.

All kernels are in one file because numba's disk cache notices changes in a kernel's own file only.
"""

from __future__ import annotations

import numpy as np

from armctl.core.jit import njit
from armctl.ik.geometry import MEET, NEITHER, PARALLEL

# A form (n + 2, FORM_COLUMNS) describes a chain of n hinges in the zero configuration, lengths in reaches. A row per joint: the
# direction of its axis 0-2, a point on it 3-5, the joint's bounds. Then a row for the tip: rotation 0-8, translation 9-11. Then a
# row for the structure.
FORM_COLUMNS = 14
POINT = 3
LOW = 12
HIGH = 13
# The structure's columns.
KIND = 0  # of the three special axes: MEET or PARALLEL
FIRST = 1  # the first of them, among the six joints
PAIR_KIND = 2  # of two neighbours among the other three axes: MEET, PARALLEL or NEITHER
PAIR_FIRST = 3  # 0 if these are the first two of the three, 1 if the last two
HELD = 4  # the joint that is swept; -1 if there are six

MAX_SOLUTIONS = 16  # that `_solve_six` writes: four times two, and as many again for double roots
TINY = 1e-9  # reaches, or sine of an angle: a circle with that radius is a point
NEAR_DOUBLE_ROOT = 1e-6  # of a cosine from 1: the two roots are closer than 3e-3 rad, and may be one
MAX_ROOT_ITERATIONS = 60
ROOT_TOLERANCE = 1e-14
UNIT_CIRCLE_BAND = 1e-3  # of a root's modulus from 1: rounding may move a double root off the circle
NEWTON_ITERATIONS = 3
MIN_SLOPE = 1e-3  # relative: a root with less is nearly double
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
    return np.arctan2(_dot(axis, _cross(u, v)), _dot(u, v)), False


@njit
def _linear_roots(a, b, d, slack, preferred):
    """The angles with a cos + b sin = d: their number, the two, and whether the number is doubtful.

    A cosine up to 1 + slack counts as 1. If every angle is a solution, the preferred one is returned.
    """
    radius = np.sqrt(a * a + b * b)
    if radius < TINY:
        return (1 if abs(d) <= TINY + slack else 0), preferred, preferred, True
    cos = d / radius
    middle = np.arctan2(b, a)
    doubtful = abs(cos) > 1.0 - NEAR_DOUBLE_ROOT and abs(cos) <= 1.0 + max(slack, NEAR_DOUBLE_ROOT)
    if abs(cos) > 1.0:
        if abs(cos) > 1.0 + slack:
            return 0, middle, middle, doubtful
        angle = middle if cos > 0 else middle + np.pi
        return 1, angle, angle, True
    half = np.arccos(cos)
    return 2, middle + half, middle - half, doubtful


@njit
def _trigonometric_roots(k0, k1, k2, k3, k4, slack, roots):
    """The angles with k0 + k1 cos t + k2 sin t + k3 cos 2t + k4 sin 2t = 0: their number, and whether it is doubtful.

    They are the roots on the unit circle of a polynomial of degree four, found all at once by Aberth's method.
    """
    scale = abs(k0) + abs(k1) + abs(k2) + abs(k3) + abs(k4)
    if scale < TINY * TINY:
        return 0, True
    if abs(k3) + abs(k4) < 1e-12 * scale:
        count, first, second, doubtful = _linear_roots(k1, k2, -k0, slack, 0.0)
        roots[0] = first
        roots[1] = second
        return count, doubtful
    lead = 0.5 * complex(k3, -k4)
    a3 = 0.5 * complex(k1, -k2) / lead
    a2 = k0 / lead
    a1 = 0.5 * complex(k1, k2) / lead
    a0 = 0.5 * complex(k3, k4) / lead
    z = np.empty(4, np.complex128)
    for i in range(4):
        z[i] = (0.9 + 0.1 * i) * complex(np.cos(0.4 + 1.57 * i), np.sin(0.4 + 1.57 * i))
    for _ in range(MAX_ROOT_ITERATIONS):
        largest = 0.0
        for i in range(4):
            value = (((z[i] + a3) * z[i] + a2) * z[i] + a1) * z[i] + a0
            slope = ((4.0 * z[i] + 3.0 * a3) * z[i] + 2.0 * a2) * z[i] + a1
            if slope == 0:
                slope = complex(1e-300, 0.0)
            newton = value / slope
            others = complex(0.0, 0.0)
            for j in range(4):
                if j != i and z[i] != z[j]:
                    others += 1.0 / (z[i] - z[j])
            step = newton / (1.0 - newton * others)
            z[i] -= step
            largest = max(largest, abs(step) / max(abs(z[i]), 1e-300))
        if largest < ROOT_TOLERANCE:
            break
    count = 0
    doubtful = False
    for i in range(4):
        if not abs(abs(z[i]) - 1.0) < UNIT_CIRCLE_BAND:
            continue
        angle = np.arctan2(z[i].imag, z[i].real)
        best = angle
        least = np.inf
        slope_at_best = 0.0
        for _ in range(NEWTON_ITERATIONS):
            c = np.cos(angle)
            s = np.sin(angle)
            value = k0 + k1 * c + k2 * s + k3 * (c * c - s * s) + 2.0 * k4 * s * c
            slope = -k1 * s + k2 * c - 4.0 * k3 * s * c + 2.0 * k4 * (c * c - s * s)
            if abs(value) < least:
                least = abs(value)
                best = angle
                slope_at_best = abs(slope)
            if abs(slope) < TINY * scale:
                break
            angle -= value / slope
        if slope_at_best < MIN_SLOPE * scale:
            doubtful = True
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
def _point_roots(f1, p1, f2, p2, f3, p3, start, goal, kind, slack, preferred, order, quartic, roots):
    """The angles (count, 3) with E_1 E_2 E_3 start = goal; `kind` is that of the first two axes.

    `order` 1 writes the angles as they are, -1 from last to first: for a chain that is gone through backwards.
    Returns their number and whether it is doubtful.
    """
    centre = _add(p3, _times(_dot(f3, _minus(start, p3)), f3))
    u = _minus(start, centre)
    v = _cross(f3, u)
    doubtful = False
    count = 0
    if kind == MEET:
        out = _minus(centre, p1)
        to_goal = _minus(goal, p1)
        square = 0.5 * (_dot(to_goal, to_goal) - _dot(out, out) - _dot(u, u))
        angles3, quartic[0], quartic[1], doubt = _linear_roots(_dot(out, u), _dot(out, v), square, slack, preferred[2])
    elif kind == PARALLEL:
        height = _dot(f1, goal) - _dot(f1, centre)
        angles3, quartic[0], quartic[1], doubt = _linear_roots(_dot(f1, u), _dot(f1, v), height, slack, preferred[2])
    else:
        p1, p2 = _common_normal(f1, p1, f2, p2)
        w = _minus(p2, p1)
        a = _minus(f1, _times(_dot(f1, f2), f2))
        to_goal = _minus(goal, p1)
        out = _minus(centre, p2)
        cos = _dot(f1, f2)
        along = (_dot(f2, out), _dot(f2, u), _dot(f2, v))
        square = (_dot(out, out) + _dot(u, u), 2.0 * _dot(out, u), 2.0 * _dot(out, v))
        rest = _dot(to_goal, to_goal) - _dot(w, w)
        aa = _dot(a, a)
        ww = _dot(w, w)
        form = (-square[0], -square[1], -square[2], 0.0, 0.0)
        form = _quadratic_form(form, _dot(f1, to_goal) - cos * along[0], -cos * along[1], -cos * along[2], 1.0 / aa)
        form = _quadratic_form(form, 0.5 * (rest - square[0]), -0.5 * square[1], -0.5 * square[2], 1.0 / ww)
        form = _quadratic_form(form, along[0], along[1], along[2], 1.0)
        angles3, doubt = _trigonometric_roots(form[0], form[1], form[2], form[3], form[4], slack, quartic)
    doubtful = doubtful or doubt
    for i in range(angles3):
        x = _add(centre, _add(_times(np.cos(quartic[i]), u), _times(np.sin(quartic[i]), v)))
        r = _minus(x, p2)
        if kind == NEITHER:
            w = _minus(p2, p1)
            a = _minus(f1, _times(_dot(f1, f2), f2))
            to_goal = _minus(goal, p1)
            alpha = _dot(f1, to_goal) - _dot(f1, f2) * _dot(f2, r)
            beta = 0.5 * (_dot(to_goal, to_goal) - _dot(w, w) - _dot(r, r))
            plane = _add(_times(alpha / _dot(a, a), a), _times(beta / _dot(w, w), w))
            first2, doubt = _angle_between(f2, r, plane, preferred[1])
            second2 = first2
            angles2 = 1
        elif kind == MEET:
            r = _minus(x, p1)
            side = _cross(f2, r)
            height = _dot(f1, _minus(goal, p1)) - _dot(f1, f2) * _dot(f2, r)
            angles2, first2, second2, doubt = _linear_roots(
                _dot(f1, _across(f2, r)), _dot(f1, side), height, slack, preferred[1]
            )
        else:
            w = _across(f1, _minus(p2, p1))
            r = _across(f1, r)
            to_goal = _across(f1, _minus(goal, p1))
            square = 0.5 * (_dot(to_goal, to_goal) - _dot(w, w) - _dot(r, r))
            angles2, first2, second2, doubt = _linear_roots(_dot(w, r), _dot(w, _cross(f2, r)), square, slack, preferred[1])
        doubtful = doubtful or doubt
        for k in range(angles2):
            angle2 = first2 if k == 0 else second2
            y = _move(f2, p2, np.cos(angle2), np.sin(angle2), x)
            angle1, doubt = _angle_between(f1, _minus(y, p1), _minus(goal, p1), preferred[0])
            doubtful = doubtful or doubt
            roots[count, 1 - order] = angle1
            roots[count, 1] = angle2
            roots[count, 1 + order] = quartic[i]
            count += 1
    return count, doubtful


@njit
def _plane_roots(f1, p1, f2, p2, f3, p3, h, u, offset, kind, pair_first, slack, preferred, quartic, roots):
    """The angles (count, 3) with which E_1 E_2 E_3 turns the direction u into h and keeps the heights along them.

    `p2` must be the point where f2 meets its neighbour if it does. `offset` is the difference of the heights: h . (X x) is
    u . x + offset for all x. Returns their number and whether it is doubtful.

    The equations: g . (E_3 u) = g . (E_1^-1 h) for the axis g of joint 2, and h . (E_1 p2) = u . (E_3^-1 p2) + offset.
    """
    r1 = _minus(p2, p1)
    r3 = _minus(p2, p3)
    # Row by row: a cos t1 + b sin t1 + c cos t3 + d sin t3 = e.
    turn_a = -_dot(f2, _across(f1, h))
    turn_b = _dot(f2, _cross(f1, h))
    turn_c = _dot(f2, _across(f3, u))
    turn_d = _dot(f2, _cross(f3, u))
    turn_e = _dot(f2, f1) * _dot(f1, h) - _dot(f2, f3) * _dot(f3, u)
    height_a = _dot(h, _across(f1, r1))
    height_b = _dot(h, _cross(f1, r1))
    height_c = -_dot(u, _across(f3, r3))
    height_d = _dot(u, _cross(f3, r3))
    height_e = offset + _dot(u, p3) - _dot(h, p1) + _dot(u, f3) * _dot(f3, r3) - _dot(h, f1) * _dot(f1, r1)
    doubtful = False
    count = 0
    det1 = turn_a * height_b - turn_b * height_a
    det3 = turn_c * height_d - turn_d * height_c
    if kind != NEITHER:
        is_third_first = pair_first == 0
        use_height = kind == MEET
        if is_third_first:
            a, b, e = (height_c, height_d, height_e) if use_height else (turn_c, turn_d, turn_e)
        else:
            a, b, e = (height_a, height_b, height_e) if use_height else (turn_a, turn_b, turn_e)
        found, quartic[0], quartic[1], doubtful = _linear_roots(
            a, b, e, slack, preferred[2] if is_third_first else preferred[0]
        )
    elif max(abs(det1), abs(det3)) < TINY:
        return 0, True
    else:
        is_third_first = abs(det1) >= abs(det3)
        if is_third_first:
            form = _quadratic_form(
                (-det1 * det1, 0.0, 0.0, 0.0, 0.0),
                turn_e * height_b - turn_b * height_e,
                turn_b * height_c - turn_c * height_b,
                turn_b * height_d - turn_d * height_b,
                1.0,
            )
            form = _quadratic_form(
                form,
                turn_a * height_e - turn_e * height_a,
                turn_c * height_a - turn_a * height_c,
                turn_d * height_a - turn_a * height_d,
                1.0,
            )
        else:
            form = _quadratic_form(
                (-det3 * det3, 0.0, 0.0, 0.0, 0.0),
                turn_e * height_d - turn_d * height_e,
                turn_d * height_a - turn_a * height_d,
                turn_d * height_b - turn_b * height_d,
                1.0,
            )
            form = _quadratic_form(
                form,
                turn_c * height_e - turn_e * height_c,
                turn_a * height_c - turn_c * height_a,
                turn_b * height_c - turn_c * height_b,
                1.0,
            )
        found, doubtful = _trigonometric_roots(form[0], form[1], form[2], form[3], form[4], slack, quartic)
    for i in range(found):
        cos = np.cos(quartic[i])
        sin = np.sin(quartic[i])
        if kind == NEITHER:
            if is_third_first:
                turn = turn_e - turn_c * cos - turn_d * sin
                height = height_e - height_c * cos - height_d * sin
                first = np.arctan2((turn_a * height - height_a * turn) / det1, (turn * height_b - height * turn_b) / det1)
            else:
                turn = turn_e - turn_a * cos - turn_b * sin
                height = height_e - height_a * cos - height_b * sin
                first = np.arctan2((turn_c * height - height_c * turn) / det3, (turn * height_d - height * turn_d) / det3)
            second = first
            others = 1
        elif is_third_first:
            turn = turn_e - turn_c * cos - turn_d * sin
            height = height_e - height_c * cos - height_d * sin
            a, b, e = (turn_a, turn_b, turn) if use_height else (height_a, height_b, height)
            others, first, second, doubt = _linear_roots(a, b, e, slack, preferred[0])
            doubtful = doubtful or doubt
        else:
            turn = turn_e - turn_a * cos - turn_b * sin
            height = height_e - height_a * cos - height_b * sin
            a, b, e = (turn_c, turn_d, turn) if use_height else (height_c, height_d, height)
            others, first, second, doubt = _linear_roots(a, b, e, slack, preferred[2])
            doubtful = doubtful or doubt
        for k in range(others):
            other = first if k == 0 else second
            angle1 = other if is_third_first else quartic[i]
            angle3 = quartic[i] if is_third_first else other
            before = _turn(f3, np.cos(angle3), np.sin(angle3), u)
            after = _turn(f1, np.cos(angle1), -np.sin(angle1), h)
            angle2, doubt = _angle_between(f2, before, after, preferred[1])
            doubtful = doubtful or doubt
            roots[count, 0] = angle1
            roots[count, 1] = angle2
            roots[count, 2] = angle3
            count += 1
    return count, doubtful


@njit
def _solve_six(axes, points, rotation, translation, structure, preferred, slack, quartic, roots, out):
    """All angles (count, 6) with E_1 ... E_6 = X, and whether their number is doubtful.

    X is given by the rows of its rotation and its translation.
    """
    kind = int(structure[KIND])
    first = int(structure[FIRST])
    pair_kind = int(structure[PAIR_KIND])
    pair_first = int(structure[PAIR_FIRST])
    a = first
    b = first + 1
    c = first + 2
    f = (first + 3) % 6
    g = (first + 4) % 6
    h = (first + 5) % 6
    for k in range(3):  # the axes moved from the front of the loop to its end
        joint = first + 3 + k
        row = joint % 6
        axis = _vector(axes, row, 0)
        point = _vector(points, row, 0)
        if joint >= 6:
            axis = _rotate_back(rotation, axis)
            point = _rotate_back(rotation, _minus(point, translation))
        axes[6 + k, 0], axes[6 + k, 1], axes[6 + k, 2] = axis
        points[6 + k, 0], points[6 + k, 1], points[6 + k, 2] = point
    f1 = _vector(axes, 6, 0)
    f2 = _vector(axes, 7, 0)
    f3 = _vector(axes, 8, 0)
    p1 = _vector(points, 6, 0)
    p2 = _vector(points, 7, 0)
    p3 = _vector(points, 8, 0)
    axis_a = _vector(axes, a, 0)
    axis_b = _vector(axes, b, 0)
    axis_c = _vector(axes, c, 0)
    point_a = _vector(points, a, 0)
    point_b = _vector(points, b, 0)
    point_c = _vector(points, c, 0)
    near = (preferred[f], preferred[g], preferred[h])
    if kind == MEET:
        start = _rotate_back(rotation, _minus(point_a, translation))
        if pair_kind != NEITHER and pair_first == 1:
            back = (near[2], near[1], near[0])
            n1 = _times(-1.0, f1)
            n2 = _times(-1.0, f2)
            n3 = _times(-1.0, f3)
            solved, doubtful = _point_roots(n3, p3, n2, p2, n1, p1, point_a, start, pair_kind, slack, back, -1, quartic, roots)
        else:
            solved, doubtful = _point_roots(f1, p1, f2, p2, f3, p3, start, point_a, pair_kind, slack, near, 1, quartic, roots)
    else:
        u = _rotate_back(rotation, axis_a)
        offset = _dot(axis_a, translation)
        solved, doubtful = _plane_roots(
            f1, p1, f2, p2, f3, p3, axis_a, u, offset, pair_kind, pair_first, slack, near, quartic, roots
        )
    # What joint b moves: the axis of joint c, or the point c across the parallel axes.
    w = _across(axis_a, _minus(point_b, point_a))
    r = _across(axis_a, _minus(point_c, point_b))
    if kind == MEET:
        special_cos = _dot(axis_a, _across(axis_b, axis_c))
        special_sin = _dot(axis_a, _cross(axis_b, axis_c))
        special_rest = _dot(axis_a, axis_b) * _dot(axis_b, axis_c)
    else:
        special_cos = _dot(w, r)
        special_sin = _dot(w, _cross(axis_b, r))
        special_rest = 0.5 * (_dot(w, w) + _dot(r, r))
    count = 0
    for i in range(solved):
        angle_f = roots[i, 0]
        angle_g = roots[i, 1]
        angle_h = roots[i, 2]
        cos_f = np.cos(angle_f)
        sin_f = np.sin(angle_f)
        cos_g = np.cos(angle_g)
        sin_g = np.sin(angle_g)
        cos_h = np.cos(angle_h)
        sin_h = np.sin(angle_h)
        # Q is the rotation of E_a E_b E_c, applied to the vectors that determine the three angles.
        v = axis_b if kind == MEET else w
        Qv = _rotate(rotation, _turn(f3, cos_h, -sin_h, _turn(f2, cos_g, -sin_g, _turn(f1, cos_f, -sin_f, v))))
        if kind == MEET:
            Qc = _rotate(rotation, _turn(f3, cos_h, -sin_h, _turn(f2, cos_g, -sin_g, _turn(f1, cos_f, -sin_f, axis_c))))
            angles, first_b, second_b, doubt = _linear_roots(
                special_cos, special_sin, _dot(axis_a, Qc) - special_rest, slack, preferred[b]
            )
        else:
            moved = _move(f3, p3, cos_h, -sin_h, _move(f2, p2, cos_g, -sin_g, _move(f1, p1, cos_f, -sin_f, point_c)))
            to_c = _across(axis_a, _minus(_add(_rotate(rotation, moved), translation), point_a))
            whole, doubt = _angle_between(axis_a, w, Qv, 0.0)
            square = 0.5 * _dot(to_c, to_c) - special_rest
            angles, first_b, second_b, doubt = _linear_roots(special_cos, special_sin, square, slack, preferred[b])
        doubtful = doubtful or doubt
        for k in range(angles):
            angle_b = first_b if k == 0 else second_b
            cos_b = np.cos(angle_b)
            sin_b = np.sin(angle_b)
            if kind == MEET:
                angle_a, doubt = _angle_between(axis_a, _turn(axis_b, cos_b, sin_b, axis_c), Qc, preferred[a])
                turned = _turn(axis_b, cos_b, -sin_b, _turn(axis_a, np.cos(angle_a), -np.sin(angle_a), Qv))
                angle_c, _ = _angle_between(axis_c, axis_b, turned, preferred[c])
            else:
                angle_a, doubt = _angle_between(axis_a, _add(w, _turn(axis_b, cos_b, sin_b, r)), to_c, preferred[a])
                sign_c = _dot(axis_a, axis_c)
                angle_c = sign_c * (whole - angle_a - _dot(axis_a, axis_b) * angle_b)
            doubtful = doubtful or doubt
            if count < len(out):
                out[count, a] = angle_a
                out[count, b] = angle_b
                out[count, c] = angle_c
                out[count, f] = angle_f
                out[count, g] = angle_g
                out[count, h] = angle_h
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
    cos = np.cos(angle)
    sin = np.sin(angle)
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
    quartic = np.empty(4)
    roots = np.empty((8, 3))
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
        solved, doubt = _solve_six(axes, points, rotation, translation, structure, preferred, slack, quartic, roots, solutions)
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
