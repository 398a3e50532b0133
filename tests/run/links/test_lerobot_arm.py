"""LeRobotArm: the interface of LeRobot's `Robot`, over a simulation and over a robot behind a link."""

import subprocess
import sys

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.run.execution.commands import Commands

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
    arm = armctl.LeRobotArm(simulation())
    assert {name for name in dir(arm) if not name.startswith("_")} >= MEMBERS
    assert arm.action_features == arm.observation_features == dict.fromkeys(KEYS, float)
    assert (arm.is_connected, arm.is_calibrated, arm.robot_type) == (False, True, "robot_arm_3dof")
    assert arm.calibrate() is arm.configure() is None


@pytest.mark.parametrize("made", [simulation, robot])
def test_a_policy_loop_moves_the_arm_within_its_limits(made):
    arm = armctl.LeRobotArm(made(), frames_per_second=30.0)
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
    arm = armctl.LeRobotArm(simulation())
    arm.connect()
    limits = arm.robot.arm.limits
    assert arm.send_action(action(limits.q_max + 1.0)) == pytest.approx(action(limits.q_max))
    before = arm.robot.data.time
    for wrong in ({}, {**action(np.zeros(3)), "finger.pos": 1.0}, [0.0, 0.0, 0.0]):
        with pytest.raises(armctl.InputError, match=r"action: expected a dictionary with shoulder_yaw\.pos"):
            arm.send_action(wrong)
    with pytest.raises(armctl.InputError, match="is nan"):
        arm.send_action(action(np.array([0.0, np.nan, 0.0])))
    assert arm.robot.data.time == before
    arm.disconnect()


def test_without_a_connection_it_refuses_and_a_second_one_too():
    arm = armctl.LeRobotArm(simulation())
    for call in (arm.get_observation, lambda: arm.send_action(action(np.zeros(3)))):
        with pytest.raises(armctl.LinkError, match=r"not connected; call connect\(\) first"):
            call()
    arm.disconnect()
    arm.connect()
    with pytest.raises(armctl.LinkError, match="connected already"):
        arm.connect()
    with pytest.raises(armctl.InputError, match="robot: "):
        armctl.LeRobotArm("panda")


def test_the_end_of_the_robot_is_an_error_with_its_reason():
    model = arm_of("robot_arm_3dof")
    behind = armctl.Robot(model, armctl.links.PlantLink(model, faults={100: "cartesian_reflex"}), speed=0.5, tip_speed=1.0)
    arm = armctl.LeRobotArm(behind)
    arm.connect()

    def send_sixty() -> None:
        for k in range(60):
            arm.send_action(action(model.home + 0.002 * k))

    with pytest.raises(armctl.LinkError, match="cartesian_reflex"):
        send_sixty()
    arm.disconnect()
    assert behind.log.failure == "cartesian_reflex"


def test_it_imports_neither_torch_nor_lerobot():
    code = "import sys, armctl.run.links; armctl.LeRobotArm; print({'torch', 'lerobot'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# Numbers of an arm in degrees, or -100 to 100, that a program for rad would send to the stops of the joints.
IN_OTHER_UNITS = [(90.0, 0.0, 0.0), (0.0, -30.0, 20.0), (10.0, -30.0, 20.0), (-100.0, 100.0, 0.0), (0.1, 0.2, 45.0)]


@pytest.mark.parametrize("numbers", IN_OTHER_UNITS)
@pytest.mark.parametrize("made", [simulation, robot])
def test_degrees_are_refused_with_a_question_and_nothing_moves(made, numbers):
    arm = armctl.LeRobotArm(made())
    home = arm.robot.state.q
    arm.connect()
    for _ in range(5):
        with pytest.raises(armctl.LimitError, match=r"action: .* is outside .* rad; degrees\? .*units=\"degrees\"") as caught:
            arm.send_action(action(np.array(numbers)))
        assert len(str(caught.value)) <= 400
    arm.disconnect()
    assert np.abs(arm.robot.state.q - home).max() < 1e-3


def test_degrees_and_shares_of_the_range_are_read_and_shown_in_the_same_unit():
    model = arm_of("robot_arm_3dof")
    limits = model.limits
    middle = 0.5 * (limits.q_min + limits.q_max)
    wanted = model.home + np.array([0.2, -0.1, 0.15])
    for options, numbers in (
        ({}, wanted),
        ({"units": "degrees"}, wanted * 180.0 / np.pi),
        ({"units": "degrees", "zeros": "middle"}, (wanted - middle) * 180.0 / np.pi),
        ({"units": "range_m100_100"}, -100.0 + 200.0 * (wanted - limits.q_min) / (limits.q_max - limits.q_min)),
    ):
        arm = armctl.LeRobotArm(armctl.Simulation(model), **options)
        arm.connect()
        for _ in range(60):
            assert arm.send_action(action(numbers)) == pytest.approx(action(numbers))
        assert list(arm.get_observation().values()) == pytest.approx(numbers, abs=0.2)
        assert arm.robot.state.q == pytest.approx(wanted, abs=2e-3)
        arm.disconnect()


def test_numbers_far_outside_are_refused_in_every_unit():
    for units in ("degrees", "range_m100_100"):
        arm = armctl.LeRobotArm(simulation(), units=units)
        arm.connect()
        with pytest.raises(armctl.LimitError, match=f'read with units="{units}"'):
            arm.send_action(action(np.array([0.0, 0.0, 4000.0])))
        arm.disconnect()


def test_joints_can_have_other_names():
    names = ["shoulder_pan", "shoulder_lift", "elbow_flex"]
    arm = armctl.LeRobotArm(simulation(), names=names)
    assert list(arm.action_features) == [f"{name}.pos" for name in names]
    arm.connect()
    home = arm.robot.state.q
    for keys in (arm.action_features, KEYS):
        sent = dict(zip(keys, home.tolist(), strict=True))
        assert arm.send_action(sent) == pytest.approx(sent)
    arm.disconnect()
    for wrong in (["a", "b"], ["a", "a", "b"]):
        with pytest.raises(armctl.InputError, match="names: expected 3 different names"):
            armctl.LeRobotArm(simulation(), names=wrong)


def test_an_arm_without_gripper_refuses_its_number_or_ignores_it():
    wanted = {**action(arm_of("robot_arm_3dof").home), "gripper.pos": 40.0}
    arm = armctl.LeRobotArm(simulation())
    arm.connect()
    with pytest.raises(armctl.InputError, match=r"gripper\.pos: .* has no gripper .* gripper=False\) ignores it"):
        arm.send_action(wanted)
    arm.disconnect()
    arm = armctl.LeRobotArm(simulation(), gripper=False)
    arm.connect()
    assert "gripper.pos" not in arm.send_action(wanted)
    arm.disconnect()


def test_the_names_and_the_gripper_of_an_so100_are_understood():
    arm = armctl.LeRobotArm(armctl.Simulation(arm_of("so_arm100")), units="degrees")
    keys = [f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")]
    assert list(arm.action_features) == [*keys, "gripper.pos"]
    arm.connect()
    home = arm.robot.state.q
    here = dict(zip(keys, np.degrees(home).tolist(), strict=True))
    mujoco_joint = arm.robot.model.joint("Jaw")
    angles = []
    for opening in (0.0, 100.0, 50.0):
        for _ in range(45):
            assert arm.send_action({**here, "gripper.pos": opening})["gripper.pos"] == opening
        assert arm.get_observation()["gripper.pos"] == pytest.approx(opening, abs=3.0)
        angles.append(float(arm.robot.data.qpos[mujoco_joint.qposadr[0]]))
    assert angles[0] < angles[2] < angles[1]
    assert arm.robot.state.q == pytest.approx(home, abs=2e-2)
    for wrong in (1000.0, -100.0, float("nan")):
        with pytest.raises(armctl.InputError, match=r"gripper\.pos"):
            arm.send_action({**here, "gripper.pos": wrong})
    with pytest.raises(armctl.LimitError, match="units"):
        arm.send_action(dict.fromkeys(keys, 9000.0))
    arm.disconnect()
