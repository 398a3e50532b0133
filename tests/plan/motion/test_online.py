"""Online motion: a new goal at any tick, every limit kept, and a stop at any time."""

from dataclasses import replace

import numpy as np
import pytest
import ruckig
from arms import arm_of
from hypothesis import given, settings
from hypothesis import strategies as st

import armctl

DT = 1e-3


def run(motion: armctl.OnlineMotion, ticks: int):
    return [motion.step(DT)[:3] for _ in range(ticks)]


def assert_inside(arm, samples) -> None:
    q, v, a = (np.array(x) for x in zip(*samples, strict=True))
    limits = arm.limits
    assert limits.contains(q, 1e-9)
    assert (np.abs(v) <= limits.v_max * (1 + 1e-9)).all()
    assert (np.abs(a) <= limits.a_max * (1 + 1e-9)).all()
    assert (np.abs(np.diff(a, axis=0)) <= 1.0001 * DT * limits.j_max).all()
    assert (np.abs(np.diff(q, axis=0) / DT - 0.5 * (v[1:] + v[:-1])) <= 1e-6 * limits.j_max).all()


def test_it_arrives_at_rest():
    arm = arm_of("redundant")
    motion = armctl.OnlineMotion(arm, arm.home)
    goal = arm.home + 0.2
    motion.go_to(goal)
    run(motion, int(motion.time_left / DT) + 2)
    assert np.allclose(motion.setpoint.q, goal, atol=1e-9)
    assert np.abs(motion.setpoint.v).max() < 1e-9
    assert motion.time_left == 0.0


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), every=st.integers(1, 400))
def test_new_goals_at_any_tick_keep_every_limit(seed, every):
    arm, rng = arm_of("redundant"), np.random.default_rng(seed)
    motion, samples = armctl.OnlineMotion(arm, arm.home), []
    for _ in range(8):
        corner = np.where(rng.random(7) < 0.5, arm.limits.q_min, arm.limits.q_max)
        motion.go_to(corner if rng.random() < 0.6 else rng.uniform(arm.limits.q_min, arm.limits.q_max))
        samples += run(motion, every)
    motion.stop()
    samples += run(motion, int(motion.time_left / DT) + 2)
    assert_inside(arm, samples)
    assert np.abs(motion.setpoint.v).max() < 1e-9


def test_it_takes_over_a_motion_under_way():
    arm = arm_of("redundant")
    under_way = armctl.move_j(arm, arm.home, arm.home + 0.4)
    now = under_way(0.4 * under_way.duration)
    motion = armctl.OnlineMotion(arm, now)
    assert np.allclose(motion.setpoint.v, now.v)
    motion.go_to(arm.home)
    assert_inside(arm, [now[:3], *run(motion, 2000)])
    assert np.allclose(motion.setpoint.q, arm.home, atol=1e-9)


def test_without_a_goal_it_comes_to_rest():
    arm = arm_of("robot_arm_3dof")
    motion = armctl.OnlineMotion(arm, armctl.Setpoint(arm.home, 0.1 * arm.limits.v_max, np.zeros(3)))
    assert motion.goal is None
    run(motion, 3000)
    assert np.abs(motion.setpoint.v).max() < 1e-9


def test_starts_and_goals_outside_the_limits_are_refused():
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(armctl.LimitError, match="q_start: the arm cannot stop inside its position limits"):
        armctl.OnlineMotion(arm, armctl.Setpoint(arm.limits.q_max - 1e-4, np.array([0.5, 0.0, 0.0]), np.zeros(3)))
    with pytest.raises(armctl.LimitError, match="q_start: the arm cannot stop inside its position limits"):
        armctl.OnlineMotion(arm, armctl.Setpoint(arm.home, np.zeros(3), np.array([1e9, 0.0, 0.0])))
    motion = armctl.OnlineMotion(arm, arm.home)
    with pytest.raises(armctl.LimitError, match="q: shoulder_yaw: 9 rad is outside"):
        motion.go_to([9.0, 0.0, -1.0])
    with pytest.raises(armctl.InputError, match="nan"):
        motion.go_to([np.nan, 0.0, -1.0])


@pytest.mark.parametrize("dt", [-1e-3, np.nan, np.inf])
def test_a_tick_that_is_no_time_is_refused_and_changes_nothing(dt):
    arm = arm_of("robot_arm_3dof")
    motion = armctl.OnlineMotion(arm, arm.home)
    motion.go_to(arm.home + 0.1)
    before = motion.step(0.01)
    with pytest.raises(armctl.InputError, match=r"dt: expected a (finite )?number"):
        motion.step(dt)
    assert np.array_equal(motion.setpoint.q, before.q)


def test_a_goal_in_numbers_and_one_in_an_array_are_the_same():
    arm = arm_of("robot_arm_3dof")
    ends = []
    for goal in (arm.home + 0.1, (arm.home + 0.1).tolist()):
        motion = armctl.OnlineMotion(arm, arm.home)
        motion.go_to(goal)
        ends.append(motion.step(0.1).q)
    assert np.array_equal(*ends)


# Velocity control


def velocity_time_of_ruckig(arm, start: armctl.Setpoint, v: np.ndarray) -> float:
    """s, that ruckig's own velocity interface needs."""
    problem = ruckig.InputParameter(arm.n)
    problem.control_interface = ruckig.ControlInterface.Velocity
    problem.current_position, problem.current_velocity, problem.current_acceleration = (x.tolist() for x in start[:3])
    problem.target_velocity = v.tolist()
    problem.max_acceleration = arm.limits.a_max.tolist()
    problem.max_jerk = arm.limits.j_max.tolist()
    motion = ruckig.Trajectory(arm.n)
    ruckig.Ruckig(arm.n).calculate(problem, motion)
    return motion.duration


@pytest.mark.parametrize("seed", range(5))
def test_a_velocity_is_reached_as_fast_as_possible_and_kept(seed):
    arm = arm_of("redundant")
    rng = np.random.default_rng(seed)
    motion = armctl.OnlineMotion(arm, 0.5 * (arm.limits.q_min + arm.limits.q_max))
    samples = []
    for _ in range(3):  # each new velocity from the middle of reaching the one before
        v = 0.3 * rng.uniform(-1, 1, arm.n) * arm.limits.v_max
        now = motion.setpoint
        needed = velocity_time_of_ruckig(arm, now, v)
        motion.go_at(v)
        samples += run(motion, max(1, int(0.7 * needed / DT)))
    motion.go_at(v)
    needed = velocity_time_of_ruckig(arm, motion.setpoint, v)
    before = motion.step(0.95 * needed)
    assert not np.allclose(before.v, v, rtol=0.0, atol=1e-5)
    for _ in range(20):
        point = motion.step(0.06 * needed)
        assert np.allclose(point.v, v, atol=1e-7)
        assert np.allclose(point.a, 0.0, atol=1e-6)
    assert_inside(arm, samples)


def test_a_joint_at_a_velocity_comes_to_rest_at_its_position_limit():
    arm = arm_of("redundant")
    motion = armctl.OnlineMotion(arm, arm.home)
    v = 0.5 * arm.limits.v_max * np.where(np.arange(arm.n) % 2, 1.0, -1.0)
    v[2] = 0.0
    motion.go_at(v)
    samples = run(motion, int(motion.time_left / DT) + 2)
    assert_inside(arm, samples)
    assert motion.goal is None
    end = motion.setpoint
    assert np.abs(end.v).max() < 1e-9
    expected = np.where(v > 0, arm.limits.q_max, np.where(v < 0, arm.limits.q_min, arm.home))
    assert np.allclose(end.q, expected, atol=1e-8)
    motion.go_at(v)  # into the limits, where the arm is already
    assert np.allclose(motion.step(0.1).q, expected, atol=1e-8)
    motion.go_at(-v)
    assert np.allclose(motion.step(0.5).v, -v, atol=1e-7)
    whole = armctl.JointTrajectory(*motion.pieces, arm.joint_names, arm.limits)
    assert whole.check_limits().ok
    assert whole.duration == pytest.approx(motion.time_left)


def test_a_velocity_that_a_joint_cannot_reach_before_its_limit_keeps_all_limits():
    arm = arm_of("redundant")
    near = np.array(arm.home)
    near[0] = arm.limits.q_max[0] - 1e-3
    motion = armctl.OnlineMotion(arm, near)
    v = 0.4 * arm.limits.v_max
    motion.go_at(v)
    samples = run(motion, 300)
    assert_inside(arm, samples)
    assert samples[-1][0][0] == pytest.approx(arm.limits.q_max[0], abs=1e-8)
    assert np.allclose(samples[-1][1][1:], v[1:], atol=1e-7)


def test_velocities_beyond_the_limits_are_refused_and_change_nothing():
    arm = arm_of("robot_arm_3dof")
    motion = armctl.OnlineMotion(arm, arm.home)
    with pytest.raises(armctl.LimitError, match=r"v: .* is beyond its limit"):
        motion.go_at(1.1 * arm.limits.v_max)
    with pytest.raises(armctl.InputError, match="v: expected 3 numbers"):
        motion.go_at([0.1])
    assert motion.time_left == 0.0


def test_a_motion_brakes_into_limits_that_are_lowered_on_the_way():
    """As when a person comes near: another motion with the lower limits goes on from the setpoint, and brakes first."""
    arm = arm_of("redundant")
    motion = armctl.OnlineMotion(arm, arm.home)
    v = 0.6 * arm.limits.v_max
    motion.go_at(v)
    motion.step(0.4)
    assert np.allclose(motion.setpoint.v, v, atol=1e-7)
    lower = replace(arm.limits, v_max=0.25 * arm.limits.v_max)
    slow = armctl.OnlineMotion(arm.with_limits(lower), motion.setpoint)
    slow.go_at(lower.v_max)
    samples = run(slow, 400)
    assert_inside(arm, samples)
    speeds = np.abs(np.array([point[1] for point in samples]))
    braked = velocity_time_of_ruckig(arm, motion.setpoint, lower.v_max)
    late = speeds[int(1.5 * braked / DT) + 1 :]
    assert (late <= lower.v_max * (1 + 1e-6)).all()
    assert np.allclose(samples[-1][1], lower.v_max, atol=1e-7)


def braking_time(v: float, v_max: float, a_max: float, j_max: float) -> float:
    """s, the shortest time from a steady velocity down to a lower one, where the arm may still decelerate."""
    ramp = a_max / j_max
    rest = v - v_max - 0.5 * j_max * ramp**2
    return ramp + rest / a_max if rest > 0.0 else np.sqrt(2.0 * (v - v_max) / j_max)


@pytest.mark.parametrize("share", [0.5, 0.1])
def test_lowered_limits_are_kept_after_the_shortest_braking_and_the_goal_is_still_reached(share):
    arm = arm_of("redundant")
    v = np.zeros(arm.n)
    v[0] = arm.limits.v_max[0]
    motion = armctl.OnlineMotion(arm, armctl.Setpoint(0.5 * (arm.limits.q_min + arm.limits.q_max), v, np.zeros(arm.n)))
    goal = np.array(motion.setpoint.q)
    goal[0] = arm.limits.q_max[0]
    motion.go_to(goal)
    assert motion.step(DT).v[0] > 0.99 * arm.limits.v_max[0]
    lower = replace(arm.limits, v_max=share * arm.limits.v_max)
    start = motion.setpoint
    slow = motion.with_limits(lower)
    assert slow.setpoint.q[0] == start.q[0]
    assert slow.setpoint.v[0] == start.v[0]
    fastest = braking_time(start.v[0], lower.v_max[0], lower.a_max[0], lower.j_max[0])
    begin = run(slow, int(0.95 * fastest / DT))
    assert begin[-1][1][0] > lower.v_max[0]
    rest = run(slow, int(slow.time_left / DT) + 2)
    settled = rest[int(0.1 * fastest / DT) + 3 :]
    assert_inside(arm.with_limits(lower), settled)
    assert_inside(arm, [*begin, *rest])
    assert np.allclose(slow.setpoint.q, goal, atol=1e-9)
    assert motion.setpoint.q[0] == start.q[0]  # the motion before is unchanged


def test_with_limits_keeps_a_velocity_as_far_as_it_is_allowed_and_a_goal_in_motion():
    arm = arm_of("redundant")
    low = arm.with_limits(replace(arm.limits, v_max=0.3 * arm.limits.v_max)).limits
    motion = armctl.OnlineMotion(arm, 0.5 * (arm.limits.q_min + arm.limits.q_max))
    motion.go_at(0.5 * arm.limits.v_max)
    motion.step(0.2)
    slow = motion.with_limits(low)
    assert np.allclose(slow.step(0.3).v, low.v_max, atol=1e-7)
    standing = armctl.OnlineMotion(arm, arm.home).with_limits(low)
    assert standing.goal is None
    assert standing.time_left == 0.0
    wanted = armctl.Setpoint(arm.home + 0.2, 0.1 * low.v_max, np.zeros(arm.n))
    motion = armctl.OnlineMotion(arm, arm.home)
    motion.go_to(wanted)
    slow = motion.with_limits(low)
    passing = slow.step(slow.time_to_goal)
    assert np.allclose(passing.q, wanted.q, atol=1e-8)
    assert np.allclose(passing.v, wanted.v, atol=1e-7)


def test_limits_that_the_arm_cannot_keep_are_refused_and_change_nothing():
    arm = arm_of("redundant")
    motion = armctl.OnlineMotion(arm, arm.home)
    motion.go_to(arm.home + 0.2)
    motion.step(0.05)
    narrow = replace(arm.limits, q_max=np.maximum(arm.home + 0.1, arm.limits.q_min))
    with pytest.raises(armctl.LimitError):
        motion.with_limits(narrow)
    with pytest.raises(armctl.InputError, match="limits: expected"):
        motion.with_limits(arm_of("robot_arm_3dof").limits)
    run(motion, int(motion.time_left / DT) + 2)
    assert np.allclose(motion.setpoint.q, arm.home + 0.2, atol=1e-9)
