"""serve_ros2: a Robot, or a simulated arm behind one, as a node of ROS 2 that acts like the driver of a robot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from armctl.core.errors import ArmctlError, LinkError, NotInstalledError
from armctl.core.pose import Pose
from armctl.core.validation import Array, instance, number
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.move_free import move_free
from armctl.run.links.motion_run import MotionRun
from armctl.run.links.robot import Robot
from armctl.run.links.ros2_node import QUEUE, RosNode, check_name, import_ros, seconds_of, stamp
from armctl.run.links.sole_program import hold_alone

_STEP_S = 0.01  # of a motion, after which the next command is looked at
_IDLE_S = 0.01
_SPIN_S = 0.05
_DISCOVERY_S = 3.0  # in which a node of the same name on another computer is found, as a rule
_LOOK_INTERVAL_S = 1.0  # for one that is found later
_MAX_RATE = 1000.0
FRAME = "world"  # of poses and transforms: that of the model

_Command = Callable[[MotionRun], str]


def serve_ros2(
    robot: Robot,
    *,
    controller: str = "joint_trajectory_controller",
    namespace: str = "",
    rate: float = 100.0,
    until: Callable[[], bool] | None = None,
) -> None:
    """Serves an open robot as a node of ROS 2, until Ctrl-C. The robot stays open; it brakes if it moves.

    The node publishes `joint_states`, `CONTROLLER/tip_pose` and, where tf2_msgs is installed, the tip's transform on /tf.
    It takes a trajectory on `CONTROLLER/joint_trajectory`, a pose of the tip in the frame "world" on
    `CONTROLLER/target_pose`, and the service `CONTROLLER/stop`. A trajectory replaces what is left of the one before. What the
    robot refuses is a warning in the log of the node.

    Args:
        robot: The robot, such as `armctl.Robot(arm, armctl.links.PlantLink(arm, real_time=True))` for a simulated one.
        controller: The name of the node.
        namespace: Of the node and of joint_states.
        rate: Messages per second on each topic, in [1, 1000].
        until: Whether to end, asked all the time; None for never.

    Raises:
        InputError: No robot, a number out of its bounds, or a name that is none in ROS.
        NotInstalledError: rclpy or a package of messages is missing.
        LinkError: Another node has the same name. On this computer that is certain for nodes of armctl; others are looked for
            for three seconds, and one that is found later is a warning in the log.
    """
    instance("robot", robot, Robot, "armctl.Robot(arm, armctl.links.PlantLink(arm, real_time=True)) is one")
    rate = number("rate", rate, 1.0, _MAX_RATE)
    server = _Ros2Server(robot, check_name("controller", controller), check_name("namespace", namespace, empty=True), rate)
    server.serve((lambda: False) if until is None else until)


class _Seen(NamedTuple):
    """What the robot measured: s of the node's clock, and (n,) each."""

    t: float
    q: Array
    v: Array


class _Ros2Server:
    """A robot as a node: a thread of ROS publishes its state, `serve` carries out commands in the caller's."""

    def __init__(self, robot: Robot, controller: str, namespace: str, rate: float):
        self._robot = robot
        self._arm = robot.arm
        self._node = RosNode(controller, namespace)
        node = self._node.node
        self._log = node.get_logger()
        self._states_type = import_ros("sensor_msgs.msg").JointState
        self._pose_type = import_ros("geometry_msgs.msg").PoseStamped
        node.declare_parameter("joints", list(robot.arm.joint_names))
        self._states = node.create_publisher(self._states_type, "joint_states", QUEUE)
        self._tips = node.create_publisher(self._pose_type, "~/tip_pose", QUEUE)
        self._transforms = _Transforms(node)
        trajectory = import_ros("trajectory_msgs.msg").JointTrajectory
        node.create_subscription(trajectory, "~/joint_trajectory", self._take_trajectory, QUEUE)
        node.create_subscription(self._pose_type, "~/target_pose", self._take_pose, QUEUE)
        node.create_service(import_ros("std_srvs.srv").Trigger, "~/stop", self._take_stop)
        self._interval = 1.0 / rate
        self._see(robot.state.q)
        self._commands: SimpleQueue[_Command] = SimpleQueue()
        self._next_look = 0.0  # s of the clock, for other nodes of the same name
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def serve(self, until: Callable[[], bool]) -> None:
        """Carries out what is commanded until a condition holds, or an exception ends it."""
        name = self._node.node.get_fully_qualified_name()
        lock = None
        try:
            lock = hold_alone(f"ros2-{self._node.domain}{name}", self._not_alone)
            if self._node.wait_for(lambda: self._node.count_named(name) > 1, _DISCOVERY_S):
                raise LinkError(self._not_alone)
            self._node.node.create_timer(self._interval, self._publish)  # not before: who sees states finds the only node
            self._thread.start()
            self._log.info(f"{self._robot.link.name} is at {name}: joint_trajectory, target_pose, stop")
            while not until():
                command = self._next()
                if command is None:
                    self._warn_of_others()
                    self._see(self._robot.state.q)
                    time.sleep(_IDLE_S)
                else:
                    self._carry_out(command, until)
        finally:
            self._closing.set()
            if self._thread.is_alive():
                self._thread.join()
            self._node.close()
            if lock is not None:
                lock.close()

    @property
    def _not_alone(self) -> str:
        name = self._node.node.get_fully_qualified_name()
        return f"another node is called {name}; give another controller= or namespace=, or end it"

    def _warn_of_others(self) -> None:
        """A warning, once, where another node of the same name is found late."""
        now = time.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + _LOOK_INTERVAL_S
        if self._node.count_named(self._node.node.get_fully_qualified_name()) > 1:
            self._next_look = np.inf
            self._log.warning(f"{self._not_alone}; both get what is commanded")

    def _carry_out(self, command: _Command, until: Callable[[], bool]) -> None:
        """Begins a motion, and takes further commands until the arm rests."""
        try:
            with self._robot.playing() as run:
                self._report(command(run))
                while run.moves and not until():
                    self._report(run.advance(_STEP_S))
                    self._see(self._robot.data.qpos[self._arm.qpos_adr])
                    following = self._next()
                    if following is not None:
                        self._report(following(run))
                if run.moves:
                    run.stop()
        except ArmctlError as error:
            self._report(str(error))

    def _see(self, q: Array) -> None:
        """Keeps what the robot measures now for the thread that publishes it."""
        v = np.array(self._robot.data.qvel[self._arm.dof_adr])
        self._seen = _Seen(t=self._node.now, q=np.array(q), v=v)

    def _next(self) -> _Command | None:
        try:
            return self._commands.get_nowait()
        except Empty:
            return None

    def _report(self, reason: str) -> None:
        if reason:
            self._log.warning(reason)

    def _play(self, message: Any, run: MotionRun) -> str:
        begin = seconds_of(message.header.stamp)
        motion = JointTrajectory.from_ros(_table(message), self._arm)
        return run.play(motion, self._node.now - begin if begin else 0.0)

    def _move_to(self, message: Any, run: MotionRun) -> str:
        frame = message.header.frame_id
        if frame not in ("", FRAME):
            return f"target_pose: the frame {frame!r:.80} is unknown; poses are in {FRAME!r}, the frame of the model"
        if run.moves:
            run.stop()
        p = message.pose.position
        o = message.pose.orientation
        pose = Pose([p.x, p.y, p.z], quat=[o.w, o.x, o.y, o.z])
        return run.play(move_free(self._arm, run.q, pose), slow=True)

    def _take_trajectory(self, message: Any) -> None:
        self._commands.put(lambda run: _refused(self._play, message, run))

    def _take_pose(self, message: Any) -> None:
        self._commands.put(lambda run: _refused(self._move_to, message, run))

    def _take_stop(self, _: Any, response: Any) -> Any:
        self._commands.put(_stop)
        response.success = True
        response.message = "the arm brakes on its path"
        return response

    def _publish(self) -> None:
        """Publishes what the robot measured last."""
        t, q, v = self._seen
        sec, nanosec = stamp(t)
        states = self._states_type()
        states.name = list(self._arm.joint_names)
        states.position = q.tolist()
        states.velocity = v.tolist()
        tip = self._pose_type()
        for header in (states.header, tip.header):
            header.stamp.sec = sec
            header.stamp.nanosec = nanosec
        tip.header.frame_id = FRAME
        pose = self._arm.fk(q)
        tip.pose.position.x, tip.pose.position.y, tip.pose.position.z = pose.position.tolist()
        o = tip.pose.orientation
        o.w, o.x, o.y, o.z = pose.quat.tolist()
        self._states.publish(states)
        self._tips.publish(tip)
        self._transforms.publish(tip, self._arm.tip)

    def _spin(self) -> None:
        while not self._closing.is_set():
            self._node.spin(_SPIN_S)


class _Transforms:
    """Publishes the transform of a tip on /tf where tf2_msgs is installed."""

    def __init__(self, node: Any):
        try:
            self._message = import_ros("tf2_msgs.msg").TFMessage
        except NotInstalledError:
            self._message = None  # there is no wheel of it
            return
        self._transform = import_ros("geometry_msgs.msg").TransformStamped
        self._publisher = node.create_publisher(self._message, "/tf", QUEUE)

    def publish(self, pose: Any, tip: str) -> None:
        if self._message is None:
            return
        transform = self._transform(header=pose.header, child_frame_id=tip)
        at = pose.pose.position
        transform.transform.translation.x, transform.transform.translation.y, transform.transform.translation.z = (
            at.x,
            at.y,
            at.z,
        )
        transform.transform.rotation = pose.pose.orientation
        self._publisher.publish(self._message(transforms=[transform]))


def _stop(run: MotionRun) -> str:
    if run.moves:
        run.stop()
    return ""


def _refused(command: Callable[[Any, MotionRun], str], message: Any, run: MotionRun) -> str:
    """What a command answers; a wrong one is refused, and the arm goes on."""
    try:
        return command(message, run)
    except ArmctlError as error:
        return str(error)


def _table(message: Any) -> dict[str, Any]:
    """A JointTrajectory as tables and lists."""
    points = [
        {
            "positions": list(point.positions),
            "velocities": list(point.velocities),
            "accelerations": list(point.accelerations),
            "time_from_start": seconds_of(point.time_from_start),
        }
        for point in message.points
    ]
    return {"joint_names": list(message.joint_names), "points": points}
