"""Dense waypoints, as teaching and planners deliver them: on lines as fast as `move_j`, on curves as a phase plane permits.

`least_time` integrates the phase plane of a path without jerk limits, independently of armctl's planners.
"""

import itertools
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from arms import some_of
from hypothesis import given, settings
from hypothesis import strategies as st
from light_arms import light_arm, with_bounds
from motion_check import violation
from synthetic import limb, motors

import armctl
from armctl import Via
from armctl.plan.motion.timing.waypoint_path import arc_lengths, straight_runs

N = 6


@pytest.fixture(scope="module")
def light(tmp_path_factory) -> armctl.Arm:
    return light_arm(tmp_path_factory.mktemp("arm"), N)


def random_bounds(arm: armctl.Arm, rng: np.random.Generator) -> armctl.Arm:
    """Limits of arms from soft to hard jerk, other ones for each joint."""
    v = rng.uniform(0.5, 5.0, N)
    a = v * 10 ** rng.uniform(0.3, 1.3, N)
    return arm.with_limits(replace(arm.limits, v_max=v, a_max=a, j_max=a * 10 ** rng.uniform(0.8, 3.0, N)))


def assert_passes(motion: armctl.JointTrajectory, waypoints: np.ndarray) -> None:
    """Every waypoint, in its turn and exactly, inside all limits."""
    assert motion.check_limits().ok
    assert violation(motion, motion.limits) == ""
    q = motion.sample(motion.knots).q
    at = 0
    for point in waypoints:
        near = np.flatnonzero(np.abs(q[at:] - point).max(axis=1) < 1e-9)
        assert len(near)
        at += int(near[0])


def curve(u: np.ndarray, rng: np.random.Generator, joints: int = N) -> np.ndarray:
    phase = rng.uniform(0.0, 2 * np.pi, (2, joints))
    size = rng.uniform(0.2, 1.0, (2, joints))
    return size[0] * np.sin(2 * u[:, None] + phase[0]) + 0.3 * size[1] * np.sin(5 * u[:, None] + phase[1])


def least_time(q: np.ndarray, v_max: np.ndarray, a_max: np.ndarray) -> float:
    """s, along a path that is sampled densely, from rest to rest, without jerk limits.

    Backwards, the squared speeds from which the rest of the path can be completed; forwards, the greatest that can be reached
    (Pham and Pham, "A new approach to time-optimal path parameterization based on reachability analysis", 2018).
    """
    step = 1.0 / (len(q) - 1)
    slope = np.gradient(q, step, axis=0, edge_order=2)
    bend = np.gradient(slope, step, axis=0, edge_order=2)
    highest = ((v_max / np.maximum(np.abs(slope), 1e-12)) ** 2).min(axis=1)

    def most(k: int, b: np.ndarray) -> np.ndarray:
        """The greatest slope of half the squared speed at b."""
        sides = (np.sign(slope[k]) * (-bend[k] * b[:, None]) + a_max) / np.maximum(np.abs(slope[k]), 1e-12)
        return sides.min(axis=1)

    def least(k: int, b: np.ndarray) -> np.ndarray:
        sides = (np.sign(slope[k]) * (-bend[k] * b[:, None]) - a_max) / np.maximum(np.abs(slope[k]), 1e-12)
        return sides.max(axis=1)

    completing = np.zeros(len(q))
    for k in range(len(q) - 2, -1, -1):
        low = 0.0
        high = float(highest[k])
        for _ in range(30):
            b = 0.5 * (low + high)
            one = np.array([b])
            slowest = b + 2 * step * float(least(k, one)[0])
            is_possible = least(k, one)[0] <= most(k, one)[0] and slowest <= completing[k + 1]
            low, high = (b, high) if is_possible else (low, b)
        completing[k] = low
    b = np.zeros(len(q))
    for k in range(len(q) - 1):
        b[k + 1] = min(b[k] + 2 * step * float(most(k, b[k : k + 1])[0]), completing[k + 1])
    root = np.sqrt(np.maximum(b, 0.0))
    return float((2 * step / (root[1:] + root[:-1])).sum())


@lru_cache
def least_time_of_curve(seed: int) -> float:
    dense = curve(np.linspace(0.0, 1.0, 501), np.random.default_rng(seed))
    return least_time(dense, np.full(N, 3.14), np.full(N, 25.0))


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), count=st.integers(5, 100), size=st.floats(-2.0, 0.5), even=st.booleans())
def test_waypoints_on_a_line_take_as_long_as_move_j(light, seed, count, size, even):
    rng = np.random.default_rng(seed)
    arm = random_bounds(light, rng)
    way = rng.uniform(-1.0, 1.0, N)
    share = np.linspace(0.0, 1.0, count) if even else np.sort(np.append([0.0, 1.0], rng.uniform(0.0, 1.0, count - 2)))
    q = rng.uniform(-3.0, 3.0, N) + share[:, None] * way * 10**size / np.abs(way).max()
    motion = armctl.move_through(arm, q)
    assert motion.duration <= 1.0001 * armctl.move_j(arm, q[0], q[-1]).duration
    assert_passes(motion, q)


@pytest.mark.parametrize("count", [5, 10, 30, 100, 300])
def test_one_joint_through_many_waypoints_takes_as_long_as_move_j(load, count):
    arm = load(limb("a", '<site name="tip" pos="0.1 0 0"/>'), motors("a"))
    arm = with_bounds(arm.with_limits(replace(arm.limits, tau_max=np.full(1, np.inf))), 3.14, 25.0, 500.0)
    q = np.linspace(0.0, 0.5, count)[:, None]
    motion = armctl.move_through(arm, q)
    assert motion.duration <= 1.0001 * armctl.move_j(arm, q[0], q[-1]).duration
    assert_passes(motion, q)


@pytest.mark.parametrize("jerk", [500.0, 5e3, 1e5])
@pytest.mark.parametrize("count", [10, 30, 100, pytest.param(300, marks=pytest.mark.nightly)])
def test_waypoints_on_a_smooth_curve_take_hardly_longer_than_the_curve_without_jerk_limits(light, count, jerk):
    arm = with_bounds(light, 3.14, 25.0, jerk)
    for seed in range(2):
        q = curve(np.linspace(0.0, 1.0, count), np.random.default_rng(seed))
        motion = armctl.move_through(arm, q)
        assert motion.duration <= 1.15 * least_time_of_curve(seed)
        assert_passes(motion, q)


def test_the_phase_plane_agrees_with_a_closed_form():
    """A line in full acceleration and full braking."""
    line = np.linspace(0.0, 1.0, 1001)[:, None] * np.array([1.0, 0.5])
    assert least_time(line, np.full(2, 9.0), np.full(2, 4.0)) == pytest.approx(2 * np.sqrt(1 / 4), rel=2e-3)
    assert least_time(line, np.full(2, 1.0), np.full(2, 4.0)) == pytest.approx(1.0 + 1 / 4, rel=2e-3)


@pytest.mark.full
def test_uneven_waypoints_on_a_smooth_curve_cost_little(light):
    arm = with_bounds(light, 3.14, 25.0, 5e3)
    rng = np.random.default_rng(3)
    for count in (20, 100):
        u = np.sort(np.append([0.0, 1.0], rng.uniform(0.0, 1.0, count - 2)))
        motion = armctl.move_through(arm, curve(u, np.random.default_rng(8)))
        assert motion.duration <= 1.15 * least_time_of_curve(8)


def there_and_back(line: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.vstack([line, line[-2::-1]])


def broken(line: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Two lines with a corner between."""
    other = line[-1] + np.linspace(0.0, 1.0, len(line))[1:, None] * rng.uniform(-0.5, 0.5, N)
    return np.vstack([line, other])


def twice(line: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Some waypoints given twice."""
    return np.repeat(line, rng.integers(1, 3, len(line)), axis=0)


@pytest.mark.parametrize("count", [4, 30, pytest.param(120, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("shape", [there_and_back, broken, twice])
def test_a_path_of_lines_is_never_slower_than_a_move_j_along_each(light, shape, count):
    rng = np.random.default_rng(count)
    arm = random_bounds(light, rng)
    line = np.linspace(0.0, 1.0, count)[:, None] * rng.uniform(-0.5, 0.5, N)
    q = shape(line, rng)
    ends = [line[0], line[-1]] if shape is twice else [line[0], line[-1], q[-1]]
    motion = armctl.move_through(arm, q)
    assert motion.duration <= 1.0001 * sum(armctl.move_j(arm, a, b).duration for a, b in itertools.pairwise(ends))
    assert_passes(motion, q)


@pytest.mark.parametrize(
    "noise", [1e-6, pytest.param(1e-5, marks=pytest.mark.nightly), pytest.param(1e-4, marks=pytest.mark.nightly), 1e-3]
)
def test_a_noisy_recording_takes_a_fraction_of_stopping_everywhere(light, noise):
    """100 rows of a motion that was taught by hand, with pauses: dense where the hand was slow."""
    arm = with_bounds(light, 3.14, 25.0, 500.0)
    rng = np.random.default_rng(1)
    u = np.clip(np.linspace(-0.2, 1.2, 100), 0.0, 1.0)
    q = np.round(curve(u * u * (3 - 2 * u), rng) + rng.normal(0.0, noise, (100, N)), 6)
    motion = armctl.move_through(arm, q)
    stopping = sum(armctl.move_j(arm, a, b, straight=False).duration for a, b in itertools.pairwise(q))
    assert motion.duration < {1e-6: 0.13, 1e-5: 0.16, 1e-4: 0.25, 1e-3: 0.45}[noise] * stopping
    apart = np.abs(np.diff(q, axis=0)).max(axis=1) > 0
    assert_passes(motion, q[np.append(True, apart)])


def zigzag(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.cumsum(rng.normal(0.0, 0.02, (count, N)), axis=0)


def saw(count: int, rng: np.random.Generator) -> np.ndarray:
    q = np.zeros((count, N))
    q[:, 0] = np.linspace(0.0, 1.0, count)
    q[:, 1] = 0.05 * (np.arange(count) % 2)
    return q


def cusps(count: int, rng: np.random.Generator) -> np.ndarray:
    u = np.linspace(0.0, 1.0, count)[:, None]
    return np.hstack([np.abs(np.sin(7 * u)), u, *([0.0 * u] * (N - 2))])


def steps(count: int, rng: np.random.Generator) -> np.ndarray:
    u = np.linspace(0.0, 3.0, count)[:, None]
    return np.hstack([np.clip(u - 1, 0.0, 1.0), np.clip(u, 0.0, 1.0) + np.clip(u - 2, 0.0, 1.0), *([0.0 * u] * (N - 2))])


@pytest.mark.parametrize("shape", [zigzag, saw, cusps, steps])
@pytest.mark.parametrize("count", [3, 10, 60])
def test_rough_waypoints_are_passed_exactly_and_faster_than_with_stops(light, shape, count):
    rng = np.random.default_rng(count)
    arm = random_bounds(light, rng)
    q = shape(count, rng)
    motion = armctl.move_through(arm, q)
    assert motion.duration < sum(armctl.move_j(arm, a, b, straight=False).duration for a, b in itertools.pairwise(q))
    assert_passes(motion, q)


@pytest.mark.parametrize("count", some_of([20, 60, 200], [20, 60]))
def test_a_curve_that_touches_joint_limits_costs_no_more_than_others(light, count):
    """A spline through its waypoints leaves the limits between them."""
    arm = with_bounds(light, 3.14, 25.0, 5e3)
    dense = curve(np.linspace(0.0, 1.0, 100_001), np.random.default_rng(4))
    q = curve(np.linspace(0.0, 1.0, count), np.random.default_rng(4))
    arm = arm.with_limits(replace(arm.limits, q_min=dense.min(axis=0), q_max=dense.max(axis=0)))
    motion = armctl.move_through(arm, q)
    assert motion.duration <= 1.15 * least_time_of_curve(4)
    assert_passes(motion, q)


@pytest.mark.parametrize(("count", "share"), [(10, 0.7), (60, 0.3), pytest.param(200, 0.15, marks=pytest.mark.full)])
def test_dense_waypoints_that_rest_at_joint_limits_stay_inside(light, count, share):
    arm = with_bounds(light, 3.14, 25.0, 500.0)
    half = np.full(N, 0.5)
    arm = arm.with_limits(replace(arm.limits, q_min=-half, q_max=half))
    q = arm.limits.clamp(1.5 * curve(np.linspace(0.0, 1.0, count), np.random.default_rng(2)))
    assert (np.abs(q) == 0.5).sum() > count
    motion = armctl.move_through(arm, q)
    stopping = sum(armctl.move_j(arm, a, b, straight=False).duration for a, b in itertools.pairwise(q))
    assert_passes(motion, q)
    assert motion.duration < share * stopping


def test_dense_waypoints_keep_torque_limits_and_cost_no_more_than_move_j_along_a_line(bundled):
    arm = bundled.with_payload(0.5)
    q = arm.home + np.linspace(0.0, 1.0, 60)[:, None] * np.array([1.2, -0.8, 0.6])
    needed = armctl.check_torque(arm, armctl.move_through(arm, q)).ratio
    weak = arm.with_limits(replace(arm.limits, tau_max=0.7 * needed * arm.limits.tau_max))
    motion = armctl.move_through(weak, q)
    assert motion.slowed is not None
    assert armctl.check_torque(weak, motion).ok
    assert motion.duration <= 1.01 * armctl.move_j(weak, q[0], q[-1]).duration


@pytest.mark.parametrize("seed", [0, 3, 13, 21, 29])
def test_a_slow_section_of_dense_waypoints_is_slow_and_the_others_are_not(light, seed):
    arm = with_bounds(light, 3.14, 25.0, 5e3)
    q = curve(np.linspace(0.0, 1.0, 60), np.random.default_rng(seed))
    plain = armctl.move_through(arm, q)
    slow = armctl.move_through(arm, [Via(row, speed=0.25) if 20 < k <= 40 else Via(row) for k, row in enumerate(q)])
    spent = [np.diff([passed(motion, q[k]) for k in (0, 20, 40, 59)]) for motion in (plain, slow)]
    assert spent[1][1] == pytest.approx(4 * spent[0][1], rel=0.02)
    assert spent[1][1] >= 4 * spent[0][1] - 1e-6
    assert spent[1][[0, 2]] == pytest.approx(spent[0][[0, 2]], rel=0.35)


def passed(motion: armctl.JointTrajectory, point: np.ndarray) -> float:
    """s, when a motion is nearest to a point."""
    times = np.linspace(0.0, motion.duration, 20_001)
    return float(times[np.abs(motion.sample(times).q - point).max(axis=1).argmin()])


def test_the_same_dense_waypoints_give_the_same_bits(light):
    arm = with_bounds(light, 3.14, 25.0, 500.0)
    q = curve(np.linspace(0.0, 1.0, 40), np.random.default_rng(5))
    one = armctl.move_through(arm, q)
    other = armctl.move_through(arm, q)
    assert one.knots.tobytes() == other.knots.tobytes()
    assert one.coefficients.tobytes() == other.coefficients.tobytes()


def test_lengths_along_uneven_waypoints_of_a_circle_are_those_of_its_arc(light):
    arm = with_bounds(light, 1.0, 25.0, 500.0)
    angle = np.cumsum([0.0, 0.1, 0.15, 0.2, 0.1, 0.3, 0.25, 0.1, 0.2])
    circle = np.zeros((len(angle), N))
    circle[:, 0] = 2.0 * np.cos(angle)
    circle[:, 1] = 2.0 * np.sin(angle)
    assert arc_lengths(circle, arm.limits) == pytest.approx(2.0 * angle, abs=1e-4)


def test_runs_end_at_corners_only():
    u = np.linspace(0.0, 1.0, 11)[:, None]
    corner = np.vstack([u * [1.0, 2.0], [1.0, 2.0] + u[1:] * [0.5, -1.0]])
    assert straight_runs(corner).tolist() == [0, 10, 20]
    assert straight_runs(np.vstack([corner[:11], corner[9::-1]])).tolist() == [0, 10, 20]
    arc = np.hstack([np.cos(1e-4 * np.arange(9)[:, None]), np.sin(1e-4 * np.arange(9)[:, None])])
    assert straight_runs(arc).tolist() == list(range(9))
    assert straight_runs(corner[:2]).tolist() == [0, 1]
