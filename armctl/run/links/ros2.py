"""ROS2: any arm with a trajectory controller of ROS 2 (ros2_control), which gets whole motions on its topic."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armctl.core.errors import InputError, LinkError, few_names
from armctl.core.validation import Array, flag, instance, number, vector, words
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.trajectory.piecewise import JointSamples
from armctl.run.links.envelope import Envelope
from armctl.run.links.link import MotionLink, Reading, WithoutHand
from armctl.run.links.ros2_connection import FollowingCheck, Ros2Connection, RosNames
from armctl.run.links.ros2_node import check_name

_FIRST_LEAD_S = 0.3  # of a motion from rest, which has no hurry: a controller that gets it late would begin with a jump
_TRANSPORT_SHARE = 0.2  # of the lead, which a message must have left: planning a stop takes the rest
_MOVED_RAD = 0.02  # from where the last motion ended, at which it was moved by something else
_AT_REST_S = 0.1  # between two readings that tell whether the arm rests


@dataclass
class _MotionStream:
    """A stream of motions to the controller."""

    began: float  # s of the robot's time, tick 0
    following: FollowingCheck
    tick: int = -1


class ROS2(WithoutHand, MotionLink):
    """Any arm that ROS 2 moves by a joint_trajectory_controller of ros2_control.

    It was tried with nodes that play such a controller, never with a robot or an installation of ROS. Each motion is one
    message on the controller's topic, with positions, velocities and accelerations; a stop sends the braking path, which agrees
    with the motion until it brakes. The controller plays a motion to its end by itself, at rest, when this computer is gone.

    Attributes:
        controller: The name of the controller.
        namespace: That of the controller and of the topic joint_states.
        dt: s, between two points of a message, and two rows of a log.
        lead: s, within which a message reaches the controller.
        name, address, envelope, rest_speed, settle, payload, passes_time: As of every link.
    """

    no_hand = "gripper: the link to ROS 2 commands no gripper; send its action from a node of ROS"
    rest_speed = 2e-2
    settle = (2e-3, 1e-2)
    payload: float | None = None
    passes_time = False

    def __init__(
        self,
        arm: Arm,
        controller: str = "joint_trajectory_controller",
        namespace: str = "",
        *,
        joints: Sequence[str] | None = None,
        dt: float = 0.01,
        lead: float = 0.05,
        use_sim_time: bool = False,
        measures_torque: bool = False,
        envelope: Envelope | None = None,
    ):
        """A robot that is not connected yet.

        Args:
            arm: Its model.
            controller: The controller's name, as `ros2 control list_controllers` prints it.
            namespace: Of the robot; empty if it has none.
            joints: The names of the joints in ROS, in the order of the model's joints; by default those of the model.
            dt: s, between two points of a message, in [0.001, 0.1].
            lead: s, within which a message reaches the controller, in [0.01, 1]: a stop begins so much later,
                and a motion from rest 0.3 s later if that is more.
            use_sim_time: Whether the robot's time is that of the topic /clock, as in Gazebo.
            measures_torque: Whether the efforts in joint_states are torques that sensors measure.
            envelope: What its maker publishes; by default the limits of the program's arm count.

        Raises:
            InputError: An argument of another type, a number out of its bounds, or a name that is none in ROS.
        """
        check_arm(arm)
        self.controller = check_name("controller", controller)
        self.namespace = check_name("namespace", namespace, empty=True)
        joint_names = arm.joint_names if joints is None else words("joints", joints)
        if len(joint_names) != arm.n or len(set(joint_names)) != arm.n:
            raise InputError(f"joints: expected {arm.n} different names, got {len(joint_names)}: {few_names(joint_names)}")
        self.dt = number("dt", dt, 1e-3, 0.1)
        self.lead = number("lead", lead, 0.01, 1.0)
        if envelope is not None:
            instance("envelope", envelope, Envelope, "armctl.Envelope(source, limits) is one")
        self.envelope: Envelope | None = envelope
        self._measures_torque = flag("measures_torque", measures_torque)
        self._v_max = arm.limits.v_max
        prefix = f"/{self.namespace}" if self.namespace else ""
        node = f"{prefix}/{self.controller}"
        self._names = RosNames(
            joints=tuple(joint_names),
            states=f"{prefix}/joint_states",
            controller=node,
            motions=f"{node}/joint_trajectory",
            use_sim_time=flag("use_sim_time", use_sim_time),
        )
        self.name = f"ROS 2 robot {node}"
        self.address = f"ROS 2 domain {os.environ.get('ROS_DOMAIN_ID', '0')} {node}"
        self._commanded = np.full(arm.n, np.nan)  # (n,) rad, the last row of the last motion that was played
        self._connection: Ros2Connection | None = None
        self._stream: _MotionStream | None = None

    def open(self) -> None:
        """Makes a node, waits for the joints' states, and compares clock and controller with what motions need."""
        self._connection = Ros2Connection(self._names, self._v_max)
        self._connection.check()
        self._commanded = np.array(self._connection.states.q)
        self._stream = None

    def read(self) -> Reading:
        connection = self._opened()
        connection.refresh()
        if self._stream is None and np.abs(connection.states.q - self._commanded).max() > _MOVED_RAD:
            self._commanded = np.array(connection.states.q)
        return self._reading()

    def tip(self) -> Array | None:
        return None

    def start(self) -> None:
        connection = self._opened()
        connection.look()
        self._stream = _MotionStream(
            began=connection.now + self.lead, following=FollowingCheck(self._names, connection.states.q)
        )

    def send_motion(self, first: int, changed: int, rows: JointSamples) -> bool:
        instance("rows", rows, JointSamples, "a Robot sends them")
        connection = self._opened()
        stream = self._streaming()
        message = connection.message(rows, self.dt)
        if changed == 0 and stream.tick < 0:  # it begins once the message is ready
            stream.began = connection.now + max(self.lead, _FIRST_LEAD_S)
        elif stream.began + self.dt * changed < connection.now + _TRANSPORT_SHARE * self.lead:
            return False
        connection.send(message, stream.began + self.dt * first)
        return True

    def wait(self) -> tuple[int, Reading]:
        stream = self._streaming()
        connection = self._opened()
        late = connection.wait_until(stream.began + self.dt * (stream.tick + 1), self.dt)
        if stream.tick >= 0:
            stream.following.update(stream.began + self.dt * stream.tick, connection.states.q, self._commanded)
        ticks = 1 + int(late / self.dt)
        stream.tick += ticks
        return ticks, self._reading()

    def send(self, q: Array, last: bool) -> None:
        self._commanded = vector("q", q, len(self._names.joints))
        if flag("last", last):
            self._stream = None

    def recover(self) -> None:
        """Takes the arm where it stands. The controller has no fault that a program could clear.

        Raises:
            LinkError: The arm moves, or sends no states.
        """
        self._stream = None
        connection = self._opened()
        connection.states.problem = ""
        first = self.read()
        time.sleep(_AT_REST_S)
        second = self.read()
        moved = np.abs(second.q - first.q)
        joint = int(moved.argmax())
        if moved[joint] > self.rest_speed * _AT_REST_S:
            raise LinkError(f"recover: {self._names.joints[joint]} moves; wait until the arm is at rest")
        self._commanded = np.array(second.q)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _opened(self) -> Ros2Connection:
        if self._connection is None:
            raise LinkError(f"{self.name}: the link is not open; give it to an armctl.Robot")
        return self._connection

    def _streaming(self) -> _MotionStream:
        if self._stream is None:
            raise LinkError(f"{self.name}: no stream is open; call start() first")
        return self._stream

    def _reading(self) -> Reading:
        states = self._opened().states
        return Reading(
            t=float(states.t.min()),
            q=np.array(states.q),
            v=np.array(states.v),
            tau=np.array(states.tau) if self._measures_torque else np.full(len(states.q), np.nan),
            q_ref=self._commanded,
            fault=states.jump,
        )
