"""Iterative learning: the error of a repeated motion falls, whatever law follows it and whatever its model lacks."""

import numpy as np
import pytest
from arms import arm_of, some_of
from synthetic import Shape, serial_arm

import armctl

REPETITIONS = 10
MADE = ("slender", "short", "robot_arm_3dof")
SLENDER = Shape(0.35, 3.0, 150.0, taper=0.85, joints=5, joint='armature="0.08" damping="0.6"', home="0.3 -0.4 0.8 0.5 -0.6")
SHORT = Shape(0.15, 1.5, 80.0, joints=3, joint='armature="0.03"', home="-0.2 0.6 0.5")


def learnt(arm, motion, law, plant, **options):
    learning = armctl.IterativeLearning(arm, motion, **options)
    for _ in range(REPETITIONS + 1):
        rms = learning.update(armctl.simulate(arm, law, learning.reference, plant))
        assert rms == learning.errors[-1]
    return learning


@pytest.mark.parametrize("law", ["pd", "pd-gravity", "pd-feedforward", "computed-torque", "computed-torque-observer", "lqr"])
@pytest.mark.parametrize("name", some_of([*MADE, "panda", "ur5e"], MADE))
def test_ten_repetitions_lower_the_error_twenty_times_with_wrong_friction_and_payload(name, law, tmp_path):
    shape = {"slender": SLENDER, "short": SHORT}.get(name)
    arm = serial_arm(tmp_path, shape) if shape else arm_of(name)
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.4), speed=0.8)
    plant = armctl.Plant(payload=0.3, coulomb_friction=0.025 * arm.limits.tau_max.min())
    learning = learnt(arm, motion, law, plant)
    assert learning.errors[0] > 1e-4
    assert learning.errors[-1] < learning.errors[0] / 20
    assert max(learning.errors[1:]) < learning.errors[0]


@pytest.mark.parametrize(
    "plant", [armctl.Plant(delay=3, motor=0.002), armctl.Plant(continuous=True, encoder_bits=18, seed=4)], ids=str
)
def test_delays_and_encoders_are_learnt_too(plant, tmp_path):
    arm = serial_arm(tmp_path, SLENDER)
    turn = np.random.default_rng(8).uniform(-0.5, 0.5, arm.n)
    learning = learnt(arm, armctl.move_j(arm, arm.home, arm.home + turn, speed=0.6), "pd-gravity", plant)
    assert learning.errors[-1] < learning.errors[0] / 20


def test_a_run_that_ends_with_its_reference_is_complete(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.2)
    learning = armctl.IterativeLearning(bundled, motion)
    learning.update(armctl.simulate(bundled, "pd", learning.reference, dwell=0.0))
    shorter = armctl.move_j(bundled, bundled.home, bundled.home + 0.15)
    assert shorter.duration < motion.duration - 0.01
    with pytest.raises(armctl.InputError, match="not a complete run"):
        learning.update(armctl.simulate(bundled, "pd", shorter, dwell=0.0))


def test_what_made_it_worse_is_not_built_upon(bundled):
    """A repetition on another plant spoils the errors of one repetition: the next reference is near the best one again."""
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4, speed=0.5)
    learning = armctl.IterativeLearning(bundled, motion)
    learning.update(armctl.simulate(bundled, "pd-gravity", learning.reference))
    for payload in (0.0, 0.0, 20.0, 0.0, 0.0, 0.0):
        best = learning.best
        learning.update(armctl.simulate(bundled, "pd-gravity", learning.reference, armctl.Plant(payload=payload)))
        assert (learning.best is best) == (learning.errors[-1] > min(learning.errors))
    assert learning.errors[3] > 3 * learning.errors[2]
    assert learning.errors[-1] < learning.errors[2]
    again = armctl.simulate(bundled, "pd-gravity", learning.best)
    moving = again.t <= motion.duration + 0.3
    assert np.sqrt(np.mean((motion.sample(again.t).q - again.q)[moving] ** 2)) == pytest.approx(min(learning.errors), rel=1e-6)


def test_a_gain_below_one_learns_a_share_of_each_error(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)
    whole, half = (armctl.IterativeLearning(bundled, motion, gain=gain) for gain in (1.0, 0.5))
    log = armctl.simulate(bundled, "pd", motion, dwell=0.3)
    times = np.linspace(0.0, motion.duration, 50)
    changes = []
    for learning in (whole, half):
        learning.update(log)
        changes.append(learning.reference.sample(times).q - motion.sample(times).q)
    assert changes[1] == pytest.approx(0.5 * changes[0], abs=1e-6)


def test_the_first_reference_is_the_motion_and_a_repetition_starts_where_it_does(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)
    learning = armctl.IterativeLearning(bundled, motion, dwell=0.5)
    times = np.linspace(0.0, motion.duration + 0.5, 300)
    assert learning.reference.sample(times).q == pytest.approx(motion.sample(times).q, abs=1e-5)
    learning.update(armctl.simulate(bundled, "pd", learning.reference))
    start = learning.reference(0.0)
    assert start.q == pytest.approx(bundled.home, abs=1e-12)
    assert np.abs(start.v).max() < 1e-9
    assert np.abs(learning.reference.sample(times).q - motion.sample(times).q).max() > 1e-3


def test_a_learnt_reference_starts_and_ends_at_rest_also_where_its_errors_end_under_way(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)
    learning = armctl.IterativeLearning(bundled, motion, dwell=0.0)
    for _ in range(3):
        log = armctl.simulate(bundled, "pd", learning.reference)
        assert np.abs((log.q - motion.sample(log.t).q)[-1]).max() > 1e-3
        learning.update(log)
    ends = learning.reference.sample([0.0, learning.reference.duration])
    assert np.abs(learning.reference.sample([motion.duration - 0.02]).v).max() > 0.01
    assert ends.v == pytest.approx(np.zeros((2, bundled.n)), abs=1e-9)
    assert ends.a == pytest.approx(np.zeros((2, bundled.n)), abs=1e-6)


def test_an_incomplete_run_is_refused(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)
    learning = armctl.IterativeLearning(bundled, motion)
    with pytest.raises(armctl.InputError, match="it is not a complete run of the reference"):
        learning.update(armctl.simulate(bundled, "pd", motion))
