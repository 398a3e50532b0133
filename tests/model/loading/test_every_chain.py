"""Every chain of every installed robot: the model is MuJoCo's, reachable poses are solved, computed torque is exact."""

from dataclasses import replace

import mujoco_menagerie as menagerie
import numpy as np
import pytest
from arms import at_hand, some_of
from chain_check import EXPLAINED_TRACKING, arms_of, check_chain
from synthetic import limb, motors

from armctl.model.loading.catalog import BUNDLED

POSES = 40  # at each chain
ROBOTS = [BUNDLED, *(f"{robot.name}/{robot.default_model}" for robot in menagerie.robots() if at_hand(robot.name))]
CHECKED = ("franka_emika_panda", "universal_robots_ur5e", "unitree_h1")  # by `make test-all`
FULL = [robot for robot in ROBOTS if robot.partition("/")[0] in CHECKED]
SOFT = '<equality><joint joint1="c" joint2="b" polycoef="0 1 0 0 0" solref="0.02 1" solimp="0.9 0.9 0.001 0.5 2"/></equality>'


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
@pytest.mark.parametrize("robot", some_of(ROBOTS, [BUNDLED, "unitree_go2/go2"], FULL))
def test_every_chain_keeps_its_promises(robot: str):
    for base, arm in arms_of(robot):
        check = check_chain(arm, base, POSES)
        assert check.ok, f"{arm}: {check.reason}"


def test_a_soft_equality_is_noted_and_its_error_is_bounded_too(load):
    arm = load(limb("a b c", joint='armature="0.05"'), SOFT + motors("a b"))
    check = check_chain(arm, "world", POSES)
    assert check.tracking_note == "an equality of the model ties joints to each other, and is a soft constraint"
    assert check.tracking_bound == EXPLAINED_TRACKING


def test_a_check_fails_for_a_chain_that_is_out_of_its_bounds(bundled):
    check = check_chain(bundled, "world", POSES)
    assert check
    assert check.reason == ""
    for name, value, words in (
        ("parity", 1e-6, "the model differs from MuJoCo's by 1e-06"),
        ("ik_success", 0.9, "inverse kinematics solves 90.00 % of reachable poses"),
        ("computed_torque_error", 1e-5, "computed torque has an error of 1e-05, above 1e-06"),
        ("computed_torque_error", np.nan, "computed torque has an error of nan"),
    ):
        worse = replace(check, **{name: value})
        assert not worse
        assert words in worse.reason
    explained = replace(check, computed_torque_error=0.1, tracking_note="a motor saturates")
    assert not explained.ok
