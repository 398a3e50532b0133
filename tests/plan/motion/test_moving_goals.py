"""Goals in motion, as on a conveyor: judged by ruckig itself, by the roots of the polynomials, and by their end states."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from light_arms import by_ruckig_alone, light_arm, with_bounds
from motion_check import violation

import armctl

N = 3


@pytest.fixture(scope="module")
def light(tmp_path_factory) -> armctl.Arm:
    return light_arm(tmp_path_factory.mktemp("arm"), N)


def random_arm(arm: armctl.Arm, rng: np.random.Generator) -> armctl.Arm:
    return with_bounds(arm, rng.uniform(0.5, 5, N), rng.uniform(2, 20, N), rng.uniform(20, 500, N))


def random_state(limits: armctl.Limits, rng: np.random.Generator) -> armctl.Setpoint:
    """A state that the limits allow before and after it: |v| + a^2 / 2 J <= v_max."""
    a = rng.uniform(-0.8, 0.8, N) * limits.a_max
    room = limits.v_max - a**2 / (2 * limits.j_max)
    a = np.where(room > 0.0, a, 0.0)
    v = rng.uniform(-0.95, 0.95, N) * np.where(room > 0.0, room, limits.v_max)
    return armctl.Setpoint(rng.uniform(-2, 2, N), v, a)


def assert_joins(motion, start: armctl.Setpoint, goal: armctl.Setpoint) -> None:
    for planned, given in ((motion(0.0), start), (motion(motion.duration), goal)):
        for value, wanted, tolerance in zip(planned[:3], given[:3], (1e-11, 1e-8, 1e-6), strict=True):
            assert np.allclose(value, wanted, rtol=0.0, atol=tolerance)


def test_a_move_to_a_goal_in_motion_takes_as_long_as_ruckigs(light):
    rng = np.random.default_rng(1)
    for _ in range(150):
        arm = random_arm(light, rng)
        start = random_state(arm.limits, rng)
        goal = random_state(arm.limits, rng)
        motion = armctl.move_j(arm, start, goal, straight=False)
        assert motion.duration == pytest.approx(by_ruckig_alone(arm.limits, start, goal), rel=1e-9)
        assert_joins(motion, start, goal)
        assert not violation(motion, arm.limits)


def test_a_straight_move_ends_in_motion_along_its_line(light):
    """From rest to a speed v over a way: the direction is the way's, and nothing leaves the line."""
    q = np.array([0.1, -0.2, 0.3])
    way = np.array([0.5, 0.25, -0.5])
    goal = armctl.Setpoint(q + way, 0.4 * way, np.zeros(N))
    motion = armctl.move_j(light, q, goal)
    assert_joins(motion, armctl.Setpoint(q, np.zeros(N), np.zeros(N)), goal)
    off = motion.sample(np.linspace(0.0, motion.duration, 200)).q - q
    along = off @ way / (way @ way)
    assert np.abs(off - along[:, None] * way).max() < 1e-12
    assert not violation(motion, light.limits)
    assert "does not end at rest" in str(motion.check_limits())


def test_a_straight_move_to_a_velocity_off_its_line_is_refused(light):
    goal = armctl.Setpoint(np.full(N, 0.5), np.array([0.3, 0.3, -0.3]), np.zeros(N))
    with pytest.raises(armctl.InputError, match="q_goal: its velocity leads off the straight line"):
        armctl.move_j(light, np.zeros(N), goal)
    assert armctl.move_j(light, np.zeros(N), goal, straight=False).duration > 0.0


def test_goals_beyond_a_limit_are_refused(light):
    zero = np.zeros(N)
    bounds = light.limits
    with pytest.raises(armctl.LimitError, match=r"q_goal\.v: .* needs 150 % of its limit"):
        armctl.move_j(light, zero, armctl.Setpoint(zero + 1.0, 1.5 * bounds.v_max, zero), straight=False)
    with pytest.raises(armctl.LimitError, match=r"q_goal\.a: .* needs 150 % of its limit"):
        armctl.move_j(light, zero, armctl.Setpoint(zero + 1.0, zero, 1.5 * bounds.a_max), straight=False)
    with pytest.raises(armctl.InputError, match=r"q_goal\.v: "):
        armctl.move_j(light, zero, armctl.Setpoint(zero, np.zeros(2), zero), straight=False)


def test_a_goal_after_which_no_stop_is_possible_is_refused():
    arm = arm_of("robot_arm_3dof")
    near = arm.limits.q_max - 1e-3
    goal = armctl.Setpoint(near, 0.5 * arm.limits.v_max, np.zeros(N))
    with pytest.raises(armctl.LimitError, match="q_goal: the arm cannot stop inside its position limits after this goal"):
        armctl.move_j(arm, arm.home, goal, straight=False)
    with pytest.raises(armctl.LimitError, match="q: the arm cannot stop inside its position limits after this goal"):
        armctl.OnlineMotion(arm, arm.home).go_to(goal)


@pytest.mark.parametrize("name", ["robot_arm_3dof", "redundant"])
def test_no_move_to_a_goal_in_motion_leaves_the_joint_limits(name):
    arm = arm_of(name)
    limits = arm.limits
    rng = np.random.default_rng(2)
    planned = 0
    for _ in range(60):
        goal = armctl.Setpoint(rng.uniform(limits.q_min, limits.q_max), rng.uniform(-0.6, 0.6) * limits.v_max, np.zeros(arm.n))
        try:
            motion = armctl.move_j(arm, rng.uniform(limits.q_min, limits.q_max), goal, straight=False)
        except (armctl.LimitError, armctl.PlanError):
            continue
        planned += 1
        assert not violation(motion, limits)
        assert armctl.check_torque(arm, motion).ok
    assert planned > 20


def test_an_online_motion_passes_a_goal_in_motion_and_stops_behind_it():
    arm = arm_of("redundant")
    motion = armctl.OnlineMotion(arm, arm.home)
    v = 0.3 * arm.limits.v_max
    motion.go_to(armctl.Setpoint(arm.home + 0.2, v, np.zeros(arm.n)))
    at_goal = motion.time_to_goal
    assert motion.time_left > at_goal > 0.0
    whole = armctl.JointTrajectory(*motion.pieces, arm.joint_names, arm.limits)
    assert not violation(whole, arm.limits)
    assert whole.duration == pytest.approx(motion.time_left, abs=1e-12)
    there = motion.step(at_goal)
    assert np.allclose(there.q, arm.home + 0.2, atol=1e-7)
    assert np.allclose(there.v, v, atol=1e-6)
    behind = motion.step(0.01)
    assert (behind.q > there.q).all()
    motion.step(motion.time_left)
    assert np.abs(motion.setpoint.v).max() < 1e-9
    assert motion.time_to_goal == 0.0


def test_an_online_motion_that_hunts_a_belt_keeps_every_limit_and_catches_it():
    """The goal is set again at every tick to where the belt is then, with its velocity: the arm follows a few ticks behind."""
    arm = arm_of("redundant")
    dt = 1e-3
    v = 0.1 * arm.limits.v_max
    motion = armctl.OnlineMotion(arm, arm.home)
    samples = []
    for k in range(1500):
        motion.go_to(armctl.Setpoint(arm.home - 0.05 + k * dt * v, v, np.zeros(arm.n)))
        samples.append(motion.step(dt)[:3])
    q, speed, acceleration = (np.array(x) for x in zip(*samples, strict=True))
    assert np.abs(q[-1] - (arm.home - 0.05 + 1500 * dt * v)).max() <= 3 * dt * v.max()
    assert (np.abs(speed) <= arm.limits.v_max * (1 + 1e-9)).all()
    assert (np.abs(acceleration) <= arm.limits.a_max * (1 + 1e-9)).all()
    assert (np.abs(np.diff(acceleration, axis=0)) <= 1.0001 * dt * arm.limits.j_max).all()
    motion.go_to(arm.home)
    motion.step(motion.time_left)
    assert np.allclose(motion.setpoint.q, arm.home, atol=1e-9)


def test_a_motor_too_weak_for_a_goal_in_motion_is_given_more_time_or_refused():
    arm = arm_of("robot_arm_3dof")
    goal = armctl.Setpoint(arm.home + 0.6, 0.3 * arm.limits.v_max, np.zeros(N))
    free = armctl.move_j(arm, arm.home, goal, straight=False)
    need = armctl.check_torque(arm, free)
    weak = arm.with_limits(replace(arm.limits, tau_max=0.999 * np.array(need.ratios) * arm.limits.tau_max))
    motion = armctl.move_j(weak, arm.home, goal, straight=False)
    assert armctl.check_torque(weak, motion).ok
    assert motion.slowed is not None
    assert motion.duration > free.duration
    weaker = arm.with_limits(replace(arm.limits, tau_max=1e-3 * arm.limits.tau_max))
    with pytest.raises(armctl.PlanError, match="a motion that ends moving cannot be slowed down at its end"):
        armctl.move_j(weaker, arm.home, goal, straight=False)


@pytest.mark.parametrize(("name", "hint"), [("target_velocity", r"go_to\(armctl.Setpoint\(q, v, a\)\)"), ("update", "step")])
def test_names_of_ruckig_are_answered_with_a_hint(name, hint):
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(AttributeError, match=f"OnlineMotion has no attribute '{name}'; use motion.{hint}"):
        getattr(armctl.OnlineMotion(arm, arm.home), name)
