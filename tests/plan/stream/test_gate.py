"""Gates: what passes is proved, keeps the limits and ends at rest; what does not pass is refused with a way out."""

import numpy as np
import pytest
from collidable import arm_among, placed
from hypothesis import given, settings
from hypothesis import strategies as st

import armctl
from armctl.core.trajectory import Setpoint
from armctl.model.collision.checkers import collision_checker
from armctl.plan.motion.trajectory.path_stop import remaining

DT = 2e-3
WALL = '<geom name="wall" type="box" size="0.02 1 1" pos="0.55 0 0.5"/>'


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("gate"))


@pytest.fixture(scope="module")
def arm_at_a_wall(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("wall"), WALL)


@pytest.fixture(scope="module")
def gate(arm) -> armctl.Gate:
    return armctl.Gate(arm)


def free_configurations(arm: armctl.Arm, count: int, seed: int) -> list[np.ndarray]:
    checker = collision_checker(arm)
    rng = np.random.default_rng(seed)
    drawn = arm.limits.random(arm.home, 100 * count, rng)
    return [q for q in drawn if checker.hit(q, 0.02) < 0][:count]


def touched(arm: armctl.Arm, motion: armctl.Trajectory) -> bool:
    """Whether MuJoCo finds a contact at any of the samples."""
    times = np.arange(0.0, motion.duration + 5 * DT, 5 * DT)
    return any(placed(arm, q).ncon > 0 for q in motion.sample(times).q)


def assert_may_be_sent(arm: armctl.Arm, answer: armctl.GateAnswer, start: Setpoint) -> None:
    motion = answer.motion
    assert answer.proved
    assert motion.check_limits().ok
    assert armctl.check_torque(arm, motion).ok
    assert motion(0.0).q == pytest.approx(start.q, abs=1e-9)
    assert motion(0.0).v == pytest.approx(start.v, abs=1e-6)
    assert np.abs(motion(motion.duration).v).max() < 1e-6
    assert not touched(arm, motion)


def towards_the_wall(arm: armctl.Arm, count: int, reach: float = 1.0) -> np.ndarray:
    """(count, n) rad, targets of a motion from home that leans into the wall."""
    bent = arm.home + np.array([0.0, 1.2, 0.6, 0.0, 0.0, 0.0])
    return arm.home + reach * 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, count + 1)[1:, None])) * (bent - arm.home)


@given(
    seed=st.integers(0, 10_000), kind=st.sampled_from(["single", "chunk", "jump", "tip", "twist"]), moment=st.floats(0.0, 1.0)
)
@settings(max_examples=40, deadline=None)
def test_whatever_is_asked_for_the_motion_may_be_sent_and_a_refusal_names_a_safe_configuration(arm, gate, seed, kind, moment):
    rng = np.random.default_rng(seed)
    first, second, third = free_configurations(arm, 3, seed)
    begun = gate.admit(first, q=second)
    assert_may_be_sent(arm, begun, Setpoint(first, np.zeros(arm.n), np.zeros(arm.n)))
    at = moment * begun.motion.duration
    start = begun.motion(at)
    if kind == "single":
        answer = gate.admit(begun.motion, at=at, q=third)
    elif kind == "tip":
        answer = gate.admit(begun.motion, at=at, tip=arm.fk(start.q).position + rng.uniform(-0.2, 0.2, 3))
    elif kind == "twist":
        answer = gate.admit(begun.motion, at=at, twist=(rng.uniform(-0.5, 0.5, 3), rng.uniform(-1.0, 1.0, 3)))
    else:
        times = 0.04 * np.arange(1, 21)
        q = start.q + np.outer(times, rng.uniform(-1.0, 1.0, arm.n))
        q[10:] += rng.uniform(-1.0, 1.0, arm.n) if kind == "jump" else 0.0
        answer = gate.admit(begun.motion, at=at, q=arm.limits.clamp(q), times=times)
    assert_may_be_sent(arm, answer, start)
    if answer:
        assert answer.reason == ""
        assert answer.motion(answer.motion.duration).q == pytest.approx(answer.asked, abs=1e-6)
    else:
        assert answer.reason
        assert collision_checker(arm).hit(answer.nearest, gate.clearance) < 0
        assert arm.limits.contains(answer.nearest)
        assert placed(arm, answer.nearest).ncon == 0


def test_a_chunk_that_is_free_passes_each_target_at_its_time(arm_at_a_wall):
    arm = arm_at_a_wall
    times = 0.1 * np.arange(1, 11)
    q = towards_the_wall(arm, 10, 0.2)
    answer = armctl.Gate(arm).admit(arm.home, q=q, times=times)
    assert answer
    assert answer.pace == 1.0
    assert answer.motion.sample(times[3:]).q == pytest.approx(q[3:], abs=1e-6)


def test_a_refusal_has_the_bodies_the_time_the_distance_and_the_nearest_safe_pose(arm_at_a_wall):
    arm = arm_at_a_wall
    times = 0.1 * np.arange(1, 21)
    q = towards_the_wall(arm, 20)
    answer = armctl.Gate(arm).admit(arm.home, q=q, times=times)
    assert not answer
    assert "wall" in answer.bodies
    assert 0.0 < answer.time < times[-1]
    assert answer.distance == pytest.approx(1e-3, abs=5e-4)
    assert answer.reason == f"{answer.bodies[1]} would touch {answer.bodies[0]} at {answer.time:.3f} s"
    assert placed(arm, answer.nearest).ncon == 0
    assert answer.nearest_pose is not None
    x, y, z = answer.nearest_pose.position
    assert str(answer) == f"{answer.reason}; the nearest safe pose has the tip at ({x:.3f}, {y:.3f}, {z:.3f}) m"
    end = answer.motion(answer.motion.duration).q
    assert np.abs(end - arm.home).max() > 0.2, "the arm goes as far as it may"
    assert_may_be_sent(arm, answer, Setpoint(arm.home, np.zeros(arm.n), np.zeros(arm.n)))


def test_the_nearest_safe_configuration_is_at_most_twice_as_far_as_any_random_one(arm):
    checker = collision_checker(arm)
    gate = armctl.Gate(arm)
    rng = np.random.default_rng(3)
    start = free_configurations(arm, 1, 0)[0]
    blocked = [q for q in arm.limits.random(arm.home, 100, rng) if checker.hit(q, gate.clearance) >= 0][:15]
    for q in blocked:
        nearest = gate.admit(start, q=q).nearest
        distance = np.linalg.norm(nearest - q)
        directions = rng.normal(size=(2000, arm.n))
        directions *= (0.49 * distance * rng.uniform(size=2000) ** (1 / arm.n) / np.linalg.norm(directions, axis=1))[:, None]
        assert all(checker.hit(arm.limits.clamp(q + each), gate.clearance) >= 0 for each in directions)


def test_near_an_obstacle_an_arm_that_moves_is_slowed_down_instead_of_stopped(arm_at_a_wall):
    """At full pace the arm would pass its last target in motion, and turn back behind the wall."""
    arm = arm_at_a_wall
    gate = armctl.Gate(arm)
    bent = towards_the_wall(arm, 1)[0]
    stopped = gate.admit(arm.home, q=bent).motion
    last = stopped(stopped.duration).q
    velocity = 2.0 * (last - arm.home) / np.linalg.norm(last - arm.home)
    times = 0.02 * np.arange(1, 11)
    q = last - np.outer(times[::-1] - times[0], velocity)
    start = Setpoint(q[0] - times[0] * velocity, velocity, np.zeros(arm.n))
    answer = gate.admit(start, q=q, times=times)
    assert answer
    assert 0.3 < answer.pace < 1.0
    assert answer.motion(answer.motion.duration).q == pytest.approx(last, abs=1e-6)
    assert_may_be_sent(arm, answer, start)


def test_a_motion_that_runs_brakes_before_what_appears_on_its_way_and_passes_what_does_not(arm_at_a_wall):
    arm = arm_at_a_wall
    world = armctl.World()
    gate = armctl.Gate(arm, world)
    turned = arm.home + np.array([1.5, 0.3, 0.0, 0.0, 0.0, 0.0])
    motion = gate.admit(arm.home, q=turned).motion
    at = 0.3 * motion.duration
    world.add("beside", armctl.Ball(0.1), [-0.5, -0.5, 0.3])
    answer = gate.admit(motion, at=at)
    assert answer
    assert answer.motion.duration == pytest.approx(motion.duration - at)
    world.add("ball", armctl.Ball(0.05), arm.fk(turned).position)
    answer = gate.admit(motion, at=at)
    assert not answer
    assert answer.proved
    assert "ball" in answer.bodies
    assert 0.0 < answer.time < motion.duration - at
    assert answer.motion.duration < motion.duration - at
    assert answer.motion(0.0).q == pytest.approx(motion(at).q, abs=1e-9)
    checker = collision_checker(arm, world=world)
    assert all(checker.hit(q) < 0 for q in answer.motion.sample(np.linspace(0.0, answer.motion.duration, 200)).q)
    world.remove("ball")
    assert gate.admit(motion, at=at)


def test_where_no_stop_keeps_the_clearance_one_that_touches_nothing_is_found(arm):
    """A ball half a millimetre beside the stop on the path, and on the way of the fastest stop."""
    rng = np.random.default_rng(4)
    constructed = 0
    for first, second in zip(free_configurations(arm, 20, 1), free_configurations(arm, 20, 2), strict=True):
        motion = armctl.Gate(arm).admit(first, q=second).motion
        if motion.duration < 0.4:
            continue
        at = 0.5 * motion.duration
        on_path = rest_of(motion.stopped_at(at), at)
        stream = armctl.Stream(arm, motion(at))
        fastest = armctl.JointTrajectory(*stream.pieces, arm.joint_names, arm.limits)
        for _ in range(5):
            place = arm.fk(fastest(fastest.duration).q).position + rng.normal(size=3) * 0.03
            low = 0.0
            high = 0.2
            while high - low > 1e-5:
                middle = 0.5 * (low + high)
                low, high = (low, middle) if near_ball(arm, on_path, place, middle) else (middle, high)
            radius = low - 5e-4
            if radius < 0.01 or not near_ball(arm, fastest, place, radius):
                continue
            constructed += 1
            world = armctl.World().add("ball", armctl.Ball(radius), place)
            answer = armctl.Gate(arm, world).admit(motion, at=at)
            assert not answer
            assert answer.proved
            assert not near_ball(arm, answer.motion, place, radius)
            assert answer.motion(0.0).q == pytest.approx(motion(at).q, abs=1e-9)
    assert constructed > 5


def rest_of(motion: armctl.JointTrajectory, at: float) -> armctl.JointTrajectory:
    return armctl.JointTrajectory(*remaining(motion.pieces, at), motion.joint_names, motion.limits)


def near_ball(arm: armctl.Arm, motion: armctl.JointTrajectory, place: np.ndarray, radius: float) -> bool:
    """Whether the arm touches a ball during a motion."""
    world = armctl.World().add("ball", armctl.Ball(radius), place)
    return not armctl.check_clearance(arm, motion, 0.0, world=world).ok


def test_what_the_arm_carries_is_proved_clear_too(arm_at_a_wall):
    arm = arm_at_a_wall
    bent = towards_the_wall(arm, 1, 0.3)[0]
    world = armctl.World()
    gate = armctl.Gate(arm, world)
    assert gate.admit(arm.home, q=bent)
    world.add("stick", armctl.Box([0.5, 0.02, 0.02])).attach("stick", [0.25, 0.0, 0.0])
    answer = gate.admit(arm.home, q=bent)
    assert not answer
    assert set(answer.bodies) == {"stick", "wall"}
    checker = collision_checker(arm, world=world)
    assert checker.hit(answer.nearest, gate.clearance) < 0


def test_points_are_bodies_too(arm_at_a_wall):
    arm = arm_at_a_wall
    turned = arm.home + np.array([1.5, 0.3, 0.0, 0.0, 0.0, 0.0])
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    points = arm.fk(turned).position + 0.08 * directions / np.linalg.norm(directions, axis=1)[:, None]
    answer = armctl.Gate(arm, armctl.World().add("seen", armctl.Points(points, radius=0.01))).admit(arm.home, q=turned)
    assert not answer
    assert "seen" in answer.bodies
    assert answer.proved
    assert np.linalg.norm(arm.fk(answer.nearest).position - points, axis=1).min() > 0.01


def test_a_target_beyond_a_limit_is_refused_and_the_nearest_one_is_inside(arm):
    q = arm.limits.q_max + np.array([0.1, *np.zeros(arm.n - 1)])
    answer = armctl.Gate(arm).admit(free_configurations(arm, 1, 0)[0], q=q)
    assert not answer
    assert answer.reason == "j0 would be at 2.6 rad, at most 2.5 is allowed"
    assert arm.limits.contains(answer.nearest)


def test_a_motion_faster_than_the_gate_is_slowed_down_on_its_path(arm):
    first, second = next(
        (a, b)
        for a, b in zip(free_configurations(arm, 20, 1), free_configurations(arm, 20, 2), strict=True)
        if armctl.check_clearance(arm, armctl.move_j(arm, a, b), 0.01).ok
    )
    motion = armctl.move_j(arm, first, second)
    answer = armctl.Gate(arm, speed=0.5).admit(motion)
    assert answer
    assert answer.pace == pytest.approx(0.5, rel=1e-3)
    shares = np.linspace(0.0, 1.0, 50)
    assert answer.motion.sample(shares * answer.motion.duration).q == pytest.approx(
        motion.sample(shares * motion.duration).q, abs=1e-6
    )


def test_a_motion_that_is_free_passes_unchanged(arm_at_a_wall):
    arm = arm_at_a_wall
    motion = armctl.move_j(arm, arm.home, towards_the_wall(arm, 1, 0.2)[0])
    answer = armctl.Gate(arm).admit(motion)
    assert answer
    assert np.array_equal(answer.motion.coefficients, motion.coefficients)


def test_a_start_in_contact_is_refused_with_the_nearest_place_that_is_not(arm_at_a_wall):
    arm = arm_at_a_wall
    answer = armctl.Gate(arm).admit(towards_the_wall(arm, 1)[0], q=arm.home)
    assert not answer
    assert not answer.proved
    assert "touches wall" in answer.reason
    assert placed(arm, answer.nearest).ncon == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda gate, arm: gate.admit(arm.home), "nothing is asked for"),
        (lambda gate, arm: gate.admit(arm.home, q=arm.home, tip=[0.3, 0, 0.4]), "one of q, tip and twist, got q and tip"),
        (lambda gate, arm: gate.admit(arm.home, q=[np.nan] * arm.n), "q: .*finite"),
        (lambda gate, arm: gate.admit(arm.home, q=np.tile(arm.home, (2, 1))), "times: a chunk needs the time"),
        (lambda gate, arm: gate.admit(arm.home, q=np.tile(arm.home, (2, 1)), times=[0.1]), "q: 2 targets for 1 times"),
        (lambda gate, arm: gate.admit(arm.home, q=np.tile(arm.home, (2, 1)), times=[0.2, 0.1]), "times: they must"),
        (lambda gate, arm: gate.admit(arm.home, q=np.tile(arm.home, (2, 1)), times=[0.1, 1e3]), "more than 60 s ahead"),
        (lambda gate, arm: gate.admit(arm.home, twist=[0.1, 0, 0]), "twist: expected two parts"),
        (lambda gate, arm: gate.admit(arm.home, at=0.1, q=arm.home), "at: .*only of a motion"),
        (
            lambda gate, arm: gate.admit(arm.home, tip=armctl.Pose([1, 0, 0]), times=[1]),
            "tip: a chunk with times",
        ),
        (lambda gate, arm: armctl.Gate(arm, clearance=-1.0), "clearance: .*at least 0"),
        (lambda gate, arm: armctl.Gate(arm, speed=2.0), "speed"),
    ],
)
def test_a_wrong_call_is_one_sentence(arm, gate, call, message):
    with pytest.raises(armctl.InputError, match=message):
        call(gate, arm)
