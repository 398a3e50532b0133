"""Limits that depend on the sign of a velocity, or on how near a joint is to the end of its range: in every motion."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arms import arm_of, some_of

import armctl
from armctl.core.limits import Limits

DECELERATION = np.array([3.0, 2.5, 4.0])
OFFSET = np.array([0.3, 0.2, 0.1])
KINDS = ("ends", "signs", "both")


def free() -> armctl.Arm:
    """An arm without such limits."""
    return arm_of("robot_arm_3dof")


@cache
def limits_of(kind: str) -> Limits:
    limits = free().limits
    ends = replace(limits, deceleration_limit=DECELERATION, velocity_offset=OFFSET)
    return {
        "ends": ends,
        "signs": replace(limits, v_min=-0.4 * limits.v_max, a_min=-0.5 * limits.a_max),
        "both": replace(ends, v_min=-0.4 * limits.v_max, a_min=-1.5 * limits.a_max),
    }[kind]


def bounds_at(limits: Limits, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest velocities at positions (T, n), written down again."""
    low = np.where(np.isinf(limits.v_min), -limits.v_max, limits.v_min) + 0.0 * q
    high = limits.v_max + 0.0 * q
    if np.isfinite(limits.deceleration_limit).all():
        up = np.sqrt(2.0 * limits.deceleration_limit * np.maximum(limits.q_max - q, 0.0)) - limits.velocity_offset
        down = np.sqrt(2.0 * limits.deceleration_limit * np.maximum(q - limits.q_min, 0.0)) - limits.velocity_offset
        high = np.minimum(high, np.maximum(up, 0.0))
        low = np.maximum(low, -np.maximum(down, 0.0))
    return low, high


def excess(limits: Limits, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> float:
    """By how much samples (T, n) are beyond the limits, as a share of them; a joint may stand anywhere in its range."""
    low, high = bounds_at(limits, q)
    beyond = np.where(v == 0.0, -1.0, np.where(v > 0.0, v - high, low - v) / limits.v_max)
    a_low = np.where(np.isinf(limits.a_min), -limits.a_max, limits.a_min)
    outside = np.maximum(q - limits.q_max, limits.q_min - q)
    return float(max(beyond.max(), ((a - limits.a_max) / limits.a_max).max(), ((a - a_low) / a_low).max(), outside.max()))


def excess_of(limits: Limits, motion: armctl.JointTrajectory) -> float:
    return excess(limits, *motion.sample(np.linspace(0.0, motion.duration, 3001))[:3])


def inside(rng: np.random.Generator) -> np.ndarray:
    """A configuration outside the zones in which no speed towards an end is allowed."""
    limits = free().limits
    return np.clip(limits.random(free().home, 1, rng)[0], limits.q_min + 0.03, limits.q_max - 0.03)


def near_ends(rng: np.random.Generator) -> np.ndarray:
    """A configuration with some joints near an end of their range."""
    limits = free().limits
    side = rng.integers(0, 3, 3)
    distance = rng.uniform(0.03, 0.3, 3)
    return np.where(side == 0, limits.q_max - distance, np.where(side == 1, limits.q_min + distance, inside(rng)))


MOTIONS = {
    "move_j": lambda arm, q: armctl.move_j(arm, q[0], q[-1]),
    "joints by themselves": lambda arm, q: armctl.move_j(arm, q[0], q[-1], straight=False),
    "half speed": lambda arm, q: armctl.move_j(arm, q[0], q[-1], speed=0.5),
    "trapezoid": lambda arm, q: armctl.move_j(arm, q[0], q[-1], profile="trapezoid"),
    "move_through": armctl.move_through,
    "time_path": lambda arm, q: armctl.time_path(arm, np.linspace(q[0], q[-1], 12)),
    "sequence": lambda arm, q: armctl.move_sequence(
        arm, [armctl.move_j(arm, q[0], q[1]), armctl.move_j(arm, q[1], q[-1])], blend=0.1
    ),
}


@pytest.mark.parametrize("kind", some_of(KINDS, {"both"}, full=KINDS))
@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("cases", [4, pytest.param(60, marks=pytest.mark.nightly)])
def test_random_motions_into_the_ends_keep_the_limits(name: str, kind: str, cases: int):
    limits = limits_of(kind)
    rng = np.random.default_rng(7)
    outside = 0
    for _ in range(cases):
        waypoints = [near_ends(rng), inside(rng), near_ends(rng)]
        motion = MOTIONS[name](free().with_limits(limits), waypoints)
        assert excess_of(limits, motion) < 2e-6
        assert name == "trapezoid" or motion.check_limits()
        outside += excess_of(limits, MOTIONS[name](free(), waypoints)) > 1e-3
    assert outside > 0  # by motions without such limits


@pytest.mark.parametrize("name", ["move_j", "joints by themselves"])
def test_a_motion_is_slowed_no_more_than_the_ends_demand(name: str):
    limits = limits_of("ends")
    rng = np.random.default_rng(11)
    slowed = 0
    for _ in range(10):
        waypoints = [near_ends(rng), near_ends(rng)]
        if excess_of(limits, MOTIONS[name](free(), waypoints)) > 1e-3:
            slowed += 1
            motion = MOTIONS[name](free().with_limits(limits), waypoints)
            q, v = motion.sample(np.linspace(0.0, motion.duration, 3001))[:2]
            low, high = bounds_at(limits, q)
            bound = np.where(v > 0.0, high, -low)
            assert (np.abs(v)[bound > 0.0] / bound[bound > 0.0]).max() > 0.99
    assert slowed > 2


def test_a_tip_line_into_the_end_of_a_range_keeps_the_limits():
    arm = free().with_limits(limits_of("ends"))
    start = np.array([2.6, 0.6, -1.2])
    goal = free().fk(np.array([limits_of("ends").q_max[0] - 0.05, 0.6, -1.2])).position
    assert excess_of(limits_of("ends"), armctl.move_l(arm, start, goal)) < 2e-6
    assert excess_of(limits_of("ends"), armctl.move_l(free(), start, goal)) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_an_online_motion_keeps_the_limits(kind: str):
    limits = limits_of(kind)
    rng = np.random.default_rng(3)
    motion = armctl.OnlineMotion(free().with_limits(limits), free().home)
    rows = []
    for tick in range(600):
        if tick % 60 == 0:
            motion.go_to(near_ends(rng))
        if tick % 120 == 90:
            motion.go_at(rng.uniform(limits.v_low, limits.v_max))
        rows.append(motion.step(0.01))
    assert excess(limits, *(np.array([getattr(row, name) for row in rows]) for name in "qva")) < 2e-6


@pytest.mark.parametrize("kind", ["ends", pytest.param("both", marks=pytest.mark.full)])
def test_a_stream_keeps_the_limits_and_moves(kind: str):
    limits = limits_of(kind)
    rng = np.random.default_rng(3)
    stream = armctl.Stream(free().with_limits(limits), free().home)
    goal = free().home
    rows = []
    for tick in range(240):
        if tick % 80 == 0:
            goal = near_ends(rng)
        if tick % 4 == 0:
            stream.push(0.01 * tick + 0.03, goal)
        rows.append(stream.step(0.01))
    q, v, a = (np.array([getattr(row, name) for row in rows]) for name in "qva")
    assert excess(limits, q, v, a) < 2e-6
    assert np.abs(np.diff(q, axis=0)).sum() > 1.0


def test_check_limits_finds_every_violation_that_dense_samples_find():
    rng = np.random.default_rng(11)
    found = []
    for case in range(30):
        motion = armctl.move_j(free(), near_ends(rng), near_ends(rng), straight=bool(case % 2), speed=rng.uniform(0.2, 1.0))
        for limits in map(limits_of, KINDS):
            found.append((excess_of(limits, motion) > 1e-6, not motion.check_limits(limits)))
    assert all(sampled <= checked for sampled, checked in found)
    assert sum(sampled for sampled, _ in found) < len(found)
    assert sum(checked for _, checked in found) - sum(sampled for sampled, _ in found) <= 1


def test_a_violation_is_named_with_the_limit_at_its_position():
    goal = limits_of("ends").q_max - np.array([0.05, 1.5, 1.0])
    check = armctl.move_j(free(), free().home, goal).check_limits(limits_of("ends"))
    peak = check.violations[0]
    assert peak.quantity == "velocity"
    at = armctl.move_j(free(), free().home, goal)(peak.time)
    joint = free().joint_names.index(peak.joint)
    assert peak.value == pytest.approx(at.v[joint], rel=1e-6)
    assert peak.bound == pytest.approx(bounds_at(limits_of("ends"), at.q[None])[1][0, joint], rel=1e-6)
    assert peak.ratio > 1.0


def test_without_such_limits_nothing_changes():
    q = free().limits.random(free().home, 2, np.random.default_rng(0))
    far = replace(free().limits, v_min=-free().limits.v_max, a_min=-free().limits.a_max, deceleration_limit=np.full(3, 1e9))
    for limits in (free().limits, far):
        for straight in (True, False):
            same = armctl.move_j(free().with_limits(limits), *q, straight=straight)
            assert (same.coefficients == armctl.move_j(free(), *q, straight=straight).coefficients).all()
    assert free().limits.symmetric is free().limits
    assert free().limits.plain is free().limits


def test_each_direction_has_its_own_speed():
    up = replace(free().limits, v_min=-0.1 * free().limits.v_max)
    arm = free().with_limits(up)
    there = armctl.move_j(arm, free().home, free().home + 0.5)
    back = armctl.move_j(arm, free().home + 0.5, free().home)
    assert there.duration == armctl.move_j(free(), free().home, free().home + 0.5).duration
    assert back.duration > 3.0 * there.duration
    assert back(0.5 * back.duration).v.min() == pytest.approx(-0.1 * free().limits.v_max.min(), rel=1e-6)


def test_slower_motions_are_the_same_in_time():
    limits = limits_of("both").at_speed(0.5)
    q = np.array([[0.1, 0.2, -0.3]])
    low, high = limits_of("both").velocity_bounds(q)
    slow_low, slow_high = limits.velocity_bounds(q)
    assert slow_low == pytest.approx(0.5 * low)
    assert slow_high == pytest.approx(0.5 * high)
    same = replace(free().limits, v_min=-free().limits.v_max)
    assert (same.at_speed(0.5).v_low == -same.at_speed(0.5).v_max).all()
    near = limits_of("both").q_max - 0.02
    assert limits.velocity_bounds(near)[1] == pytest.approx(0.5 * limits_of("both").velocity_bounds(near)[1])


def test_where_no_speed_is_allowed_no_motion_leads():
    arm = free().with_limits(limits_of("ends"))
    goal = np.append(limits_of("ends").q_max[0] - 0.5 * limits_of("ends").end_zones[0], free().home[1:])
    message = r"joint 1: the motion leads so near to the end of its range, 3\.14\d*, that no speed .* stay 0\.015 and more away"
    with pytest.raises(armctl.LimitError, match=message):
        armctl.move_j(arm, free().home, goal)
    with pytest.raises(armctl.LimitError, match=message):
        armctl.time_path(arm, [free().home, 0.5 * (free().home + goal), goal])
    assert excess_of(limits_of("ends"), armctl.move_j(arm, goal, free().home)) < 2e-6  # away from the end it may move


def test_a_goal_in_motion_beyond_its_direction_is_refused():
    arm = free().with_limits(limits_of("signs"))
    v = np.array([-0.5, 0.0, 0.0]) * free().limits.v_max
    with pytest.raises(armctl.LimitError, match=r"q_goal\.v: .* are allowed; give a slower goal"):
        armctl.move_j(arm, free().home, armctl.Setpoint(free().home - 0.5, v, np.zeros(3)), straight=False)
    with pytest.raises(armctl.LimitError, match="is beyond its limit"):
        armctl.OnlineMotion(arm, free().home).go_at(v)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("v_min", 0.1, "v_min: every value must be less than 0, got 0.1"),
        ("a_min", 0.0, "a_min: every value must be less than 0, got 0"),
        ("deceleration_limit", 0.0, "deceleration_limit: every value must be greater than 0, got 0"),
        ("velocity_offset", -0.1, "velocity_offset: every value must be at least 0, got -0.1"),
    ],
)
def test_wrong_limits_are_refused(name: str, value: float, sentence: str):
    with pytest.raises(armctl.InputError, match=sentence):
        replace(free().limits, **{name: np.full(3, value)})


def test_a_saved_motion_keeps_them(tmp_path):
    arm = free().with_limits(limits_of("both"))
    motion = armctl.move_j(arm, free().home, free().home + 0.1)
    again = armctl.JointTrajectory.load(motion.save(tmp_path / "motion.npz"))
    assert (again.limits.velocity_offset == OFFSET).all()
    assert (again.limits.v_min == limits_of("both").v_min).all()


def test_rows_planned_with_the_envelope_of_a_maker_are_sent():
    maker = replace(
        free().limits,
        a_max=2.0 * free().limits.a_max,
        j_max=4.0 * free().limits.j_max,
        deceleration_limit=DECELERATION,
        velocity_offset=OFFSET,
    )
    envelope = armctl.Envelope("a test", maker)
    planned = free().with_limits(envelope.planning_limits(free().limits, 1.0))
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(6):
        ends = [near_ends(rng), near_ends(rng)]
        for arm in (planned, free()):
            motion = armctl.move_j(arm, *ends)
            rows = motion.sample(np.minimum(1e-3 * np.arange(int(1e3 * motion.duration) + 3), motion.duration)).q
            reason = envelope.refusal(rows, rows[:1].repeat(3, axis=0), 1e-3)
            if arm is planned:
                assert reason == ""
            refused += "moves at" in reason
    assert refused > 0


def test_motions_from_a_moving_start_keep_the_limits():
    limits = limits_of("both")
    arm = free().with_limits(limits)
    start = armctl.Setpoint(limits.q_max - np.array([0.5, 0.4, 0.8]), 0.15 * limits.v_max, np.zeros(3))
    assert excess_of(limits, armctl.move_j(arm, start, free().home, straight=False)) < 2e-6
    point = free().fk(start.q).position + np.array([0.0, 0.03, 0.03])
    assert excess_of(limits, armctl.move_l(arm, start, point)) < 2e-6


def excess_of_steps(arm: armctl.Arm, limits: Limits) -> float:
    """By how much the velocities of DifferentialIk are beyond limits, at both ends of each step, as a share."""
    ik = armctl.DifferentialIk(arm)
    rng = np.random.default_rng(1)
    q = arm.home.copy()
    worst = -np.inf
    for _ in range(8):
        target = arm.fk(near_ends(rng)).position
        for _ in range(150):
            v = ik.step(q, target, 0.004)
            for at in (q, q + 0.004 * v):
                low, high = bounds_at(limits, at)
                worst = max(worst, np.max(np.maximum(v - high, low - v) * (v != 0.0) / limits.v_max))
            q = q + 0.004 * v
    return worst


@pytest.mark.parametrize("kind", KINDS)
def test_steps_of_differential_ik_keep_the_limits_until_their_end(kind: str):
    limits = limits_of(kind)
    assert excess_of_steps(free().with_limits(limits), limits) < 1e-9
    assert excess_of_steps(free(), limits) > 0.1
