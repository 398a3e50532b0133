"""Motions from the last moments of another one and from states beyond the limits, judged by closed forms and ruckig alone."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from light_arms import by_ruckig_alone, light_arm, with_bounds
from motion_check import violation

import armctl

N = 3
LEFT_S = (3e-2, 1e-2, 4e-3, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
SHARES = (1.0001, 1.01, 1.5, 3.0)


@pytest.fixture(scope="module")
def light(tmp_path_factory) -> armctl.Arm:
    return light_arm(tmp_path_factory.mktemp("arm"), N)


def at_rest(q: np.ndarray) -> armctl.Setpoint:
    return armctl.Setpoint(q, np.zeros(N), np.zeros(N))


def random_arm(arm: armctl.Arm, rng: np.random.Generator) -> armctl.Arm:
    return with_bounds(arm, rng.uniform(0.5, 5, N), rng.uniform(2, 20, N), rng.uniform(20, 500, N))


def assert_joins(motion, start: armctl.Setpoint, goal: np.ndarray) -> None:
    """A straight motion may turn a start that is off the line by 1e-6 of a limit into the line."""
    tolerances = (1e-9, 1e-6 * motion.limits.v_max.max(), 1e-6 * motion.limits.a_max.max())
    for planned, given, tolerance in zip(motion(0.0)[:3], start[:3], tolerances, strict=True):
        assert np.allclose(planned, given, rtol=1e-9, atol=tolerance)
    end = motion(motion.duration)
    assert np.allclose(end.q, goal, rtol=0.0, atol=1e-12)
    assert np.abs(end.v).max() < 1e-9
    assert np.abs(end.a).max() < 1e-6


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("left", LEFT_S)
def test_a_move_starts_in_the_last_moments_of_another_one_and_takes_as_long_as_it_had_left(light, straight, left):
    """Rounding of the position by 2e-16 rad at a jerk of 20 rad/s^3 takes 4 (1e-17)^(1/3) = 1e-5 s to correct."""
    rng = np.random.default_rng(1)
    for _ in range(15):
        arm = random_arm(light, rng)
        q = rng.uniform(-1, 1, N)
        goal = q + rng.normal(0, 0.3, N)
        whole = armctl.move_j(arm, q, goal, straight=straight)
        start = whole(whole.duration - left)
        motion = armctl.move_j(arm, start, goal, straight=straight)
        assert motion.duration <= left * (1 + 1e-5) + 3e-5
        assert_joins(motion, start, goal)
        assert not violation(motion, arm.limits)


@pytest.mark.parametrize("left", LEFT_S)
def test_a_goal_that_moves_a_little_in_the_last_moments_is_reached(light, left):
    rng = np.random.default_rng(2)
    for _ in range(15):
        arm = random_arm(light, rng)
        q = rng.uniform(-1, 1, N)
        goal = q + rng.normal(0, 0.3, N)
        whole = armctl.move_j(arm, q, goal)
        start = whole(whole.duration - left)
        moved = goal + 1e-4 * rng.normal(size=N)
        motion = armctl.move_j(arm, start, moved, straight=False)
        assert motion.duration == pytest.approx(by_ruckig_alone(arm.limits, start, at_rest(moved)), rel=2e-3, abs=1e-6)
        assert_joins(motion, start, moved)
        assert not violation(motion, arm.limits)


def least_bounds(limits: armctl.Limits, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The limits of velocity and acceleration, but where a state is beyond one what no motion from there can avoid.

    The largest jerk J ends an acceleration a at the velocity v + a |a| / 2 J.
    """
    coasting = np.abs(v + a * np.abs(a) / (2 * limits.j_max))
    return np.maximum(limits.v_max, np.maximum(np.abs(v), coasting)), np.maximum(limits.a_max, np.abs(a))


def least_excess(limits: armctl.Limits, start: armctl.Setpoint) -> armctl.Limits:
    v_max, a_max = least_bounds(limits, start.v, start.a)
    return replace(limits, v_max=v_max, a_max=a_max)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("what", ["velocity", "acceleration", "both"])
def test_a_start_beyond_a_limit_is_braked_into_it_as_fast_as_possible(light, share, what):
    rng = np.random.default_rng(3)
    for _ in range(20):
        arm = random_arm(light, rng)
        limits = arm.limits
        sign = np.where(rng.uniform(size=N) < 0.5, -1.0, 1.0)
        v = sign * limits.v_max * (share if what != "acceleration" else rng.uniform(0, 0.5))
        a = sign * limits.a_max * (share if what != "velocity" else 0.0)
        start = armctl.Setpoint(rng.uniform(-1, 1, N), v, a)
        goal = rng.normal(0, 2, N)
        motion = armctl.move_j(arm, start, goal, straight=False)
        assert motion.duration == pytest.approx(by_ruckig_alone(arm.limits, start, at_rest(goal)), rel=1e-6)
        assert_joins(motion, start, goal)
        assert not violation(motion, least_excess(limits, start))
        # Within the time in which the jerk can turn the acceleration and brake the excess, the motion is inside for good.
        excess = least_excess(limits, start).v_max - limits.v_max
        turn = (np.abs(a) + limits.a_max) / limits.j_max
        inside = float((turn + excess / limits.a_max + limits.a_max / limits.j_max).max())
        later = motion.sample(np.linspace(min(inside, motion.duration), motion.duration, 2000))
        assert (np.abs(later.v) <= limits.v_max * (1 + 1e-6)).all()
        assert (np.abs(later.a) <= limits.a_max * (1 + 1e-6)).all()


@pytest.mark.parametrize("room", [1e-6, 1e-3, 0.02])
def test_a_start_inside_the_limits_whose_acceleration_leads_beyond_one_exceeds_it_by_the_least(light, room):
    """The largest jerk J ends an acceleration a at the velocity v + a^2 / 2 J; as ruckig, which solves all of them."""
    rng = np.random.default_rng(5)
    beyond = 0
    for _ in range(20):
        arm = random_arm(light, rng)
        limits = arm.limits
        sign = np.where(rng.uniform(size=N) < 0.5, -1.0, 1.0)
        v = sign * (1 - room) * limits.v_max
        a = sign * rng.uniform(0.3, 1.0, N) * limits.a_max
        start = armctl.Setpoint(rng.uniform(-1, 1, N), v, a)
        possible = least_excess(limits, start)
        beyond += (possible.v_max > limits.v_max).any()
        goal = rng.normal(0, 2, N)
        motion = armctl.move_j(arm, start, goal, straight=False)
        assert motion.duration == pytest.approx(by_ruckig_alone(arm.limits, start, at_rest(goal)), rel=1e-6)
        assert_joins(motion, start, goal)
        assert not violation(motion, possible)
    assert beyond > 10


def test_a_start_at_one_and_a_half_times_the_limit_takes_the_published_time(light):
    """Ruckig's public report 128: 0.167347 s."""
    arm = with_bounds(light, np.array([800.0, 1.0, 1.0]), np.array([4e4, 1.0, 1.0]), np.array([2e5, 1.0, 1.0]))
    start = armctl.Setpoint(np.array([1300.0, 0.0, 0.02]), np.array([1200.0, 0.0, 0.0]), np.zeros(N))
    motion = armctl.move_j(arm, start, np.array([1400.0, 0.0, 0.02]), straight=False)
    assert motion.duration == pytest.approx(0.167347, abs=1e-6)


@pytest.mark.parametrize("share", SHARES)
def test_online_motions_and_streams_start_beyond_a_limit_and_come_to_rest(light, share):
    rng = np.random.default_rng(4)
    for _ in range(5):
        arm = random_arm(light, rng)
        start = armctl.Setpoint(rng.uniform(-1, 1, N), share * arm.limits.v_max, -share * arm.limits.a_max)
        goal = rng.normal(0, 1, N)
        online = armctl.OnlineMotion(arm, start)
        online.go_to(goal)
        assert online.time_left == pytest.approx(by_ruckig_alone(arm.limits, start, at_rest(goal)), rel=1e-6)
        stream = armctl.Stream(arm, start)
        stream.push(0.0, goal)
        for source in (online, stream):
            ticks = int(source.time_left / 1e-3) + 2
            q, v, a = (np.array(rows) for rows in zip(start[:3], *(source.step(1e-3)[:3] for _ in range(ticks)), strict=True))
            v_max, a_max = least_bounds(arm.limits, v[:-1], a[:-1])
            assert (np.abs(v[1:]) <= v_max * (1 + 1e-6)).all()
            assert (np.abs(a[1:]) <= a_max * (1 + 1e-6)).all()
            assert np.abs(v[-1]).max() < 1e-6
            assert np.allclose(q[-1], goal, atol=1e-7)


@pytest.mark.parametrize("straight", [True, False])
def test_limits_may_fall_during_a_motion(light, straight):
    arm = with_bounds(light, np.full(N, 3.0), np.full(N, 3.0), np.full(N, 6.0))
    goal = np.array([10.0, 8.0, 5.0])
    whole = armctl.move_j(arm, np.zeros(N), goal)
    start = whole(2.0)
    low = arm.with_limits(replace(arm.limits, v_max=np.full(N, 1.0)))
    motion = armctl.move_j(low, start, goal, straight=straight)
    assert_joins(motion, start, goal)
    assert np.abs(motion.sample(np.linspace(2.0, motion.duration, 500)).v).max() <= 1.0 + 1e-6
    assert_joins(armctl.move_j(arm, start, goal, straight=straight, speed=0.4), start, goal)


def test_a_start_that_leaves_the_range_while_it_brakes_is_refused(light):
    """At full deceleration A from 1.5 times the limit, the way exceeds v^2 / 2 A."""
    arm = with_bounds(light, np.full(N, 1.0), np.full(N, 2.0), np.full(N, 1e3))
    v = np.array([1.5, 0.0, 0.0])
    way = 1.5**2 / (2 * 2.0) + 1.5 * 2.0 / 1e3 / 2
    for room, ok in ((way + 1e-2, True), (way - 1e-2, False)):
        near = arm.with_limits(replace(arm.limits, q_max=np.array([room, 9.0, 9.0])))
        start = armctl.Setpoint(np.zeros(N), v, np.zeros(N))
        for begin in (
            armctl.OnlineMotion,
            armctl.Stream,
            lambda arm, start: armctl.move_j(arm, start, np.zeros(N), straight=False),
        ):
            if ok:
                begin(near, start)
            else:
                with pytest.raises(armctl.LimitError, match="q_start"):
                    begin(near, start)


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("speed", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_a_moving_start_takes_gentler_limits_where_a_motor_would_saturate(light, share, speed, straight):
    """Motors that give a share of what the fastest motion takes; the torques are MuJoCo's inverse dynamics."""
    arm = with_bounds(light, np.full(N, 2.0), np.full(N, 10.0), np.full(N, 200.0))
    q = np.array([0.2, 0.5, -0.3])
    way = np.array([1.0, -0.6, 0.4])
    start = armctl.Setpoint(q, speed * way, np.zeros(N))
    fastest = armctl.move_j(arm, start, q + way, straight=straight)
    times = np.linspace(0.0, fastest.duration, 2000)
    held = torques(arm, fastest.sample(times[:1])._replace(v=np.zeros((1, N)), a=np.zeros((1, N))))[0]
    peak = np.abs(torques(arm, fastest.sample(times))).max(axis=0)
    still = np.max([np.abs(arm.gravity(row)) for row in fastest.sample(times).q], axis=0)
    weak = arm.with_limits(replace(arm.limits, tau_max=1.2 * still + share * (peak - still) + 0.02 * np.abs(held)))
    motion = armctl.move_j(weak, start, q + way, straight=straight)
    assert_joins(motion, start, q + way)
    assert not violation(motion, arm.limits)
    taken = torques(weak, motion.sample(np.linspace(0.0, motion.duration, 2000)))
    assert (np.abs(taken) <= weak.limits.tau_max * (1 + 1e-3)).all()
    assert motion.duration > fastest.duration
    assert motion.slowed is not None
    assert motion.slowed.factor == pytest.approx(motion.duration / fastest.duration)


def torques(arm: armctl.Arm, samples: armctl.Setpoint) -> np.ndarray:
    """(T, n) N m, at each of the samples."""
    data = mujoco.MjData(arm.model)
    found = []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(samples.q, samples.v, samples.a, strict=True):
        mujoco.mj_inverse(arm.model, data)
        found.append(data.qfrc_inverse.copy())
    return np.array(found)
