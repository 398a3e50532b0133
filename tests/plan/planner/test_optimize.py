"""Motions made better: within all limits, proved free, never worse, and the same bits for the same seed."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arms import some_of
from collidable import arm_among, placed
from synthetic import BENT, serial_arm

import armctl
from armctl.model.collision.checkers import collision_checker
from armctl.plan.motion.torque_limits import InverseDynamics
from armctl.plan.planner.descent import Descent
from armctl.plan.planner.free_space import FreeSpace
from armctl.plan.planner.transcription import SAMPLES, Transcription

WALL = '<geom name="wall" type="box" size="0.3 0.02 0.45" pos="0.45 0 0.45"/>'
START = np.array([-0.8, 1.0, 0.4, 0.0, 0.3, 0.0])
GOAL = np.array([0.8, 1.0, 0.4, 0.0, 0.3, 0.0])

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("wall"), WALL)


@pytest.fixture(scope="module")
def motion(arm) -> armctl.JointTrajectory:
    return armctl.move_free(arm, START, GOAL)


def assert_free(arm, motion):
    """By the check of the package, and by MuJoCo's contacts."""
    assert armctl.check_clearance(arm, motion)
    assert motion.check_limits(arm.limits).ok
    assert armctl.check_torque(arm, motion).ok
    for q in motion.sample(np.arange(0.0, motion.duration, 2e-3)).q:
        assert not any(contact.dist < 0.0 for contact in placed(arm, q).contact)


WEIGHTS = [{"time": 1.0}, {"time": 0.0, "torque": 1.0}, {"time": 1.0, "vibration": 1.0}, {"time": 0.0, "distance": 1.0}]


@pytest.mark.parametrize(
    "weights",
    [pytest.param(WEIGHTS[0], marks=pytest.mark.nightly), *some_of(WEIGHTS[1:], WEIGHTS[-1:])],
    ids=["time", "torque", "time and vibration", "distance"],
)
def test_the_motion_costs_less_and_is_free_within_all_limits(arm, motion, weights):
    better = armctl.optimize(arm, motion, evaluations=150, **weights)
    assert better, better.reason
    assert better.clearance
    assert_free(arm, better.motion)
    for t, q in ((0.0, START), (better.motion.duration, GOAL)):
        np.testing.assert_allclose(better.motion(t).q, q, atol=1e-12)
        np.testing.assert_allclose(better.motion(t).v, 0.0, atol=1e-9)
    named = {"time": 0.0} | weights
    ratios = [getattr(better.after, name) / getattr(better.before, name) for name in named]
    assert better.cost == pytest.approx(np.average(ratios, weights=list(named.values())), rel=1e-9)
    assert better.cost < 0.9
    assert better.evaluations <= 150


def test_the_measures_are_those_of_the_motion(arm, motion):
    """The torque by MuJoCo's inverse dynamics."""
    before = armctl.optimize(arm, motion, evaluations=1).before
    times = np.linspace(0.0, motion.duration, 200)
    data = mujoco.MjData(arm.model)
    shares = []
    for t in times:
        setpoint = motion(t)
        data.qpos[:], data.qvel[:], data.qacc[:] = setpoint[:3]
        mujoco.mj_inverse(arm.model, data)
        shares.append(data.qfrc_inverse / arm.limits.tau_max)
    q = motion.sample(times).q
    assert before.time == motion.duration
    assert before.torque == pytest.approx(np.sqrt(np.mean(np.square(shares))), rel=1e-6)
    assert before.distance == pytest.approx(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    assert before.vibration == pytest.approx(np.sqrt(np.mean((motion.jerk(times) / arm.limits.j_max) ** 2)))


@pytest.mark.full
def test_weak_motors_are_respected(arm, motion):
    held = np.abs([arm.gravity(q) for q in motion.sample(np.linspace(0.0, motion.duration, 100)).q]).max(axis=0)
    needed = np.array(armctl.check_torque(arm, motion).ratios) * arm.limits.tau_max
    weak = arm.with_limits(replace(arm.limits, tau_max=1.1 * held + 0.7 * (needed - held)))
    slowed = armctl.move_free(weak, START, GOAL)
    assert slowed.slowed is not None
    better = armctl.optimize(weak, slowed, evaluations=150)
    assert better
    assert_free(weak, better.motion)


@pytest.fixture(scope="module")
def beside(arm) -> tuple[armctl.Arm, armctl.JointTrajectory]:
    """A straight motion beside the wall that weak motors slow down, and its arm."""
    goal = np.array([-1.9, -0.2, 1.3, 0.9, -0.6, 0.5])
    free = armctl.move_j(arm, START, goal)
    held = np.abs([arm.gravity(q) for q in free.sample(np.linspace(0.0, free.duration, 100)).q]).max(axis=0)
    needed = np.array(armctl.check_torque(arm, free).ratios) * arm.limits.tau_max
    weak = arm.with_limits(replace(arm.limits, tau_max=1.1 * held + 0.3 * (needed - held) + 0.1))
    return weak, armctl.move_j(weak, START, goal)


@pytest.mark.nightly
def test_weak_motors_move_faster_on_a_path_that_suits_them(beside):
    """Random waypoints saved 0.3 %. Judged by MuJoCo's inverse dynamics and distances at dense samples."""
    arm, straight = beside
    better = armctl.optimize(arm, straight, evaluations=150)
    assert better.motion.duration < 0.95 * straight.duration
    times = np.linspace(0.0, better.motion.duration, 2001)
    q, v, a = better.motion.sample(times)[:3]
    slack = 1.0 + 1e-6
    assert (q >= arm.limits.q_min).all()
    assert (q <= arm.limits.q_max).all()
    assert (np.abs(v) <= slack * arm.limits.v_max).all()
    assert (np.abs(a) <= slack * arm.limits.a_max).all()
    assert (np.abs(np.diff(a, axis=0)) <= slack * np.diff(times)[:, None] * arm.limits.j_max).all()
    step = times[1]
    assert (np.abs(np.diff(q, axis=0) / step - 0.5 * (v[1:] + v[:-1])) <= step**2 * arm.limits.j_max).all()
    assert (np.abs(np.diff(v, axis=0) / step - 0.5 * (a[1:] + a[:-1])) <= step * arm.limits.j_max).all()
    data = mujoco.MjData(arm.model)
    wall = arm.model.geom("wall").id
    links = [geom for geom in range(arm.model.ngeom) if geom != wall and arm.model.geom_contype[geom]]
    assert len(links) == 6
    for state in zip(q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(arm.model, data)
        assert (np.abs(data.qfrc_inverse) <= (1.0 + 1e-3) * arm.limits.tau_max).all()
        assert min(mujoco.mj_geomDistance(arm.model, data, wall, link, 1.0, None) for link in links) > 1e-3


@pytest.mark.full
def test_a_motion_over_a_wall_becomes_much_faster(arm, motion):
    """Random waypoints saved 4 %."""
    better = armctl.optimize(arm, motion)
    assert better.cost < 0.85
    assert_free(arm, better.motion)


@pytest.mark.full
def test_the_same_seed_gives_the_same_bits(tmp_path):
    planar = serial_arm(tmp_path, BENT["planar"], shapes="capsules")
    straight = armctl.move_j(planar, [0.2, 0.5, 0.9], [1.2, -0.3, 0.5])
    first, again, other = (armctl.optimize(planar, straight, vibration=1.0, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.motion.coefficients, again.motion.coefficients)
    np.testing.assert_array_equal(first.motion.knots, again.motion.knots)
    assert first.evaluations == again.evaluations
    assert first.evaluations != other.evaluations or first.cost != other.cost


def test_a_motion_that_cannot_be_made_better_is_returned(arm):
    straight = armctl.move_j(arm, START, START + 0.1)
    same = armctl.optimize(arm, straight, evaluations=60)
    assert not same
    assert same.motion is straight
    assert same.cost == 1.0
    assert same.reason == f"none of {same.evaluations} motions was better and proved free"


def test_no_motion_stays_none(arm):
    rest = armctl.move_j(arm, START, START)
    assert armctl.optimize(arm, rest).motion is rest


def test_the_derivatives_are_those_of_the_values(beside):
    """Cost, limits, distances and ends along a random direction, by central differences."""
    arm, straight = beside
    transcription = Transcription(arm.limits, InverseDynamics(arm), START, straight(straight.duration).q, straight.duration, 8)
    space = FreeSpace(collision_checker(arm), 0.05)
    descent = Descent(transcription, space, np.array([1.0, 2.0, 3.0, 0.5]), 10.0, lambda: None)
    rng = np.random.default_rng(0)
    x = transcription.unknowns(straight.sample(np.linspace(0.0, straight.duration, SAMPLES * 8 + 1)).q)
    x += 0.02 * rng.normal(size=x.size)
    direction = 1e-5 * rng.normal(size=x.size)
    for name in ("cost", "free", "gaps"):
        low, middle, high = (descent.at(x + share * direction) for share in (-1.0, 0.0, 1.0))
        by_difference = 0.5 * (getattr(high, name).values - getattr(low, name).values)
        slope = getattr(middle, name).slopes @ direction
        np.testing.assert_allclose(slope, by_difference, atol=2e-4 * np.abs(by_difference).max())


def test_wrong_arguments_are_explained(arm, motion):
    through = armctl.move_j(arm, START, GOAL)
    for wrong, message in (
        (lambda: armctl.optimize(arm, motion, time=0.0), "time, torque, vibration, distance: all weights are 0"),
        (lambda: armctl.optimize(arm, motion, torque=-1.0), "torque: "),
        (lambda: armctl.optimize(arm, START), "motion: "),
        (lambda: armctl.optimize(arm, motion.until(0.5 * motion.duration)), "motion: it starts or ends moving"),
    ):
        with pytest.raises(armctl.InputError, match=message):
            wrong()
    with pytest.raises(armctl.PlanError, match=r"motion: .*wall"):
        armctl.optimize(arm, through)
