"""The link to ROS 2 with real nodes: the program of a simulation, stops, kills, and what a robot of ROS gets wrong."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from arms import arm_of
from ros2_controller import controller_of, needs_ros2, use_loopback

import armctl
from armctl.run.links import ros2_connection
from armctl.run.links.host import LinkHost
from armctl.run.links.joint_states import JointStates

pytestmark = needs_ros2
GOAL = [1.2, 0.3, -1.0]


@pytest.fixture(scope="module", autouse=True)
def loopback():
    use_loopback()


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def program(robot: armctl.Robot | armctl.Simulation) -> list[armctl.MoveResult]:
    return [
        robot.move_j([0.4, 0.2, -1.2]),
        robot.move_to([0.3, 0.2, 0.3]),
        robot.move_to(robot.tip.position - np.array([0.0, 0.1, -0.05])),
        robot.move_to([3.0, 0.0, 0.0]),
    ]


def test_one_program_gives_the_same_results_in_simulation_behind_a_link_and_through_ros(arm: armctl.Arm):
    simulated = armctl.Simulation(arm.with_limits(arm.limits.at_speed(0.5)))
    with armctl.Robot(arm, armctl.links.PlantLink(arm), speed=0.5, tip_speed=1.0) as plant:
        expected = program(plant)
    in_simulation = program(simulated)
    with controller_of(arm, "same") as controller:
        link = armctl.links.ROS2(arm, namespace="same")
        with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
            results = program(robot)
            log = robot.log
    assert not controller.refused
    assert len(controller.accepted) == 3, controller.delays
    for result, of_plant, of_simulation in zip(results, expected, in_simulation, strict=True):
        assert result.ok == of_plant.ok == of_simulation.ok
        assert result.reason.partition(" ")[0] == of_plant.reason.partition(" ")[0]
        if result:
            assert result.position_error < 1e-3
            assert np.abs(result.log.q_ref[-1] - of_plant.log.q_ref[-1]).max() < 1e-3
            assert np.abs(result.log.q[-1] - result.log.q_ref[-1]).max() < 1e-6
    assert log is not None
    assert max(controller.jumps) < 1e-6


def host_of(link: armctl.links.ROS2) -> LinkHost:
    host = LinkHost(link)
    host.open()
    return host


def play(host: LinkHost, motion: armctl.JointTrajectory, limits: armctl.Limits, stop_after: float = np.inf) -> str:
    """Has a motion played, and stops it after some seconds; why it ended early."""
    played = host.play(motion.pieces, None, limits)
    assert not played.reason, played.reason
    began = time.monotonic()
    while host.streaming:
        host.advance()
        if time.monotonic() - began > stop_after:
            host.stop("enough")
    progress = host.poll()
    return progress.fault or progress.stopped


@pytest.mark.parametrize(
    "name", ["planar", *(pytest.param(name, marks=pytest.mark.full) for name in ("robot_arm_3dof", "redundant"))]
)
def test_motions_of_three_arms_arrive_whole_with_joints_in_any_order(name: str):
    arm = arm_of(name)
    rng = np.random.default_rng(3)
    q = arm.home + 0.3 * (arm.limits.random(arm.home, 2, rng) - arm.home)
    with controller_of(arm, f"three_{name}", q[0], joints=arm.joint_names[::-1] if name == "planar" else None) as controller:
        controller.disorder = True
        ordered = q[:, ::-1] if name == "planar" else q
        controller.q = ordered[0]
        host = host_of(armctl.links.ROS2(arm, namespace=f"three_{name}", dt=0.02))
        try:
            for k in (1, 0):
                motion = armctl.move_j(arm, q[1 - k], q[k])
                assert play(host, motion, arm.limits) == ""
                assert np.abs(controller.q - ordered[k]).max() < 1e-9
        finally:
            host.close()
    assert len(controller.accepted) == 2
    assert not controller.refused
    rows = np.array(controller.rows)[:, :: 1 if name != "planar" else -1]
    path = motion.sample(np.linspace(0.0, motion.duration, 4000)).q
    for row in rows[-40::4]:
        assert np.abs(path - row).max(axis=1).min() < 1e-3
    assert not controller.accepted[0].points[-1].velocities[0]


def test_a_stop_in_the_middle_ends_at_rest_on_the_path(arm: armctl.Arm):
    motion = armctl.move_j(arm, arm.home, GOAL, speed=0.5)
    with controller_of(arm, "stopped") as controller:
        host = host_of(armctl.links.ROS2(arm, namespace="stopped", lead=0.2))
        try:
            assert play(host, motion, arm.limits, stop_after=0.6) == "enough"
        finally:
            host.close()
        controller.wait_for_rest()
    rows = np.array(controller.rows)
    assert len(controller.accepted) == 2
    assert max(controller.jumps) < 1e-6
    along = (rows - arm.home) @ (GOAL - arm.home) / np.sum(np.square(GOAL - arm.home))
    assert np.abs(rows - arm.home - along[:, None] * (GOAL - arm.home)).max() < 1e-6
    assert 0.02 < along[-1] < 0.95
    assert np.abs(np.diff(controller.speeds, axis=0)).max() < 1.5 * arm.limits.a_max.max() * 0.03


PLANNER = f"""
import armctl
arm = armctl.load("robot_arm_3dof")
with armctl.Robot(arm, armctl.links.ROS2(arm, namespace="killed", lead=0.2), speed=0.3, tip_speed=0.5) as robot:
    robot.move_j({GOAL})
"""


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.full)], ids=["killed", "stopped"]
)
def test_without_a_planner_the_arm_gets_a_braking_path(arm: armctl.Arm, how: signal.Signals):
    with controller_of(arm, "killed") as controller, subprocess.Popen([sys.executable, "-c", PLANNER]) as planner:
        deadline = time.monotonic() + 60.0
        while np.abs(controller.q - arm.home).max() < 0.1:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        planner.send_signal(how)
        controller.wait_for_rest()
        planner.kill()
    assert len(controller.accepted) == 2
    along = (controller.q - arm.home) @ (GOAL - arm.home) / np.sum(np.square(GOAL - arm.home))
    assert np.abs(controller.q - arm.home - along * (GOAL - arm.home)).max() < 1e-6
    assert along < 0.95
    assert max(controller.jumps) < 1e-6


def test_a_simulated_clock_at_half_speed_changes_nothing(arm: armctl.Arm):
    motion = armctl.move_j(arm, arm.home, [0.2, 0.1, -1.1])
    with controller_of(arm, "sim", sim_time=0.5) as controller:
        with pytest.raises(armctl.LinkError, match="use_sim_time=True if the robot is simulated"):
            armctl.links.ROS2(arm, namespace="sim").open()
        host = host_of(armctl.links.ROS2(arm, namespace="sim", use_sim_time=True))
        began = time.monotonic()
        try:
            assert play(host, motion, arm.limits) == ""
        finally:
            host.close()
        assert time.monotonic() - began > 2.0 * motion.duration
        assert np.abs(controller.q - [0.2, 0.1, -1.1]).max() < 1e-9


def test_states_without_stamps_have_the_time_at_which_they_come(arm: armctl.Arm):
    with controller_of(arm, "unstamped") as controller:
        controller.zero_stamps = True
        host = host_of(armctl.links.ROS2(arm, namespace="unstamped"))
        try:
            assert play(host, armctl.move_j(arm, arm.home, [0.1, 0.0, -1.1]), arm.limits) == ""
        finally:
            host.close()
        assert np.abs(controller.q - [0.1, 0.0, -1.1]).max() < 1e-9


def test_what_speaks_against_a_robot_of_ros_is_one_sentence(arm: armctl.Arm, monkeypatch: pytest.MonkeyPatch):
    names = [f"joint_{k}" for k in range(3)]
    with controller_of(arm, "named", joints=names) as controller:
        controller.stamp_offset = -3.0
        with pytest.raises(armctl.LinkError, match=r"stamped .* s before this computer's time; synchronize") as caught:
            armctl.links.ROS2(arm, namespace="named", joints=names).open()
        seconds = float(str(caught.value).partition("stamped ")[2].split()[0])
        assert 3.0 <= seconds < 3.05  # as far as its states were on their way
        controller.stamp_offset = 0.0
        with pytest.raises(armctl.LinkError, match=r"it has no .*, but joint_0, joint_1 and joint_2; give joints="):
            armctl.links.ROS2(arm, namespace="named").open()
        monkeypatch.setattr(ros2_connection, "_DISCOVERY_S", 5.0)
        with pytest.raises(armctl.LinkError, match=r"no controller takes motions there.*others are taken on /named/joint"):
            armctl.links.ROS2(arm, "other_controller", "named", joints=names).open()
    monkeypatch.setattr(ros2_connection, "_DISCOVERY_S", 0.2)
    with pytest.raises(armctl.LinkError, match=r"/nowhere/joint_states: no message came .nobody publishes it in ROS_DOMAIN"):
        armctl.links.ROS2(arm, namespace="nowhere").open()


def test_a_controller_of_other_joints_is_refused(arm: armctl.Arm):
    q = np.append(arm.home, 0.0)
    with controller_of(arm, "more", q, joints=[*arm.joint_names, "finger"]) as controller:
        with pytest.raises(armctl.LinkError, match="also commands finger, which the model lacks; set its parameter"):
            armctl.links.ROS2(arm, namespace="more").open()
        controller.node.undeclare_parameter("joints")
        controller.node.declare_parameter("joints", [arm.joint_names[0]])
        with pytest.raises(armctl.LinkError, match=f"does not command {arm.joint_names[1]} and {arm.joint_names[2]}"):
            armctl.links.ROS2(arm, namespace="more").open()


def test_another_commander_is_named_before_anything_is_sent(arm: armctl.Arm):
    with controller_of(arm, "two") as controller:
        link = armctl.links.ROS2(arm, namespace="two")
        other = armctl.links.ROS2(arm, namespace="two")
        link.open()
        host = host_of(other)
        time.sleep(3.0)  # in which both nodes are found, on a busy computer too
        try:
            with pytest.raises(armctl.LinkError, match=r"commands /two/joint_trajectory_controller/joint_trajectory, too; end"):
                play(host, armctl.move_j(arm, arm.home, GOAL), arm.limits)
        finally:
            host.close()
            link.close()
        assert not controller.accepted


def test_a_controller_that_is_not_active_is_found_when_the_arm_does_not_move(arm: armctl.Arm):
    with controller_of(arm, "inactive") as controller:
        controller.active = False
        host = host_of(armctl.links.ROS2(arm, namespace="inactive"))
        try:
            fault = play(host, armctl.move_j(arm, arm.home, GOAL, speed=0.5), arm.limits)
            assert fault.startswith("the arm does not move: is /inactive/joint_trajectory_controller active")
            time.sleep(0.2)  # the braking path arrives
            controller.active = True
            host.recover()
            assert play(host, armctl.move_j(arm, arm.home, [0.1, 0.0, -1.1]), arm.limits) == ""
        finally:
            host.close()


def test_states_that_stop_coming_are_a_fault_and_the_arm_brakes(arm: armctl.Arm):
    with controller_of(arm, "silent") as controller:
        host = host_of(armctl.links.ROS2(arm, namespace="silent"))
        motion = armctl.move_j(arm, arm.home, GOAL, speed=0.3)
        try:
            host.play(motion.pieces, None, arm.limits)
            while host.streaming:
                host.advance()
                if len(controller.rows) and np.abs(controller.q - arm.home).max() > 0.1:
                    controller.publishes = False
            assert "no state for 0.5 s" in host.poll().fault
            controller.wait_for_rest()
            assert np.abs(controller.q - GOAL).max() > 0.05
            assert len(controller.accepted) == 2
            with pytest.raises(armctl.LinkError, match="no state for"):
                host.read()
        finally:
            host.close()


def states_of(*messages: tuple) -> JointStates:
    states = JointStates(["a", "b"], np.ones(2))
    for t, names, q in messages:
        states.take(t, names, q, [], [])
    return states


def test_joint_states_keep_the_newest_of_each_joint():
    states = states_of((1.0, ["b", "x"], [2.0, 9.0]), (1.1, ["a"], [1.0]), (1.05, ["a", "b"], [5.0, 2.01]), (1.1, ["a"], [7.0]))
    assert states.q.tolist() == [1.0, 2.01]
    assert states.missing == []
    assert states.seen == ["b", "x", "a"]
    assert states.problem == ""


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        ((1.1, ["a", "b"], [1.0]), "a message has 2 names and 1 positions"),
        ((1.1, ["a", "a"], [1.0, 2.0]), "a message has a twice, with different positions"),
        ((1.1, ["a"], [3.0]), "a jumps from 1.000 to 3.000 rad; do two nodes publish its state?"),
    ],
)
def test_messages_that_cannot_be_right_are_noted(message: tuple, problem: str):
    states = states_of((1.0, ["a", "b"], [1.0, 2.0]), message)
    assert states.problem + states.jump == problem


def test_states_of_a_clock_that_was_set_back_are_taken():
    states = states_of((100.0, ["a", "b"], [1.0, 2.0]), (0.1, ["a"], [1.0]))
    assert states.restarts == 1
    assert states.t.tolist() == [0.1, -np.inf]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"controller": "no name"}, "controller: 'no name' is no name of ROS"),
        ({"namespace": 3}, "namespace: expected a name of ROS, got 3"),
        ({"joints": ["a", "b"]}, "joints: expected 3 different names, got 2: a and b"),
        ({"dt": 1.0}, "dt: expected a number in"),
        ({"lead": 0.0}, "lead: expected a number in"),
        ({"envelope": 3}, "envelope: "),
    ],
)
def test_wrong_arguments_are_one_sentence(arm: armctl.Arm, arguments: dict, message: str):
    with pytest.raises(armctl.InputError, match=message):
        armctl.links.ROS2(arm, **arguments)
