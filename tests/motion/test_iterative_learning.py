"""Iterative learning: the error of a repeated motion falls, whatever the controller's model lacks."""

import numpy as np
import pytest
from arms import arm_of

import armctl


@pytest.mark.parametrize("name", ["robot_arm_3dof", "planar", "panda", "ur5e"])
def test_ten_repetitions_lower_the_error_twenty_times_with_wrong_friction_and_payload(name):
    arm = arm_of(name)
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.4))
    plant = armctl.Plant(payload=0.3, coulomb_friction=0.02 * arm.limits.tau_max.min())
    learning = armctl.IterativeLearning(arm, motion)
    for _ in range(11):
        rms = learning.update(armctl.simulate(arm, "computed-torque", learning.reference, plant))
    assert rms == learning.errors[10]
    assert learning.errors[0] > 1e-4
    assert learning.errors[10] < learning.errors[0] / 20


def test_a_controller_without_a_model_learns_gravity(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4, speed=0.5)
    learning = armctl.IterativeLearning(bundled, motion, bandwidth=60.0)
    for _ in range(8):
        learning.update(armctl.simulate(bundled, "pd", learning.reference))
    assert learning.errors[-1] < 0.1 * learning.errors[0]


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


def test_an_incomplete_run_is_refused(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)
    learning = armctl.IterativeLearning(bundled, motion)
    with pytest.raises(armctl.InputError, match="it is not a complete run of the reference"):
        learning.update(armctl.simulate(bundled, "pd", motion))
