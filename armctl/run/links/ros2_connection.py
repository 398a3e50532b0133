"""Ros2Connection: a node that reads the states of joints and sends motions to a trajectory controller; and what it requires."""

from __future__ import annotations

import itertools
import os
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.core.errors import LinkError, few_names
from armctl.core.validation import Array
from armctl.plan.motion.trajectory.piecewise import JointSamples
from armctl.run.links.joint_states import JointStates
from armctl.run.links.ros2_node import QUEUE, RosNode, import_ros, stamp

_DISCOVERY_S = 10.0  # until a driver that was just started has its nodes, and they are known
_numbers = itertools.count(1)  # of the nodes of this process: another commander in it has another name
_MATCH_S = 0.5  # from when this node knows the controller until it knows this node, too
_SILENCE_S = 0.5  # without a state, after which the link counts as lost
_CLOCK_GAP_S = 0.1  # between the stamps of the states and this computer's clock
_CLOCK_STATES = 5  # of which the one with the smallest gap counts: a busy computer reads some late
_LOOK_S = 0.2  # between two looks at who listens to the controller, and who else commands it


@dataclass(frozen=True)
class RosNames:
    """What a robot is called in ROS, with full names of topics and nodes."""

    joints: tuple[str, ...]
    states: str  # the topic of their states
    controller: str  # the node
    motions: str  # its topic
    use_sim_time: bool


class Ros2Connection:
    """An open connection. It raises LinkError where something does not fit, or is gone."""

    def __init__(self, names: RosNames, v_max: Array):
        """Makes a node, which knows nothing yet; `v_max` are the greatest speeds of the joints, (n,) rad/s."""
        self.names = names
        self.node = RosNode(f"armctl_{os.getpid()}_{next(_numbers)}", use_sim_time=names.use_sim_time)
        self.states = JointStates(names.joints, v_max)
        qos = import_ros("rclpy.qos")
        states = import_ros("sensor_msgs.msg").JointState
        # Best effort takes states from reliable and from best-effort publishers.
        profile = qos.QoSProfile(depth=QUEUE, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self.node.node.create_subscription(states, names.states, self._take, profile)
        motions = import_ros("trajectory_msgs.msg").JointTrajectory
        self._publisher = self.node.node.create_publisher(motions, names.motions, 1)
        self._heard = time.monotonic()  # when the last state came
        self._looked = 0.0

    @property
    def now(self) -> float:
        """s, the time of the robot, which is that of the node's clock."""
        return self.node.now

    def close(self) -> None:
        self.node.close()

    def check(self) -> None:
        """Waits for the joints' states, and compares clock and controller with what motions need."""
        self._require_states()
        self._require_clock()
        self._require_controller()
        self._require_joints()

    def refresh(self) -> None:
        """Takes what came since the last call, and waits for a state if none did."""
        states = self.states
        count = states.count
        while True:
            before = states.count
            self.node.spin(0.0)
            if states.count == before:
                break
        if not self.node.wait_for(lambda: states.count > count, _SILENCE_S):
            raise LinkError(self._silence())

    def wait_until(self, t: float, step: float) -> float:
        """Takes states until the robot's time is t s, in steps of some seconds; by how much it is later then, s."""
        restarts = self.states.restarts
        while (left := t - self.now) > 0.0:
            self.node.spin(min(left, step))
            if self.states.restarts != restarts:
                raise LinkError("the robot's clock was set back: was the simulation reset?")
            if time.monotonic() - self._heard > _SILENCE_S:
                raise LinkError(self._silence())
        self.node.spin(0.0)
        if time.monotonic() - self._looked > _LOOK_S:
            self.look()
        return -left

    def message(self, rows: JointSamples, dt: float) -> Any:
        """A message with rows every dt s, without a stamp."""
        types = import_ros("trajectory_msgs.msg")
        duration = import_ros("builtin_interfaces.msg").Duration
        points = []
        for k, (q, v, a) in enumerate(zip(*rows, strict=True)):
            sec, nanosec = stamp(dt * k)
            point = types.JointTrajectoryPoint(time_from_start=duration(sec=sec, nanosec=nanosec))
            point.positions = array("d", q.tobytes())
            point.velocities = array("d", v.tobytes())
            point.accelerations = array("d", a.tobytes())
            points.append(point)
        return types.JointTrajectory(joint_names=self.names.joints, points=points)

    def send(self, message: Any, begin: float) -> None:
        """Sends a message whose times count from `begin` s of the robot's time, however long it is on its way."""
        message.header.stamp.sec, message.header.stamp.nanosec = stamp(begin)
        self._publisher.publish(message)

    def look(self) -> None:
        """Refuses to go on without a controller, or with another commander."""
        self._looked = time.monotonic()
        others = self.node.others(self.names.motions)
        if others:
            raise LinkError(f"{few_names(others)} commands {self.names.motions}, too; end it first")
        if not self._publisher.get_subscription_count():
            raise LinkError(f"{self.names.motions}: the controller is gone; it ends the motion that it has, or stops")

    def _take(self, message: Any) -> None:
        t = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self.states.take(t or self.now, message.name, message.position, message.velocity, message.effort)
        self._heard = time.monotonic()

    def _silence(self) -> str:
        return f"{self.names.states}: no state for {_SILENCE_S:g} s; the arm ends the motion that it was sent"

    def _require_states(self) -> None:
        states = self.states
        if not self.node.wait_for(lambda: states.count > 0 and not states.missing, _DISCOVERY_S):
            domain = os.environ.get("ROS_DOMAIN_ID", "0")
            publishers = self.node.others(self.names.states)
            who = f"published by {few_names(publishers)}" if publishers else f"nobody publishes it in ROS_DOMAIN_ID={domain}"
            raise LinkError(f"{self.names.states}: {states.explanation} ({who})")

    def _require_clock(self) -> None:
        """Refuses states whose stamps are not of this computer's time: a motion would begin in the past."""
        gaps = []
        for _ in range(_CLOCK_STATES):
            self.refresh()
            gaps.append(self.now - float(self.states.t.max()))
        gap = min(gaps, key=abs)
        if abs(gap) <= _CLOCK_GAP_S:
            return
        if self.names.use_sim_time:
            why = "with use_sim_time=True the time is that of /clock: is it published, by the same simulation?"
        else:
            why = "synchronize the clocks of both computers, or give use_sim_time=True if the robot is simulated"
        when = f"{abs(gap):.3g} s {'before' if gap > 0.0 else 'after'} this computer's time"
        raise LinkError(f"the states on {self.names.states} are stamped {when}; {why}")

    def _require_controller(self) -> None:
        topic = self.names.motions
        if self.node.wait_for(lambda: self._publisher.get_subscription_count() > 0, _DISCOVERY_S):
            self.node.wait_for(lambda: False, _MATCH_S)
            return
        if self.node.node.count_subscribers(topic):
            raise LinkError(f"{topic}: the node that takes it wants another quality of service than a controller")
        known = [other for other in self.node.topics_of("trajectory_msgs/msg/JointTrajectory") if other != topic]
        others = f"; others are taken on {few_names(known)}" if known else ""
        raise LinkError(f"{topic}: no controller takes motions there; load and activate it{others}")

    def _require_joints(self) -> None:
        """Compares the joints of the controller, if it tells them, with the arm's."""
        controller = self.names.controller
        joints: Sequence[str] | None = self.node.parameter(controller, "joints")
        if not joints:
            return
        unknown = [name for name in self.names.joints if name not in joints]
        if unknown:
            raise LinkError(
                f"{controller} does not command {few_names(unknown)}, but {few_names(joints, 8)}; give joints=[...], its names "
                "in the order of the model's joints, or another controller"
            )
        further = [name for name in joints if name not in self.names.joints]
        if further and not self.node.parameter(controller, "allow_partial_joints_goal"):
            raise LinkError(
                f"{controller} also commands {few_names(further)}, which the model lacks; set its parameter "
                "allow_partial_joints_goal to true, or give a controller of the arm's joints"
            )


_BEHIND_RAD = 0.25  # of where it should be, for so long: a joint that is blocked, or a motion that nobody plays
_BEHIND_S = 0.3
_ASKED_RAD = 0.02  # of a motion, of which so small a share for so long means that nobody plays it
_MOVED_SHARE = 0.1
_UNMOVED_S = 0.5


class FollowingCheck:
    """Whether an arm follows what its controller was sent, from the start of a stream on."""

    def __init__(self, names: RosNames, q: Array):
        """A check that begins at q, (n,) rad."""
        self._names = names
        self._start = np.array(q)
        self._behind_since = np.inf  # s of the robot's time
        self._unmoved_since = np.inf

    def update(self, t: float, q: Array, commanded: Array) -> None:
        """Raises LinkError where the arm at q stays far behind its command at t s, or does not move at all."""
        behind = np.abs(q - commanded)
        joint = int(behind.argmax())
        self._behind_since = min(self._behind_since, t) if behind[joint] > _BEHIND_RAD else np.inf
        asked = np.abs(commanded - self._start).max()
        is_unmoved = asked > _ASKED_RAD and np.abs(q - self._start).max() < _MOVED_SHARE * asked
        self._unmoved_since = min(self._unmoved_since, t) if is_unmoved else np.inf
        is_behind = t - self._behind_since > _BEHIND_S
        if t - self._unmoved_since > _UNMOVED_S or (is_behind and is_unmoved):
            raise LinkError(
                f"the arm does not move: is {self._names.controller} active (ros2 control list_controllers), and what does its "
                "log say about the motion?"
            )
        if is_behind:
            raise LinkError(
                f"{self._names.joints[joint]} is {behind[joint]:.3f} rad from where it should be: it is blocked, or another "
                "node commands the controller"
            )
