"""Motions made better: within all limits, proved free, never worse, and the same bits for the same seed."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from collidable import arm_among, placed

import armctl

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


@pytest.mark.parametrize("weights", WEIGHTS, ids=["time", "torque", "time and vibration", "distance"])
def test_the_motion_costs_less_and_is_free_within_all_limits(arm, motion, weights):
    better = armctl.optimize(arm, motion, evaluations=80, **weights)
    assert better, better.reason
    assert better.clearance
    assert_free(arm, better.motion)
    for t, q in ((0.0, START), (better.motion.duration, GOAL)):
        np.testing.assert_allclose(better.motion(t).q, q, atol=1e-12)
        np.testing.assert_allclose(better.motion(t).v, 0.0, atol=1e-9)
    named = {"time": 0.0} | weights
    ratios = [getattr(better.after, name) / getattr(better.before, name) for name in named]
    assert better.cost == pytest.approx(np.average(ratios, weights=list(named.values())), rel=1e-9)
    assert better.cost < 0.995
    assert better.evaluations == 80


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


def test_weak_motors_are_respected(arm, motion):
    held = np.abs([arm.gravity(q) for q in motion.sample(np.linspace(0.0, motion.duration, 100)).q]).max(axis=0)
    needed = np.array(armctl.check_torque(arm, motion).ratios) * arm.limits.tau_max
    weak = arm.with_limits(replace(arm.limits, tau_max=1.1 * held + 0.7 * (needed - held)))
    slowed = armctl.move_free(weak, START, GOAL)
    assert slowed.slowed is not None
    better = armctl.optimize(weak, slowed, evaluations=60)
    assert better
    assert_free(weak, better.motion)


def test_the_same_seed_gives_the_same_bits(arm, motion):
    first, again, other = (armctl.optimize(arm, motion, evaluations=40, seed=seed).motion for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.coefficients, again.coefficients)
    assert first.coefficients.shape != other.coefficients.shape or (first.coefficients != other.coefficients).any()


def test_a_motion_that_cannot_be_made_better_is_returned(arm):
    straight = armctl.move_j(arm, START, START + 0.1)
    same = armctl.optimize(arm, straight, evaluations=20)
    assert not same
    assert same.motion is straight
    assert same.cost == 1.0
    assert same.reason == "none of 20 motions was better and proved free"


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
