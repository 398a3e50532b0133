"""Motions that start while the arm moves, and motions of several kinds with rounded corners: limits, continuity, paths."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.plan.motion.moving_start import stop_from


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def assert_kept(motion: armctl.JointTrajectory, dt: float = 1e-3) -> None:
    """The limits hold between samples, by the polynomials and by differences of samples."""
    assert motion.check_limits().ok
    samples = motion.sample(np.arange(0.0, motion.duration, dt))[:3]
    limits = motion.limits
    for x, bound in zip(samples, (limits.v_max, limits.a_max, limits.j_max), strict=True):
        assert (np.abs(np.diff(x, axis=0)) <= (1 + 1e-6) * dt * bound + 1e-12).all()
    end = motion(motion.duration)
    assert np.abs(np.concatenate([end.v, end.a])).max() < 1e-9


def moving_states(arm: armctl.Arm, count: int) -> list[armctl.Setpoint]:
    """States in the middle of joint moves."""
    rng = np.random.default_rng(3)
    moves = [armctl.move_j(arm, *arm.limits.random(arm.home, 2, rng), straight=False) for _ in range(count)]
    return [move(rng.uniform(0.2, 0.8) * move.duration) for move in moves]


def distance_to_line(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    way = (end - start) / np.linalg.norm(end - start)
    off = points - start
    return np.linalg.norm(off - np.outer(off @ way, way), axis=1)


def test_a_line_begins_in_any_moving_state_and_is_reached_when_the_stop_would_end(arm):
    overlapping = 0
    for state in moving_states(arm, 8):
        stop = stop_from(arm, state)
        rest = stop(stop.duration).q
        target = arm.fk(rest).position + 0.03 * np.linalg.svd(arm.jacobian(rest)[:3])[0][:, 0]
        try:
            alone = armctl.move_l(arm, rest, target)
        except armctl.PlanError:
            continue
        motion = armctl.move_l(arm, state, target)
        for given, started in zip(state[:3], motion(0.0)[:3], strict=True):
            assert np.allclose(started, given, atol=1e-9)
        assert_kept(motion)
        late = motion.sample(np.linspace(stop.duration, motion.duration, 100)).q
        assert distance_to_line(arm.fk_many(late)[0], arm.fk(rest).position, target).max() < 2e-6
        assert np.linalg.norm(arm.fk(motion(motion.duration).q).position - target) < 1e-6
        assert motion.duration < stop.duration + alone.duration + 1e-9
        overlapping += motion.duration < stop.duration + alone.duration - 0.01
    assert overlapping >= 3


def test_a_motion_is_left_on_the_way_for_a_line(arm):
    first = armctl.move_j(arm, arm.home, arm.home + np.array([0.8, -0.5, -0.4]))
    t = 0.4 * first.duration
    state = first(t)
    target = arm.fk(arm.home + np.array([0.9, -0.3, -0.6])).position
    whole = first.until(t).then(armctl.move_l(arm, state, target))
    assert_kept(whole)
    assert np.array_equal(whole(0.5 * t).q, first(0.5 * t).q)
    assert np.linalg.norm(arm.fk(whole(whole.duration).q).position - target) < 1e-6


def test_a_start_at_rest_given_as_zeros_is_the_plain_motion(arm):
    target = arm.fk(arm.home + 0.2).position
    plain = armctl.move_l(arm, arm.home, target)
    zeros = armctl.move_l(arm, armctl.Setpoint(arm.home, np.zeros(3), np.zeros(3)), target)
    assert np.array_equal(zeros.coefficients, plain.coefficients)


def test_wrong_starts_are_one_sentence(arm):
    target = arm.fk(arm.home + 0.2).position
    with pytest.raises(armctl.InputError, match=r"^q_start.v: expected 3 numbers, got 2$"):
        armctl.move_l(arm, armctl.Setpoint(arm.home, np.zeros(2), np.zeros(3)), target)
    with pytest.raises(armctl.PlanError, match=r"^no stop inside the limits was found from this start"):
        armctl.move_l(arm, armctl.Setpoint(arm.home, np.zeros(3), np.array([1e6, 0.0, 0.0])), target)
    at_limit = arm.limits.clamp(arm.home + np.array([9.0, 0.0, 0.0]))
    with pytest.raises(armctl.LimitError, match=r"^q_start: the arm cannot stop inside its position limits"):
        armctl.move_l(arm, armctl.Setpoint(at_limit, np.array([0.5, 0.0, 0.0]), np.zeros(3)), target)
    with pytest.raises(armctl.InputError, match=r"^t: "):
        armctl.move_l(arm, arm.home, target).until(-1.0)


@pytest.fixture(scope="module")
def parts(arm) -> list[armctl.JointTrajectory]:
    """A joint move, a line, a move through a point, and a joint move back."""
    q0 = arm.home
    q1 = arm.home + np.array([0.6, 0.3, -0.3])
    line = armctl.move_l(arm, q1, arm.fk(q1).position + np.array([0.0, -0.1, 0.05]))
    q2 = line(line.duration).q
    through = armctl.move_through(arm, q2 + np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [0.6, 0.1, -0.2]]))
    q3 = through(through.duration).q
    return [armctl.move_j(arm, q0, q1), line, through, armctl.move_j(arm, q3, q2)]


@pytest.mark.parametrize("blend", [0.005, 0.03])
def test_corners_between_motions_of_all_kinds_are_rounded_within_the_limits(arm, parts, blend):
    whole = armctl.move_sequence(arm, parts, blend=blend)
    assert_kept(whole)
    assert armctl.check_torque(arm, whole).ok
    stopping = sum(part.duration for part in parts)
    assert whole.duration < stopping - 0.02
    paths = np.concatenate([part.sample(np.linspace(0.0, part.duration, 4000)).q for part in parts])
    corners = np.array([arm.fk(after(0.0).q).position for _, after in pairwise(parts)])
    tips = arm.fk_many(paths)[0]
    for q in whole.sample(np.linspace(0.0, whole.duration, 150)).q:
        tip = arm.fk(q).position
        if np.linalg.norm(corners - tip, axis=1).min() > blend:
            assert np.linalg.norm(tips - tip, axis=1).min() < 5e-4
            assert np.abs(paths - q).max(axis=1).min() < 2e-3
    nearest = np.linalg.norm(arm.fk_many(whole.sample(np.linspace(0.0, whole.duration, 3000)).q)[0][:, None] - corners, axis=2)
    assert (nearest.min(axis=0) < blend).all()


def test_a_wider_blend_is_faster_and_none_stops_at_the_corners(arm, parts):
    durations = [armctl.move_sequence(arm, parts, blend=blend).duration for blend in (0.0, 0.003, 0.03)]
    assert durations[0] > durations[1] > durations[2]
    plain = armctl.move_sequence(arm, parts)
    for before, after in zip(np.cumsum([part.duration for part in parts])[:-1], parts[1:], strict=True):
        assert np.abs(plain(float(before)).v).max() < 1e-9
        assert np.allclose(plain(float(before)).q, after(0.0).q, atol=1e-9)


def test_a_corner_at_a_joint_limit_stays_inside(arm):
    top = arm.limits.q_max.copy()
    whole = armctl.move_sequence(arm, [armctl.move_j(arm, arm.home, top), armctl.move_j(arm, top, arm.home - 0.1)], blend=0.1)
    assert_kept(whole)


@pytest.mark.parametrize(
    ("motions", "message"),
    [
        (lambda arm, parts: [], r"^motions: give a list of at least one motion"),
        (lambda arm, parts: [parts[0], 1.0], r"^motions: expected JointTrajectory, got 1\.0"),
        (lambda arm, parts: [parts[0], parts[2]], r"^then: shoulder_yaw: the first motion ends at position"),
        (lambda arm, parts: [parts[0].until(0.1), parts[0]], r"^then: "),
    ],
)
def test_a_wrong_sequence_is_one_sentence(arm, parts, motions, message):
    with pytest.raises(armctl.InputError, match=message):
        armctl.move_sequence(arm, motions(arm, parts), blend=0.01)


def test_motions_that_do_not_rest_at_the_corner_are_rejected(arm):
    move = armctl.move_j(arm, arm.home, arm.home + 0.4)
    middle = move(0.5 * move.duration)
    rest = armctl.move_l(arm, middle, arm.fk(arm.home + 0.4).position)
    first = move.until(0.5 * move.duration)
    with pytest.raises(armctl.InputError, match=r"^motions: the arm does not rest between motions 0 and 1"):
        armctl.move_sequence(arm, [first, rest], blend=0.01)


@pytest.mark.parametrize("seed", [11, 21, 139])
def test_a_rounded_corner_takes_no_longer_than_a_stop_whatever_the_limits(seed):
    arm = arm_of("endless")
    rng = np.random.default_rng(seed)
    v, a, j = 10.0 ** rng.uniform(-3, 3, (3, arm.n))
    limits = replace(arm.limits, v_max=v * arm.limits.v_max, a_max=a * arm.limits.a_max, j_max=j * arm.limits.j_max)
    arm = arm.with_limits(replace(limits, tau_max=np.full(arm.n, np.inf)))
    start, corner, goal = arm.limits.random(arm.home, 3, rng)
    motions = [armctl.move_j(arm, start, corner), armctl.move_j(arm, corner, goal)]
    rounded = armctl.move_sequence(arm, motions, blend=0.05)
    assert rounded.check_limits().ok
    assert rounded.duration <= armctl.move_sequence(arm, motions).duration
