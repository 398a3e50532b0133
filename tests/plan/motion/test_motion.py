"""What holds for every planner on every arm: ends right, derivatives right, limits kept, torques within the motors' reach."""

import itertools
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arms import ARMS, arm_of, some_of
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import limb, motors

import armctl
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import piece_extremes, polynomial_extremes


def anywhere(arm: armctl.Arm, rng: np.random.Generator, share: float = 1.0) -> np.ndarray:
    """A configuration inside the limits, drawn to home by a share."""
    q = arm.limits.random(arm.home, 1, rng)[0]
    return arm.limits.clamp(arm.home + share * (q - arm.home))


def straight(arm, rng):
    q, goal = anywhere(arm, rng), anywhere(arm, rng)
    return armctl.move_j(arm, q, goal), q, goal


def together(arm, rng):
    q, goal = anywhere(arm, rng), anywhere(arm, rng)
    return armctl.move_j(arm, q, goal, straight=False), q, goal


def through(arm, rng):
    q = np.array([anywhere(arm, rng) for _ in range(4)])
    return armctl.move_through(arm, q), q[0], q[-1]


def line(arm, rng):
    for _ in range(20):
        q = anywhere(arm, rng, 0.6)
        way = arm.jacobian(q)[:3] @ rng.normal(size=arm.n)  # where the tip can go at all: a planar arm stays in its plane
        try:
            motion = armctl.move_l(arm, q, arm.fk(q).position + 0.03 * way / np.linalg.norm(way))
        except armctl.PlanError:
            continue
        return motion, q, motion.sample([motion.duration]).q[0]
    raise AssertionError("not one line of twenty can be planned")


PLANNERS = [straight, together, through, line]
every_planner = pytest.mark.parametrize("plan", PLANNERS, ids=lambda plan: plan.__name__)
every_arm = pytest.mark.parametrize("name", some_of(ARMS))
panda_or_bundled = pytest.mark.parametrize("name", ["robot_arm_3dof", "panda"])


def assert_lawful(motion: JointTrajectory) -> None:
    """Inside the limits by true extremes and by 1 kHz differences; v = dq/dt, a = dv/dt; continuous."""
    check = motion.check_limits()
    assert check.ok, str(check)
    times = np.arange(0.0, motion.duration, 1e-3)
    q, v, a = motion.sample(times)[:3]
    bounds = (motion.limits.v_max, motion.limits.a_max, motion.limits.j_max)
    for x, bound in zip((q, v, a), bounds, strict=True):
        assert (np.abs(np.diff(x, axis=0)) <= 1.001e-3 * bound).all()
    mean_v, mean_a = 0.5 * (v[1:] + v[:-1]), 0.5 * (a[1:] + a[:-1])
    trapezoid = 1e-6 / 12 * 1.01 * 3  # of the next derivative, which may jump once inside a step
    assert (np.abs(np.diff(q, axis=0) / 1e-3 - mean_v) <= 3 * trapezoid * motion.limits.j_max + 1e-9).all()
    assert (np.abs(np.diff(v, axis=0) / 1e-3 - mean_a) <= 0.26e-3 * motion.limits.j_max + 1e-9).all()
    before, after = piece_ends(motion)
    for order, (left, right) in enumerate(zip(before, after, strict=True)):
        assert np.allclose(left, right, atol=1e-7 * 100**order), order


def piece_ends(motion: JointTrajectory):
    """Position, velocity and acceleration at the inner knots, from the left and from the right."""
    h = np.diff(motion.knots)[:-1, None]
    c = motion.coefficients
    left = [
        sum(np.prod(np.arange(k - order + 1, k + 1)) * c[:-1, k] * h ** (k - order) for k in range(order, 6))
        for order in range(3)
    ]
    return left, [c[1:, 0], c[1:, 1], 2 * c[1:, 2]]


@every_arm
@every_planner
def test_a_motion_keeps_every_law(name, plan):
    arm = arm_of(name)
    motion, start, goal = plan(arm, np.random.default_rng(5))
    first, last = motion(0.0), motion(motion.duration)
    assert np.allclose(first.q, start, atol=1e-9)
    assert np.allclose(last.q, goal, atol=1e-7)
    for setpoint in (first, last):
        assert np.abs(setpoint.v).max() < 1e-6
        assert np.abs(setpoint.a).max() < 1e-4
    assert_lawful(motion)
    assert armctl.check_torque(arm, motion).ratio <= 1.0 + 1e-9


@panda_or_bundled
@every_planner
def test_one_instant_and_many_agree_and_outside_it_stands_still(name, plan):
    motion, *_ = plan(arm_of(name), np.random.default_rng(1))
    times = np.linspace(-0.1, motion.duration + 0.1, 57)
    many = motion.sample(times)
    for k, t in enumerate(times):
        one = motion(t)
        for x, y in zip(one[:3], many[:3], strict=True):
            assert np.allclose(x, y[k], atol=1e-12)
    assert not many.v[[0, -1]].any()
    # After the end it stands at the end to the bit; one instant and many are sums of different order, and agree to rounding.
    assert np.array_equal(motion(times[-1]).q, motion(motion.duration).q)
    assert np.array_equal(many.q[-1], motion.sample(np.append(times[:-1], motion.duration)).q[-1])
    assert np.allclose(many.q[-1], motion(motion.duration).q, rtol=0.0, atol=1e-14)


@panda_or_bundled
@every_planner
@settings(max_examples=8)
@given(factor=st.floats(0.05, 1.0))
def test_a_scaled_motion_takes_the_same_path_inside_the_limits(name, plan, factor):
    motion, *_ = plan(arm_of(name), np.random.default_rng(2))
    slow = motion.scaled(factor)
    assert slow.duration == pytest.approx(motion.duration / factor)
    assert slow.check_limits().ok
    times = np.linspace(0.0, motion.duration, 40)
    assert np.allclose(slow.sample(times / factor).q, motion.sample(times).q, atol=1e-10)


@panda_or_bundled
@every_planner
@settings(max_examples=8)
@given(share=st.floats(0.0, 1.0))
def test_a_stop_stays_on_the_path_and_inside_the_limits(name, plan, share):
    motion, *_ = plan(arm_of(name), np.random.default_rng(3))
    asked = share * motion.duration
    stop = motion.stopped_at(asked)
    assert stop.duration <= motion.duration + 1e-9
    last = stop(stop.duration)
    assert np.abs(last.v).max() < 1e-6
    assert np.abs(last.a).max() < 1e-4
    assert stop.check_limits().ok, str(stop.check_limits())
    until = np.linspace(0.0, asked, 20)
    assert np.allclose(stop.sample(until).q, motion.sample(until).q, atol=1e-9)
    for q in stop.sample(np.linspace(asked, stop.duration, 12)).q:
        assert distance_to_path(motion, q) < 1e-6


def distance_to_path(motion: JointTrajectory, q: np.ndarray) -> float:
    """How far a position is from the nearest on the path."""
    low, high = 0.0, motion.duration
    for _ in range(5):
        times = np.linspace(low, high, 401)
        away = np.abs(motion.sample(times).q - q).max(axis=1)
        k = int(away.argmin())
        low, high = times[max(k - 1, 0)], times[min(k + 1, 400)]
    return float(away.min())


def test_a_stop_in_the_middle_of_a_long_move_is_soon():
    arm = arm_of("robot_arm_3dof")
    motion = armctl.move_j(arm, [-3.0, 0.0, -1.0], [3.0, 0.0, -1.0])
    stop = motion.stopped_at(0.5 * motion.duration)
    braking = arm.limits.v_max[0] / arm.limits.a_max[0] + arm.limits.a_max[0] / arm.limits.j_max[0]
    assert stop.duration < 0.5 * motion.duration + 1.5 * braking


def test_a_straight_move_is_straight_and_as_fast_as_its_tightest_joint():
    rng = np.random.default_rng(4)
    for name in ("panda", "robot_arm_3dof"):
        arm = arm_of(name)
        lifted = untiring(arm)
        motion, start, goal = straight(lifted, rng)
        along = (goal - start) / np.linalg.norm(goal - start)
        away = motion.sample(np.linspace(0, motion.duration, 500)).q - start
        assert np.abs(away - (away @ along)[:, None] * along).max() < 1e-13
        worst = {peak.quantity: 0.0 for peak in motion.check_limits().peaks}
        for peak in motion.check_limits().peaks:
            worst[peak.quantity] = max(worst[peak.quantity], peak.ratio)
        assert worst["jerk"] == pytest.approx(1.0, abs=1e-9)
        assert max(worst["velocity"], worst["acceleration"]) == pytest.approx(1.0, abs=1e-9)
        assert armctl.move_j(lifted, start, goal, straight=False).duration <= motion.duration + 1e-9


def untiring(arm: armctl.Arm) -> armctl.Arm:
    return arm.with_limits(replace(arm.limits, tau_max=np.full(arm.n, np.inf)))


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 6), step=st.floats(0.01, 1.5))
def test_flowing_is_never_slower_than_stopping_and_meets_every_waypoint(seed, count, step):
    arm, rng = untiring(arm_of("robot_arm_3dof")), np.random.default_rng(seed)
    q = arm.limits.clamp(anywhere(arm, rng) + np.cumsum(rng.normal(0.0, step, (count, arm.n)), axis=0))
    flowing = armctl.move_through(arm, q)
    stopping = sum(armctl.move_j(arm, a, b, straight=False).duration for a, b in itertools.pairwise(q))
    assert flowing.duration <= stopping + 1e-9
    assert_lawful(flowing)
    passed = flowing.sample(flowing.knots).q
    assert all(np.abs(passed - point).max(axis=1).min() < 1e-7 for point in q)


def test_flowing_along_a_line_of_waypoints_does_not_stop():
    arm = untiring(arm_of("redundant"))
    q = arm.home + np.linspace(-0.5, 0.5, 6)[:, None] * np.array([1.0, 0.5, 0.2, 0.3, 0.4, 0.5, 0.1])
    straight_on = armctl.move_j(arm, q[0], q[-1], straight=False).duration
    assert armctl.move_through(arm, q).duration < 1.15 * straight_on


@pytest.mark.nightly
def test_one_joint_hardly_slows_down_at_waypoints_on_its_way(load):
    arm = untiring(load(limb("a", '<site name="tip" pos="0.1 0 0"/>'), motors("a")))
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(60):
        v_max, a_max, j_max = rng.uniform(0.5, 3.0, 1), rng.uniform(1.0, 15.0, 1), 10 ** rng.uniform(1.0, 4.0, 1)
        limits = replace(arm.limits, q_min=-np.array([9.0]), q_max=np.array([9.0]), v_max=v_max, a_max=a_max, j_max=j_max)
        quick = arm.with_limits(limits)
        q = np.cumsum(10 ** rng.uniform(-2.0, 0.0, (6, 1)), axis=0)
        direct = armctl.move_j(quick, q[0], q[-1]).duration
        forwards, backwards = (armctl.move_through(quick, sign * q).duration for sign in (1.0, -1.0))
        assert forwards == pytest.approx(backwards, rel=1e-3)
        shares.append(forwards / direct)
    assert min(shares) > 1.0 - 1e-9
    assert np.percentile(shares, 20) < 1.0001
    assert np.mean(shares) < 1.169


def test_flowing_past_a_joint_limit_slows_down_there_only():
    arm = untiring(arm_of("redundant"))
    rng, low, high = np.random.default_rng(4), arm.limits.q_min, arm.limits.q_max
    shares = []
    for _ in range(5):
        q = arm.limits.clamp(rng.uniform(low, high) + np.cumsum(rng.normal(0.0, 0.15, (10, arm.n)), axis=0))
        motion = armctl.move_through(arm, q)
        assert_lawful(motion)
        shares.append(
            motion.duration / sum(armctl.move_j(arm, a, b, straight=False).duration for a, b in itertools.pairwise(q))
        )
    assert max(shares) < 0.95


@pytest.mark.parametrize("apart", [1e-4, 1e-8, 1e-10, 1e-13])
def test_waypoints_next_to_each_other_are_met(apart):
    arm = arm_of("redundant")
    q = arm.home + np.array([0.0, apart, 0.1, 0.1 + apart, 0.0])[:, None]
    motion = armctl.move_through(arm, q)
    assert_lawful(motion)
    at_knots = motion.sample(motion.knots).q
    assert max(np.abs(at_knots - point).max(axis=1).min() for point in q) < 2e-8


def test_waypoints_at_a_joint_limit_and_twice_the_same_are_met():
    arm = arm_of("robot_arm_3dof")
    limits = arm.limits
    q = [arm.home, limits.q_max, limits.q_max, 0.5 * (limits.q_min + limits.q_max), limits.q_min]
    motion = armctl.move_through(arm, q)
    assert_lawful(motion)
    assert np.allclose(motion(motion.duration).q, limits.q_min, atol=1e-7)
    assert armctl.move_through(arm, [arm.home, arm.home]).duration == 0.0


def test_a_motion_to_where_the_arm_is_takes_no_time():
    arm = arm_of("redundant")
    for motion in (armctl.move_j(arm, arm.home, arm.home), armctl.move_l(arm, arm.home, arm.fk(arm.home))):
        assert motion.duration == 0.0
        assert np.array_equal(motion(0.0).q, arm.home)
        assert motion.sample([0.0, 1.0]).q.shape == (2, 7)
        assert motion.check_limits().ok


def test_the_same_waypoints_give_the_same_bits():
    arm, rng = arm_of("redundant"), np.random.default_rng(7)
    q = [anywhere(arm, rng) for _ in range(4)]
    one, two = armctl.move_through(arm, q), armctl.move_through(arm, q)
    assert np.array_equal(one.knots, two.knots)
    assert np.array_equal(one.coefficients, two.coefficients)


@pytest.mark.parametrize("way", [1.0, 0.1, 0.01, 1e-4, 1e-7, 1e-10])
def test_round_numbers_and_tiny_ways_can_be_planned(way):
    arm = arm_of("robot_arm_3dof")  # v 2, a 20, j 400: at 0.1 rad the phases of a profile just vanish
    for motion in (armctl.move_j(arm, arm.home, arm.home + way), armctl.move_through(arm, [arm.home, arm.home + way])):
        assert np.allclose(motion(motion.duration).q, arm.home + way, atol=1e-9)
        assert motion.check_limits().ok


# Starting in motion


def test_a_move_can_start_along_its_line():
    arm = arm_of("redundant")
    goal = arm.home + 0.4
    v = 0.3 * (goal - arm.home)
    motion = armctl.move_j(arm, armctl.Setpoint(arm.home, v, np.zeros(arm.n)), goal)
    assert np.allclose(motion(0.0).v, v)
    assert motion.duration < armctl.move_j(arm, arm.home, goal).duration
    assert_lawful(motion)


def test_a_start_that_cannot_be_kept_is_refused():
    arm = arm_of("robot_arm_3dof")
    zero = np.zeros(3)

    def start(v: list[float], a: np.ndarray = zero) -> armctl.Setpoint:
        return armctl.Setpoint(arm.limits.q_max - 1e-3, np.array(v), a)

    for off_line in (start([0.0, 0.1, 0.1]), start([0.0, 0.0, 0.0], np.array([0.0, 0.1, 0.1]))):
        with pytest.raises(armctl.InputError, match="off the straight line"):
            armctl.move_j(arm, off_line, arm.home)
    with pytest.raises(armctl.LimitError, match=r"q_start: shoulder_yaw: position .* limit"):
        armctl.move_j(arm, start([1.0, 0.0, 0.0]), arm.home, straight=False)
    with pytest.raises(armctl.LimitError, match=r"q_start: shoulder_yaw: position .* limit"):
        armctl.move_j(arm, start([99.0, 0.0, 0.0]), arm.home, straight=False)


@pytest.mark.parametrize("straight", [True, False])
def test_a_move_continues_a_motion_with_its_acceleration(straight: bool):
    arm = arm_of("robot_arm_3dof")
    whole = armctl.move_j(arm, arm.home, arm.home + 0.4)
    now = whole(0.1 * whole.duration)
    assert np.abs(now.a).max() > 1.0
    rest = armctl.move_j(arm, now, arm.home + 0.4, straight=straight)
    for before, started in zip(now[:3], rest(0.0)[:3], strict=True):
        assert np.allclose(started, before, atol=1e-9)
    assert rest.duration == pytest.approx(0.9 * whole.duration, rel=1e-6)
    assert_lawful(rest)


# Bad input


@pytest.mark.parametrize("plan", [armctl.move_j, lambda arm, a, b: armctl.move_through(arm, [a, b])], ids=["move_j", "through"])
def test_bad_positions_are_refused(plan):
    arm = arm_of("redundant")
    with pytest.raises(armctl.LimitError, match=r"j3: 2.5 rad is outside \[-2"):
        plan(arm, arm.home, [0.0, 0.0, 0.0, 2.5, 0.0, 0.0, 0.0])
    with pytest.raises(armctl.InputError):
        plan(arm, arm.home[:6], arm.home[:6])
    with pytest.raises(armctl.InputError, match="nan"):
        plan(arm, arm.home, np.full(7, np.nan))


def test_one_waypoint_is_too_few():
    arm = arm_of("redundant")
    with pytest.raises(armctl.InputError, match="expected at least 2"):
        armctl.move_through(arm, [arm.home])


def test_an_arm_without_a_jerk_limit_is_refused():
    arm = arm_of("redundant")
    endless = arm.with_limits(replace(arm.limits, j_max=np.full(7, np.inf)))
    with pytest.raises(armctl.InputError, match="j_max: j0 has no limit"):
        armctl.move_j(endless, arm.home, arm.home + 0.1)


# Torque


def weak(arm: armctl.Arm, share: float) -> armctl.Arm:
    """The arm with motors that give this share of what its fastest move takes beyond holding still."""
    return arm.with_limits(replace(arm.limits, tau_max=share * arm.limits.tau_max))


def peak_torques(arm: armctl.Arm, motion: JointTrajectory, share: float) -> np.ndarray:
    """(n,) torques that hold the arm still on the whole path, and a share of what the motion takes beyond that."""
    unit = arm.with_limits(replace(arm.limits, tau_max=np.ones(arm.n)))
    needed = np.array(armctl.check_torque(unit, motion).ratios)
    q = motion.sample(np.linspace(0.0, motion.duration, 400)).q
    pauses = [armctl.check_torque(unit, armctl.move_j(untiring(arm), x, x)).ratios for x in q]
    holding = 1.02 * np.max(pauses, axis=0)
    return np.maximum(holding + share * np.maximum(needed - holding, 0.0), 1e-3)


@every_planner
def test_a_motion_is_slowed_until_the_motors_can_follow_and_says_so(plan, load):
    arm = untiring(load(limb("a b c d", '<site name="tip" pos="0.1 0 0"/>'), motors("a b c d")))
    free, start, goal = plan(arm, np.random.default_rng(3))
    tired = arm.with_limits(replace(arm.limits, tau_max=peak_torques(arm, free, 0.5)))
    motion, *_ = plan(tired, np.random.default_rng(3))
    assert armctl.check_torque(tired, motion).ok
    assert_lawful(motion)
    assert np.allclose(motion(0.0).q, start, atol=1e-9)
    assert np.allclose(motion(motion.duration).q, goal, atol=1e-7)
    assert motion.slowed is not None
    assert motion.slowed.factor > 1
    assert motion.slowed.torque_ratio > 1
    assert motion.slowed.joint in arm.joint_names
    assert "times longer" in str(motion.slowed)


def test_a_slowed_move_stays_straight_and_slows_where_it_must_only():
    arm = arm_of("redundant")
    start, goal = arm.home - 0.3, arm.home + 0.3
    free = armctl.move_j(untiring(arm), start, goal)
    need = armctl.check_torque(arm, free)
    i = int(np.argmax(need.ratios))
    tau_max = arm.limits.tau_max.copy()
    tau_max[i] *= 0.93 * need.ratio
    tired = arm.with_limits(replace(arm.limits, tau_max=tau_max))
    motion = armctl.move_j(tired, start, goal)
    assert motion.slowed.joint == arm.joint_names[i]
    assert 1.0 < motion.slowed.factor < 1.2
    along = (goal - start) / np.linalg.norm(goal - start)
    away = motion.sample(np.linspace(0, motion.duration, 500)).q - start
    assert np.abs(away - (away @ along)[:, None] * along).max() < 1e-12


@pytest.mark.parametrize(("share", "longer"), [(0.97, 1.005), (0.5, 1.06)])
def test_torque_limits_cost_a_motion_through_waypoints_little_and_never_more_than_stopping(share, longer, load):
    arm = untiring(load(limb("a b c d", '<site name="tip" pos="0.1 0 0"/>'), motors("a b c d")))
    ones = np.ones(arm.n)
    arm = arm.with_limits(replace(arm.limits, v_max=2 * ones, a_max=12 * ones, j_max=6e3 * ones))  # jerk acts for 2 ms
    waypoints = np.random.default_rng(8).uniform(-1.5, 1.5, (6, 4))
    free = armctl.move_through(arm, waypoints)
    tired = arm.with_limits(replace(arm.limits, tau_max=peak_torques(arm, free, share)))
    motion = armctl.move_through(tired, waypoints)
    stopping = sum(armctl.move_j(tired, start, goal).duration for start, goal in pairwise(waypoints))
    assert armctl.check_torque(tired, motion).ok
    assert_lawful(motion)
    assert free.duration < motion.duration < longer * free.duration
    assert motion.duration <= stopping * (1 + 1e-9)
    assert motion.slowed.factor == pytest.approx(motion.duration / free.duration, rel=1e-12)


def test_a_payload_slows_a_motion_down():
    arm = arm_of("panda")
    start, goal = arm.home - 0.3, arm.home + 0.3
    empty, loaded = armctl.move_j(arm, start, goal), armctl.move_j(arm.with_payload(4.0), start, goal)
    assert empty.slowed is None
    assert loaded.slowed.factor == pytest.approx(loaded.duration / empty.duration)
    assert 1.01 < loaded.slowed.factor < 1.06
    assert armctl.check_torque(arm.with_payload(4.0), loaded).ok
    assert not armctl.check_torque(arm.with_payload(4.0), empty).ok


def test_what_no_slowness_helps_is_refused():
    arm = weak(arm_of("redundant"), 0.01)
    with pytest.raises(armctl.PlanError, match=r"j\d: holding still needs .* N m"):
        armctl.move_j(arm, arm.home, arm.home + 0.2)


def test_torques_of_any_trajectory_can_be_checked():
    arm = arm_of("redundant")

    class Still:
        duration = 1.0

        def __call__(self, t):
            return armctl.Setpoint(arm.home, np.zeros(7), np.zeros(7))

        def sample(self, times):
            return armctl.Setpoint(*(np.tile(x, (len(times), 1)) for x in self(0.0)[:3]))

    check = armctl.check_torque(arm, Still())
    assert check.ok
    assert "inside the torque limits" in str(check)
    with pytest.raises(armctl.InputError, match="moves 7 joints, but the arm has 3"):
        armctl.check_torque(arm_of("robot_arm_3dof"), Still())


@pytest.mark.parametrize(
    ("duration", "when"), [(1.0, 0.0), (1.0, 0.502), (1.0, 1.0), (170.0, 0.0), (170.0, 80.0), (170.0, 170.0)]
)
def test_a_torque_of_four_milliseconds_is_seen_wherever_it_is(duration: float, when: float):
    arm = arm_of("planar")

    class Burst:
        def __init__(self):
            self.duration = duration

        def __call__(self, t):
            return armctl.Setpoint(*(x[0] for x in self.sample(np.array([t]))[:3]))

        def sample(self, times):
            still = np.tile(arm.home, (len(times), 1))
            return armctl.Setpoint(still, 0.0 * still, 1e3 * (np.abs(times - when) < 0.00201)[:, None] * np.ones(3))

    check = armctl.check_torque(arm, Burst())
    assert not check
    assert check.time == pytest.approx(when, abs=0.0021)


# The trajectory as a value


@settings(max_examples=60)
@given(st.lists(st.floats(-10, 10), min_size=1, max_size=6))
def test_true_extremes_are_found(coefficients):
    p = np.array(coefficients)
    values = np.polynomial.polynomial.polyval(np.linspace(0, 1, 2001), p)
    places, found = polynomial_extremes(p[None, :, None])
    assert found.max() >= values.max() - 1e-9
    assert found.min() <= values.min() + 1e-9
    assert np.allclose(np.polynomial.polynomial.polyval(places, p), found)
    assert found.max() <= values.max() + 1e-4
    assert found.min() >= values.min() - 1e-4


def test_a_violation_between_samples_is_found_and_named():
    arm = arm_of("robot_arm_3dof")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    assert motion.check_limits().ok
    peak = max(p.value for p in motion.check_limits().peaks if p.quantity == "position" and p.joint == "shoulder_yaw")
    tight = replace(arm.limits, q_max=np.array([peak - 1e-4, 2.0, 2.0]), v_max=0.5 * arm.limits.v_max)
    check = motion.check_limits(tight)
    assert not check.ok
    assert {p.quantity for p in check.violations} >= {"position"}
    assert "outside the limits: shoulder_" in str(check)
    worst = check.worst
    at = motion(worst.time)
    assert getattr(at, {"position": "q", "velocity": "v"}[worst.quantity])[arm.joint_names.index(worst.joint)] == pytest.approx(
        worst.value
    )


def test_extremes_of_pieces_are_those_of_their_values():
    rng = np.random.default_rng(0)
    coefficients, steps = rng.normal(size=(7, 6, 2)), rng.uniform(0.1, 0.5, 7)
    for order in range(4):
        _, values = piece_extremes(coefficients, steps, order)
        for k in range(7):
            u = np.linspace(0, steps[k], 4001)
            for i in range(2):
                p = np.polynomial.Polynomial(coefficients[k, :, i]).deriv(order)
                assert values[k, i].max() == pytest.approx(p(u).max(), abs=1e-5)
                assert values[k, i].min() == pytest.approx(p(u).min(), abs=1e-5)


def test_motions_join_where_they_meet_and_only_there():
    arm = arm_of("redundant")
    out, back = armctl.move_j(arm, arm.home, arm.home + 0.2), armctl.move_j(arm, arm.home + 0.2, arm.home)
    both = out.then(back)
    assert both.duration == pytest.approx(out.duration + back.duration)
    assert np.allclose(both(both.duration).q, arm.home)
    assert_lawful(both)
    with pytest.raises(armctl.InputError, match=r"j\d: the first motion ends at position"):
        out.then(out)
    with pytest.raises(armctl.InputError, match="cannot follow"):
        out.then(armctl.move_j(arm_of("robot_arm_3dof"), [0, 0, -1], [0, 0, -1.5]))


def test_wrong_times_and_factors_are_refused():
    arm = arm_of("robot_arm_3dof")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    calls = [
        lambda: motion.scaled(0.0),
        lambda: motion.stopped_at(-1.0),
        lambda: motion.sample([np.nan]),
        lambda: motion(np.nan),
    ]
    for call in calls:
        with pytest.raises(armctl.InputError):
            call()
    with pytest.raises(armctl.InputError, match="then: None is not a JointTrajectory"):
        motion.then(None)
    with pytest.raises(armctl.LimitError, match="factor: 2 is too fast"):
        motion.scaled(2.0)
    assert motion.scaled(0.5).scaled(2.0).duration == pytest.approx(motion.duration)


def test_a_fraction_of_the_speed_makes_the_same_move_last_longer():
    arm = arm_of("six joints")
    goal = arm.home + np.array([0.6, -0.3, 0.2, 0.5, -0.4, 0.1])
    fast = armctl.move_j(arm, arm.home, goal)
    slow = armctl.move_j(arm, arm.home, goal, speed=0.4)
    assert slow.duration == pytest.approx(fast.duration / 0.4)
    times = np.linspace(0.0, fast.duration, 50)
    assert slow.sample(times / 0.4).q == pytest.approx(fast.sample(times).q, abs=1e-9)
