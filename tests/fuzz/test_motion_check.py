"""The check of random motions finds limits that are exceeded by 1e-5 anywhere, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from motion_check import extremes, violation
from scipy.interpolate import BPoly, PPoly

import armctl
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

FIELDS = ("q", "v_max", "a_max", "j_max")
JOINTS = 3
PLANTED = 1e-5  # relative


def smooth_motion(rng, count, piece_s):
    """A motion through random positions, velocities and accelerations, and its extremes: (4, 2, joints)."""
    knots = np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 1.5, count) * piece_s)])
    states = rng.normal(size=(count + 1, 3, JOINTS)) / piece_s ** np.arange(3)[:, None]
    curve = PPoly.from_bernstein_basis(BPoly.from_derivatives(knots, states))
    times = np.append((knots[:-1, None] + np.diff(knots)[:, None] * np.linspace(0, 1, 1001)[:-1]).ravel(), knots[-1])
    dense = [curve.derivative(order)(times) if order else curve(times) for order in range(4)]
    before_knots = 6 * curve.c[2] + 24 * curve.c[1] * np.diff(knots)[:, None] + 60 * curve.c[0] * np.diff(knots)[:, None] ** 2
    dense[3] = np.concatenate([dense[3], before_knots])
    found = np.array([[x.min(axis=0), x.max(axis=0)] for x in dense])
    coefficients = np.ascontiguousarray(np.moveaxis(curve.c[::-1], 0, 1))
    names = tuple(f"joint{i}" for i in range(JOINTS))
    return JointTrajectory(knots, coefficients, names, limits_around(found, 2.0)), found


def limits_around(found, factor):
    """Limits that are the extremes times a factor."""
    v_max, a_max, j_max = factor * np.abs(found[1:]).max(axis=1)
    room = (factor - 1) * (found[0, 1] - found[0, 0])
    return armctl.Limits(found[0, 0] - room, found[0, 1] + room, v_max, a_max, j_max, np.full(JOINTS, np.inf))


@pytest.mark.parametrize(("count", "piece_s"), [(1, 0.3), (5, 0.02), (12, 4.0), (3, 500.0)])
@pytest.mark.parametrize("order", range(4))
def test_a_limit_exceeded_by_1e_5_at_one_point_of_one_joint_is_found(order, count, piece_s):
    for case in range(4):
        rng = np.random.default_rng([order, count, case])
        motion, found = smooth_motion(rng, count, piece_s)
        limits = limits_around(found, 1 + PLANTED)
        assert not violation(motion, limits)
        i = int(rng.integers(JOINTS))
        if order == 0:
            side = ("q_min", "q_max")[case % 2]
            bound = getattr(limits, side).copy()
            bound[i] = found[0, case % 2, i] + PLANTED * (1 - 2 * (case % 2))
            assert violation(motion, replace(limits, **{side: bound})).startswith("position by ")
        else:
            bound = getattr(limits, FIELDS[order]).copy()
            bound[i] *= 1 - 2 * PLANTED
            found_violation = violation(motion, replace(limits, **{FIELDS[order]: bound}))
            assert found_violation.startswith(f"derivative {order} by a factor of 1 + ")


class Drifting:
    """A motion whose samples are not those of its polynomials: they jump at a time."""

    def __init__(self, motion, at, order):
        self._motion = motion
        self._at = at
        self._order = order
        self.knots = motion.knots
        self.coefficients = motion.coefficients
        self.duration = motion.duration
        self.n = motion.n

    def sample(self, times):
        samples = [x.copy() for x in self._motion.sample(times)[:3]]
        samples[self._order][times > self._at] += 0.01 * np.abs(samples[self._order]).max()
        return samples


@pytest.mark.parametrize(("count", "piece_s"), [(5, 2.0), (5, 500.0)])
@pytest.mark.parametrize("order", range(3))
def test_samples_that_jump_at_a_knot_are_found(order, count, piece_s):
    motion, found = smooth_motion(np.random.default_rng(order), count, piece_s)
    limits = limits_around(found, 1 + PLANTED)
    assert violation(Drifting(motion, motion.knots[2], order), limits) == f"derivative {order + 1} by differences"


def test_a_position_that_jumps_between_two_pieces_is_found():
    motion, found = smooth_motion(np.random.default_rng(3), 4, 1.0)
    coefficients = motion.coefficients.copy()
    coefficients[2, 0, 1] += 1e-9
    broken = JointTrajectory(motion.knots, coefficients, motion.joint_names, motion.limits)
    assert violation(broken, limits_around(found, 1.1)).startswith("position jumps by 1.0000")


@pytest.mark.parametrize("degree", range(1, 6))
def test_turning_points_are_found_also_where_coefficients_differ_by_many_powers_of_ten(degree):
    rng = np.random.default_rng(degree)
    p = rng.normal(size=(300, degree + 1)) * 10.0 ** rng.uniform(-18, 3, (300, degree + 1))
    p[rng.random(p.shape) < 0.2] = 0.0
    values = extremes(p)
    x = np.concatenate([np.linspace(0, 1, 2001), np.geomspace(1e-12, 1, 2001)])
    dense = np.polynomial.polynomial.polyval(x, p.T)
    size = np.abs(p).sum(axis=1)
    assert (values.max(axis=1) - dense.max(axis=1) >= -1e-14 * size).all()
    assert (dense.min(axis=1) - values.min(axis=1) >= -1e-14 * size).all()
