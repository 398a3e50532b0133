"""Robot.interlock: what a person's switch, or a program's stop, does before and on a motion."""

import numpy as np
import pytest
from arms import BUNDLED, arm_of

import armctl

RELEASED = "the switch was released"


@pytest.fixture
def robot():
    with armctl.Robot(arm_of(BUNDLED), armctl.links.PlantLink(arm_of(BUNDLED)), speed=0.5) as robot:
        yield robot


def test_a_motion_does_not_begin_while_the_interlock_has_a_reason(robot):
    robot.interlock = lambda: RELEASED
    before = robot.state.q
    for result in (robot.move_j(robot.arm.home + 0.2), robot.move_to(robot.tip.position + 0.02)):
        assert result.reason == RELEASED
    assert robot.run(armctl.move_j(robot.arm, before, before + 0.1)).failure == RELEASED
    assert (robot.state.q == before).all()
    robot.interlock = None
    assert robot.move_j(robot.arm.home + 0.2)


def test_the_arm_brakes_on_its_path_when_the_interlock_gets_a_reason(robot):
    start = robot.state.q
    goal = robot.arm.home + 0.4
    robot.interlock = lambda: RELEASED if robot.data.time > 0.2 else ""
    result = robot.move_j(goal)
    assert result.reason == RELEASED
    moved = result.log.q_ref - start
    assert 0.0 < moved[-1, 0] < 0.3
    assert np.ptp(moved, axis=1).max() < 1e-9  # all joints have the same way: it stayed on the straight line
    steps = np.diff(result.log.q_ref, axis=0)
    assert np.abs(steps[-1]).max() < 1e-6  # and came to rest
    assert np.abs(np.diff(steps, axis=0)).max() < robot.arm.limits.a_max.max() * robot.dt**2 * 1.01
    robot.interlock = None
    assert robot.move_back()
    assert np.abs(robot.state.q - start).max() < 1e-3


def test_an_interlock_may_look_at_the_state_of_the_robot(robot):
    start = robot.state.q
    robot.interlock = lambda: "far enough" if np.abs(robot.state.q - start).max() > 0.05 else ""
    result = robot.move_j(robot.arm.home + 0.4)
    assert result.reason == "far enough"
    assert 0.05 < np.abs(robot.state.q - start).max() < 0.3


def test_an_interlock_that_fails_is_a_reason_and_one_that_is_no_function_an_error(robot):
    robot.interlock = lambda: 1 / 0
    assert robot.move_j(robot.arm.home + 0.2).reason.startswith("the interlock failed (ZeroDivisionError")
    with pytest.raises(armctl.InputError, match="interlock: expected a function"):
        robot.interlock = "stop"
