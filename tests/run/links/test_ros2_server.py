"""A served arm: what a program of ROS sees of it, what it takes, and what it refuses with a sentence."""

import signal
import subprocess
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from arms import arm_of
from commands import armctl_command
from ros2_controller import needs_ros2, use_loopback

import armctl

pytestmark = needs_ros2


class Client:
    """A program of ROS beside a served arm."""

    def __init__(self, namespace: str):
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import JointState
        from std_srvs.srv import Trigger
        from trajectory_msgs.msg import JointTrajectory

        from armctl.run.links.ros2_node import RosNode

        self.node = RosNode("client")
        base = f"/{namespace}/joint_trajectory_controller"
        self.states: list = []
        self.tips: list = []
        self.warnings: list[str] = []
        self.node.node.create_subscription(JointState, f"/{namespace}/joint_states", self.states.append, 10)
        self.node.node.create_subscription(PoseStamped, f"{base}/tip_pose", self.tips.append, 10)
        self.trajectories = self.node.node.create_publisher(JointTrajectory, f"{base}/joint_trajectory", 10)
        self.poses = self.node.node.create_publisher(PoseStamped, f"{base}/target_pose", 10)
        self.stop = self.node.node.create_client(Trigger, f"{base}/stop")
        assert self.node.wait_for(lambda: bool(self.states and self.trajectories.get_subscription_count()), 30.0)

    @property
    def q(self) -> np.ndarray:
        return np.array(self.states[-1].position)

    def send(self, motion: armctl.JointTrajectory, faster: int = 1, **changes) -> None:
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        times = np.linspace(0.0, motion.duration, 2 + int(motion.duration / 0.02))
        message = JointTrajectory(joint_names=list(motion.joint_names))
        for t, q, v, a in zip(times, *motion.sample(times)[:3], strict=True):
            at = Duration(sec=int(t / faster), nanosec=round(1e9 * (t / faster % 1.0)) % 10**9)
            point = JointTrajectoryPoint(time_from_start=at)
            point.positions = q.tolist()
            point.velocities = (faster * v).tolist()
            point.accelerations = (faster**2 * a).tolist()
            message.points.append(point)
        for name, value in changes.items():
            setattr(message, name, value)
        self.trajectories.publish(message)

    def wait_for(self, condition, seconds: float = 20.0) -> None:
        assert self.node.wait_for(condition, seconds)

    def rests_at(self, q: np.ndarray) -> bool:
        return bool(np.abs(self.q - q).max() < 1e-3 and np.abs(self.states[-1].velocity).max() < 1e-3)


@contextmanager
def served(arm: armctl.Arm, namespace: str):
    """A simulated arm that is served in another thread, and a client of it; and what the node logs."""
    use_loopback()
    is_over = threading.Event()
    link = armctl.links.PlantLink(arm, real_time=True)

    def serve() -> None:
        with armctl.Robot(arm, link, speed=1.0, tip_speed=10.0) as robot:
            armctl.links.serve_ros2(robot, namespace=namespace, until=is_over.is_set)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    client = None
    try:
        client = Client(namespace)
        yield client
    finally:
        is_over.set()
        if client is not None:
            client.node.close()
        thread.join(30.0)


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def test_a_served_arm_takes_trajectories_poses_and_a_stop_and_refuses_bad_ones(arm: armctl.Arm, capfd):
    rng = np.random.default_rng(1)
    with served(arm, "served") as client:
        assert list(client.states[-1].name) == list(arm.joint_names)
        client.wait_for(lambda: bool(client.tips))
        p = client.tips[-1].pose.position
        assert np.abs([p.x, p.y, p.z] - arm.fk(arm.home).position).max() < 1e-3
        q = arm.home
        for _ in range(2):
            goal = arm.home + 0.2 * (arm.limits.random(arm.home, 1, rng)[0] - arm.home)
            client.send(armctl.move_j(arm, q, goal))
            client.wait_for(lambda goal=goal: client.rests_at(goal))
            q = goal
        client.send(armctl.move_j(arm, arm.home + 0.3, arm.home))  # from another place
        client.send(armctl.move_j(arm, q, arm.home), joint_names=["a", "b", "c"])
        client.send(armctl.move_j(arm, q, arm.home), points=[])
        client.send(armctl.move_j(arm, q, arm.home), faster=20)
        client.wait_for(lambda: len(client.states) > 0 and time.sleep(0.5) is None)
        assert client.rests_at(q)
        from geometry_msgs.msg import PoseStamped

        pose = PoseStamped()
        pose.header.frame_id = "elsewhere"
        client.poses.publish(pose)
        tip = arm.fk(arm.home + np.array([0.3, 0.1, 0.2]))
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = tip.position.tolist()
        o = pose.pose.orientation
        o.w, o.x, o.y, o.z = tip.quat.tolist()
        client.poses.publish(pose)
        client.wait_for(lambda: bool(np.abs(arm.fk(client.q).position - tip.position).max() < 1e-3))
        q = client.q
        client.send(armctl.move_j(arm, q, arm.home, speed=0.1))
        client.wait_for(lambda: bool(np.abs(client.q - q).max() > 0.05))
        from std_srvs.srv import Trigger

        future = client.stop.call_async(Trigger.Request())
        client.wait_for(future.done)
        client.wait_for(lambda: bool(np.abs(client.states[-1].velocity).max() < 1e-3))
        stopped = client.q
        along = (stopped - q) @ (arm.home - q) / np.sum(np.square(arm.home - q))
        assert 0.02 < along < 0.9
        assert np.abs(stopped - q - along * (arm.home - q)).max() < 1e-3
    said = capfd.readouterr().err
    for sentence in (
        "plan from where the arm is",
        "message: it is for the joints a, b, c, but the arm has",
        "since it has no points",
        "not sent: joint",
        "target_pose: the frame 'elsewhere' is unknown",
    ):
        assert sentence in said, said


@pytest.mark.full
def test_the_command_serves_until_ctrl_c_and_ends_cleanly(arm: armctl.Arm):
    use_loopback()
    command = armctl_command("ros2", "serve", "robot_arm_3dof", "--namespace", "command")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        client = Client("command")
        try:
            client.send(armctl.move_j(arm, arm.home, arm.home + 0.2))
            client.wait_for(lambda: bool(np.abs(client.q - arm.home).max() > 0.02))
            server.send_signal(signal.SIGINT)
            said, problems = server.communicate(timeout=30.0)
        finally:
            client.node.close()
            server.kill()
    assert server.returncode == 0, problems
    assert "the arm is at rest; the node ends" in said


@pytest.mark.full
def test_a_second_node_of_one_name_is_refused(arm: armctl.Arm):
    named = "another node is called /twice/joint_trajectory_controller"
    deadline = time.monotonic() + 60.0
    with (
        served(arm, "twice"),
        armctl.Robot(arm, armctl.links.PlantLink(arm)) as robot,
        pytest.raises(armctl.LinkError, match=named),
    ):
        armctl.links.serve_ros2(robot, namespace="twice", until=lambda: time.monotonic() > deadline)


def test_wrong_arguments_of_a_server_are_one_sentence(arm: armctl.Arm):
    with pytest.raises(armctl.InputError, match="robot: "):
        armctl.links.serve_ros2(arm)
    with armctl.Robot(arm, armctl.links.PlantLink(arm)) as robot:
        with pytest.raises(armctl.InputError, match="rate: expected a number in"):
            armctl.links.serve_ros2(robot, rate=0.0)
        with pytest.raises(armctl.InputError, match="controller: 'a b' is no name of ROS"):
            armctl.links.serve_ros2(robot, controller="a b")
