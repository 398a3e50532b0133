"""Online motion: a new goal at any tick, every limit kept, and a stop at any time."""

import numpy as np
import pytest
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
