"""A served arm: what a program of ROS sees of it, what it takes, and what it refuses with a sentence."""

import signal
import subprocess
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from commands import armctl_command
from ros2_controller import needs_ros2, use_loopback

import armctl

pytestmark = needs_ros2
NEAR = 1e-4  # rad, within which a simulated arm without faults ends a motion: that of its last tick is not published


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
        assert self.node.wait_for(lambda: bool(self.states and self.trajectories.get_subscription_count()), 90.0)

    @property
    def q(self) -> np.ndarray:
        return np.array(self.states[-1].position)

    def send(self, motion: armctl.JointTrajectory, faster: int = 1, **changes) -> None:
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        times = np.linspace(0.0, motion.duration, 2 + int(motion.duration / 0.02))
        message = JointTrajectory(joint_names=list(motion.joint_names))
        for t, q, v, a in zip(times, *motion.sample(times)[:3], strict=True):
            seconds, nanoseconds = divmod(round(1e9 * t / faster), 10**9)
            point = JointTrajectoryPoint(time_from_start=Duration(sec=seconds, nanosec=nanoseconds))
            point.positions = q.tolist()
            point.velocities = (faster * v).tolist()
            point.accelerations = (faster**2 * a).tolist()
            message.points.append(point)
        for name, value in changes.items():
            setattr(message, name, value)
        self.trajectories.publish(message)

    def wait_for(self, condition, seconds: float = 90.0) -> None:
        assert self.node.wait_for(condition, seconds)

    def rests_at(self, q: np.ndarray) -> bool:
        return bool(np.abs(self.q - q).max() < 1e-3 and np.abs(self.states[-1].velocity).max() < 1e-3)


@contextmanager
def served(arm: armctl.Arm, namespace: str, *, real_time: bool = True):
    """A simulated arm that is served in another thread, and a client of it.

    Without `real_time`, its time passes as fast as it is computed, so that a busy computer is no reason to brake.
    """
    use_loopback()
    is_over = threading.Event()
    link = armctl.links.PlantLink(arm, real_time=real_time)

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


def bad_ones(arm: armctl.Arm, q: np.ndarray, goal: np.ndarray) -> list[tuple[armctl.JointTrajectory, dict]]:
    """What must be refused where the arm rests at q: a motion, and what its message has instead."""
    motion = armctl.move_j(arm, q, goal)
    wide = arm.with_limits(replace(arm.limits, q_min=arm.limits.q_min - 1.0, q_max=arm.limits.q_max + 1.0))
    beyond = np.array(q)
    beyond[0] = arm.limits.q_max[0] + 0.2
    return [
        (armctl.move_j(arm, goal, q), {}),  # from another place
        (motion, {"joint_names": [f"other {name}" for name in arm.joint_names]}),
        (motion, {"points": []}),
        (motion, {"faster": 20}),
        (armctl.move_j(wide, q, beyond), {}),
    ]


def free_goal(arm: armctl.Arm, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n,) rad, to which the straight motion from q touches nothing, and which is away from q."""
    while True:
        goal = arm.home + 0.3 * (arm.limits.random(arm.home, 1, rng)[0] - arm.home)
        if np.abs(goal - q).max() > 0.1 and armctl.check_clearance(arm, armctl.move_j(arm, q, goal)):
            return goal


@pytest.mark.parametrize(
    ("name", "count"), [("robot_arm_3dof", 5), pytest.param("panda", 100, marks=pytest.mark.nightly)], ids=["few", "many"]
)
def test_a_served_arm_takes_random_trajectories_and_refuses_the_bad_ones(name: str, count: int, capfd):
    arm = arm_of(name)
    rng = np.random.default_rng(5)
    said = [""]

    def warned() -> bool:
        said[0] += capfd.readouterr().err
        return "WARN" in said[0]

    with served(arm, f"random_{name}", real_time=False) as client:
        q = arm.home
        for k in range(count):
            goal = free_goal(arm, q, rng)
            kinds = bad_ones(arm, q, goal)
            motion, changes = kinds[k % len(kinds)]
            client.send(motion, **changes)
            client.wait_for(warned)
            assert np.abs(client.q - q).max() < NEAR, said
            said[0] = ""
            client.send(armctl.move_j(arm, q, goal))
            client.wait_for(lambda goal=goal: bool(np.abs(client.q - goal).max() < NEAR), 60.0)
            assert not warned(), said
            q = goal


def test_a_stop_ends_a_served_arm_at_rest_on_its_path(arm: armctl.Arm):
    from std_srvs.srv import Trigger

    goal = arm.home + np.array([1.0, 0.3, -0.3])
    with served(arm, "braked", real_time=False) as client:
        client.send(armctl.move_j(arm, arm.home, goal, speed=5e-3))
        client.wait_for(lambda: bool(np.abs(client.q - arm.home).max() > 0.05))
        future = client.stop.call_async(Trigger.Request())
        client.wait_for(future.done)
        client.wait_for(lambda: bool(np.abs(client.states[-1].velocity).max() < 1e-4))
        stopped = client.q - arm.home
    along = stopped @ (goal - arm.home) / np.sum(np.square(goal - arm.home))
    assert 0.04 < along < 0.95
    assert np.abs(stopped - along * (goal - arm.home)).max() < 1e-3


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
