"""LeRobotArm: the interface of LeRobot's `Robot`, over a simulation and over a robot behind a link."""

import subprocess
import sys

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.sim.commands import Commands

KEYS = ["shoulder_yaw.pos", "shoulder_pitch.pos", "elbow.pos"]
# The abstract members of lerobot.robots.Robot, version 0.4, and the attributes that its loops read.
MEMBERS = {
    "observation_features", "action_features", "is_connected", "connect", "is_calibrated", "calibrate", "configure",
    "get_observation", "send_action", "disconnect", "name", "id", "robot_type", "cameras", "calibration",
}  # fmt: skip


def simulation() -> Commands:
    return armctl.Simulation(arm_of("robot_arm_3dof"))


def robot() -> Commands:
    arm = arm_of("robot_arm_3dof")
    return armctl.Robot(arm, armctl.links.PlantLink(arm), speed=0.5, tip_speed=1.0)


def action(q: np.ndarray) -> dict[str, float]:
    return dict(zip(KEYS, q.tolist(), strict=True))


def test_it_has_the_members_and_shapes_of_the_interface_before_it_is_connected():
    arm = armctl.links.LeRobotArm(simulation())
    assert {name for name in dir(arm) if not name.startswith("_")} >= MEMBERS
    assert arm.action_features == arm.observation_features == dict.fromkeys(KEYS, float)
    assert (arm.is_connected, arm.is_calibrated, arm.robot_type) == (False, True, "robot_arm_3dof")
    assert arm.calibrate() is arm.configure() is None


@pytest.mark.parametrize("made", [simulation, robot])
def test_a_policy_loop_moves_the_arm_within_its_limits(made):
    arm = armctl.links.LeRobotArm(made(), frames_per_second=30.0)
    home = arm.robot.state.q
    begin = arm.robot.data.time
    arm.connect()
    assert arm.is_connected
    for k in range(60):
        observation = arm.get_observation()
        assert set(observation) == set(arm.observation_features)
        assert all(type(value) is arm.observation_features[key] for key, value in observation.items())
        wanted = action(home + 0.3 * np.sin(0.05 * k) * np.ones(3))
        assert arm.send_action(wanted) == pytest.approx(wanted)
    assert np.array(list(arm.get_observation().values())) == pytest.approx(home + 0.3 * np.sin(0.05 * 59), abs=0.02)
    arm.disconnect()
    log = arm.robot.log
    assert arm.robot.data.time - begin == pytest.approx(2.0, abs=0.5)
    assert log.failure == ""
    limits = arm.robot.arm.limits
    for order, bound in enumerate((limits.v_max, limits.a_max, limits.j_max), start=1):
        assert (np.abs(np.diff(log.q_ref, order, axis=0)) / log.dt**order <= 1.001 * bound).all()
    assert not arm.is_connected
    assert arm.robot.move_j(home)


def test_an_action_is_moved_inside_the_limits_and_a_wrong_one_changes_nothing():
    arm = armctl.links.LeRobotArm(simulation())
    arm.connect()
    limits = arm.robot.arm.limits
    assert arm.send_action(action(np.full(3, 100.0))) == pytest.approx(action(limits.q_max))
    before = arm.robot.data.time
    for wrong in ({}, {**action(np.zeros(3)), "gripper.pos": 1.0}, [0.0, 0.0, 0.0]):
        with pytest.raises(armctl.InputError, match=r"action: expected a dictionary with shoulder_yaw\.pos"):
            arm.send_action(wrong)
    with pytest.raises(armctl.InputError, match="is nan"):
        arm.send_action(action(np.array([0.0, np.nan, 0.0])))
    assert arm.robot.data.time == before
    arm.disconnect()


def test_without_a_connection_it_refuses_and_a_second_one_too():
    arm = armctl.links.LeRobotArm(simulation())
    for call in (arm.get_observation, lambda: arm.send_action(action(np.zeros(3)))):
        with pytest.raises(armctl.LinkError, match=r"not connected; call connect\(\) first"):
            call()
    arm.disconnect()
    arm.connect()
    with pytest.raises(armctl.LinkError, match="connected already"):
        arm.connect()
    with pytest.raises(armctl.InputError, match="robot: "):
        armctl.links.LeRobotArm("panda")


def test_the_end_of_the_robot_is_an_error_with_its_reason():
    model = arm_of("robot_arm_3dof")
    behind = armctl.Robot(model, armctl.links.PlantLink(model, faults={100: "cartesian_reflex"}), speed=0.5, tip_speed=1.0)
    arm = armctl.links.LeRobotArm(behind)
    arm.connect()

    def send_sixty() -> None:
        for k in range(60):
            arm.send_action(action(model.home + 0.002 * k))

    with pytest.raises(armctl.LinkError, match="cartesian_reflex"):
        send_sixty()
    arm.disconnect()
    assert behind.log.failure == "cartesian_reflex"


def test_it_imports_neither_torch_nor_lerobot():
    code = "import sys, armctl.links; armctl.links.LeRobotArm; print({'torch', 'lerobot'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
