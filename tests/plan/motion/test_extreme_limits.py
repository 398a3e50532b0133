"""Motions under extreme limits: planned or refused with PlanError, exact at ends and joins, and checked in little memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from synthetic import limb, motors

import armctl
from armctl.plan.motion.timing.otg import JointState, ProfileSolver, at_rest, solve_pieces, straight_rest_to_rest
from armctl.plan.motion.timing.path_timing import time_optimal
from armctl.plan.motion.trajectory.limit_check import piece_extremes
from armctl.plan.motion.trajectory.piecewise import Pieces, knots_of, sample

NAMES = "a b c d e f"


@pytest.fixture
def six(load) -> armctl.Arm:
    """Six hinges with the ranges of a UR10e."""
    arm = load(limb(NAMES, '<site name="tip" pos="0.1 0 0"/>'), motors(NAMES))
    high = np.array([6.28319, 6.28319, 3.1415, 6.28319, 6.28319, 6.28319])
    return arm.with_limits(replace(arm.limits, q_min=-high, q_max=high, tau_max=np.full(6, np.inf)))


def with_limits(arm: armctl.Arm, v_max, a_max, j_max) -> armctl.Arm:
    return arm.with_limits(replace(arm.limits, v_max=np.array(v_max), a_max=np.array(a_max), j_max=np.array(j_max)))


def test_waypoints_for_which_ruckig_finds_no_common_duration_are_planned(six):
    slow = with_limits(
        six,
        [0.00253496, 0.00253496, 0.00380243, 0.00380243, 0.00380243, 0.00380243],
        [164.346988, 0.0673398701, 23.1905454, 0.182732097, 513.811438, 0.393850701],
        [456.657985, 47297.5488, 43167.9305, 11715.0294, 13436.1981, 572035.292],
    )
    start = np.array([3.0, 4.0, 1.5, 0.2, -0.3, 3.5])
    goal = start + np.array([-6.9034127, -8.22329337, -2.94915231, -0.332599142, 0.578063517, -6.81071613])
    motion = armctl.move_through(slow, [start, goal])
    assert motion.check_limits().ok
    assert np.abs(motion(motion.duration).q - goal).max() < 1e-12


def test_waypoints_for_which_the_search_overflows_are_planned(six):
    slow = with_limits(
        six,
        [0.00362638, 0.00362638, 0.00543956, 0.00543956, 0.00543956, 0.00543956],
        [0.707740653, 629.31794, 50.0674737, 0.322799682, 777.18125, 29.6658016],
        [2641.90166623, 35.50849136, 7.91475116, 6.38066787, 20.91191649, 1467.26361683],
    )
    rng = np.random.default_rng(0)
    q = slow.limits.random(slow.home, 5, rng)
    motion = armctl.move_through(slow, q)
    assert motion.check_limits().ok


@pytest.mark.parametrize("apart", [1e-1, 1e-4, 1e-7, 1e-8])
@pytest.mark.parametrize("scale", [1.0, 4e-3])
def test_a_motion_is_exact_at_every_waypoint_and_join(bundled, apart, scale):
    limits = bundled.limits
    arm = bundled.with_limits(replace(limits, a_max=scale * limits.a_max, j_max=scale * limits.j_max))
    q = arm.home + np.array([0.0, apart, 0.1, 0.1 + apart, 0.3])[:, None] * [1.0, -0.5, 0.2]
    motion = armctl.move_through(arm, q)
    assert motion.check_limits().ok
    h = np.diff(motion.knots)[:, None]
    ends = np.einsum("mp,mpn->mn", h ** np.arange(6), motion.coefficients)
    assert np.abs(ends[:-1] - motion.coefficients[1:, 0]).max() < 1e-12
    assert np.abs(motion(motion.duration).q - q[-1]).max() < 1e-12
    starts = np.vstack([motion.coefficients[:, 0], motion(motion.duration).q])
    assert all(np.abs(starts - point).max(axis=1).min() < 1e-12 for point in q)


@pytest.mark.parametrize("straight", [True, False])
def test_a_joint_move_ends_exactly_at_its_goal(bundled, straight):
    rng = np.random.default_rng(2)
    for start, goal in zip(*(bundled.limits.random(bundled.home, 20, rng) for _ in range(2)), strict=True):
        motion = armctl.move_j(bundled, start, goal, straight=straight)
        end = motion(motion.duration)
        assert np.abs(end.q - goal).max() < 1e-12
        assert np.abs(end.v).max() < 1e-11


def test_a_free_move_that_swings_out_by_a_micrometre_is_refused():
    arm = arm_of("robot_arm_3dof")
    limits = arm.limits
    speed = 0.5  # rad/s, towards the limit
    refused = planned = 0
    for gap in np.geomspace(1e-5, 1.0, 200):
        start = np.array([limits.q_max[0] - gap, arm.home[1], arm.home[2]])
        try:
            moving = armctl.Setpoint(start, np.array([speed, 0.0, 0.0]), np.zeros(3))
            motion = armctl.move_j(arm, moving, arm.home, straight=False)
        except armctl.LimitError:
            refused += 1
            continue
        planned += 1
        highest = max(peak.value for peak in motion.check_limits().peaks if peak.quantity == "position" and "yaw" in peak.joint)
        assert highest <= limits.q_max[0] + 1e-9
    assert refused > 0
    assert planned > 0


def test_a_phase_of_nanoseconds_late_in_a_long_move_keeps_the_acceleration_limit(bundled):
    """262 s into a move, times are rounded to 6e-14 s: at this jerk that is 1e-5 of the acceleration limit."""
    slow = with_limits(bundled, [2.2e-3, 0.032, 18.0], [3900.0, 2.5, 0.0231972630], [857.0, 7580.0, 3.93717508e6])
    motions = [armctl.move_j(slow, [q, 0.1, -2.0], [q + 0.572, 0.2, -0.5], straight=False) for q in np.linspace(0.0, 0.1, 20)]
    assert all(motion.check_limits().ok for motion in motions)


def test_a_long_free_move_between_limits_stays_inside_them(six):
    """2165 s into a move, the rounding of times is a millionth of an acceleration: to correct it must not move the joint."""
    slow = with_limits(
        six,
        [176.511513, 0.0766720201, 0.00239314787, 41.2127232, 0.00321102368, 4.22571414],
        [0.988519795, 27.732639816, 3919.530483932, 0.829831238, 2.123817066, 0.533046933],
        [3695429.4066855, 1499665.0555167, 77.532220137, 8707.789731149, 4805651.0475685, 491658.95262844],
    )
    low = slow.limits.q_min
    start = np.array([low[0], 1.1686, 2.4122, -2.0415, 1.4189, 1.3865])
    goal = np.array([low[0] + 0.1295, 1.2175, -2.7692, -0.1923, 0.6677, 0.4445])
    motion = armctl.move_j(slow, start, goal, straight=False)
    q = motion.sample(np.linspace(0.0, motion.duration, 10_001))[0]
    assert np.abs(q[:, 0] - np.clip(q[:, 0], low[0], goal[0])).max() < 1e-9
    assert motion.check_limits().ok


def test_no_piece_of_a_joined_motion_lasts_longer_than_before():
    rng = np.random.default_rng(0)
    for begin in (0.0, 0.1, 1234.5):
        durations = 10.0 ** rng.uniform(-9, 3, 300)
        knots = knots_of(durations, begin)
        lost = durations - np.diff(knots)
        assert knots[0] == begin
        assert lost.min() >= 0.0
        assert lost.max() <= 2 * np.spacing(knots[-1])


def test_the_closed_form_from_rest_to_rest_is_as_fast_as_ruckig():
    rng = np.random.default_rng(0)
    for _ in range(200):
        bounds = tuple(10.0 ** rng.uniform(-2, 3, 1) for _ in range(3))
        goal = 10.0 ** rng.uniform(-4, 1, 1)
        zero = np.zeros(1)
        profile = ProfileSolver(*bounds).solve(at_rest(zero), at_rest(goal))
        pieces = straight_rest_to_rest(zero, goal, bounds)
        assert pieces.knots[-1] == pytest.approx(profile.duration, rel=1e-6)
        q, v, a = sample(pieces, pieces.knots[-1:])
        assert q[0] == pytest.approx(goal, rel=1e-12)
        assert abs(v[0, 0]) < 1e-9 * bounds[0][0]
        assert abs(a[0, 0]) < 1e-6 * bounds[1][0]


def test_a_code_that_the_binding_of_ruckig_does_not_know_is_no_solution(monkeypatch):
    class Unknown:
        def calculate(self, *_):
            raise ValueError("-101 is not a valid Result.")

    monkeypatch.setattr("ruckig.Ruckig", lambda _: Unknown())
    solver = ProfileSolver(*np.ones((3, 1)))
    zero = np.zeros(1)
    assert solver.solve(at_rest(zero), at_rest(zero + 1)) is None
    assert isinstance(solve_pieces(solver, at_rest(zero), at_rest(zero + 1)), Pieces)
    with pytest.raises(armctl.PlanError, match="no jerk-limited move joins the two states"):
        solve_pieces(solver, JointState(zero, zero + 0.1, zero), at_rest(zero + 1))


def test_a_long_motion_is_checked_in_the_memory_of_its_pieces(bundled):
    slow = bundled.with_limits(replace(bundled.limits, v_max=1e-6 * bundled.limits.v_max))
    tracemalloc.start()
    motion = armctl.move_j(slow, bundled.home, bundled.home + 0.3)
    check = armctl.check_torque(slow, motion)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert motion.duration > 1e5
    assert peak < 100e6
    assert check.ok
    still = armctl.check_torque(slow, armctl.move_j(bundled, bundled.home, bundled.home + 0.3).scaled(1e-3))
    assert check.ratio == pytest.approx(still.ratio, rel=1e-2)


def test_a_short_peak_in_a_long_motion_is_found(bundled):
    fast = armctl.move_j(bundled, bundled.home, bundled.home + 0.3)
    motion = pause(bundled, bundled.home).then(fast).then(pause(bundled, bundled.home + 0.3))
    assert motion.duration > 1e4
    assert armctl.check_torque(bundled, motion).ratio == pytest.approx(armctl.check_torque(bundled, fast).ratio, rel=1e-3)


def pause(arm: armctl.Arm, q: np.ndarray) -> armctl.JointTrajectory:
    """Standing still for an hour and a half."""
    coefficients = np.zeros((1, 6, arm.n))
    coefficients[0, 0] = q
    return armctl.JointTrajectory(np.array([0.0, 5400.0]), coefficients, arm.joint_names, arm.limits)


class Sudden:
    """A path on which the first joint moves within a small part of the length, as where a line leaves a singularity."""

    length = 1.0
    part = 1e-4

    def derivatives(self, s: np.ndarray) -> tuple[np.ndarray, ...]:
        u = s / self.part
        r = 1 + u**2
        first = (np.arctan(u), 1 / r / self.part, -2 * u / r**2 / self.part**2, (6 * u**2 - 2) / r**3 / self.part**3)
        second = (s, np.ones_like(s), np.zeros_like(s), np.zeros_like(s))
        return tuple(np.stack(pair, axis=1) for pair in zip(first, second, strict=True))


def test_no_path_is_run_backwards_or_beyond_its_ends():
    limits = armctl.Limits(
        q_min=np.full(2, -9.0),
        q_max=np.full(2, 9.0),
        v_max=np.array([0.1, 1.0]),
        a_max=np.array([1.0, 10.0]),
        j_max=np.full(2, 100.0),
        tau_max=np.full(2, np.inf),
    )
    pieces = time_optimal(Sudden(), limits)
    steps = np.diff(pieces.knots)
    length = piece_extremes(pieces.coefficients, steps, 0)[1][:, -1]
    speed = piece_extremes(pieces.coefficients, steps, 1)[1][:, -1]
    assert length.min() >= -1e-12
    assert length.max() <= 1 + 1e-12
    assert speed.min() >= -1e-12
