"""A robot of ROS 2 for tests: joint states, and a trajectory controller after the documentation of ros2_control's.

It takes trajectories on its topic, replaces the present one by a new one, interpolates with polynomials of degree five, and
refuses what joint_trajectory_controller refuses. It runs in a thread of the test, with real nodes of wheels or an installation.
"""

import importlib.util
import os
import threading
import time
from collections.abc import Sequence
from contextlib import contextmanager

import numpy as np
import pytest

HAS_ROS2 = all(importlib.util.find_spec(module) for module in ("rclpy", "sensor_msgs", "trajectory_msgs"))
needs_ros2 = pytest.mark.skipif(
    not HAS_ROS2, reason="ROS 2 is not installed; the extra ros2 has its wheels for Linux on x86-64"
)
CONTROLLER = "joint_trajectory_controller"
_UPDATE_S = 0.005


def use_loopback() -> None:
    """Keeps nodes of this process and its children on this computer, in a domain of their own."""
    os.environ["ROS_LOCALHOST_ONLY"] = "1"
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)


def quintic(h: float, t: float, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity after t of h s between two states, (3, n): positions, velocities, accelerations."""
    powers = np.array([[h**k, k * h ** max(k - 1, 0), k * (k - 1) * h ** max(k - 2, 0)] for k in range(3, 6)]).T
    low = np.stack([first[0], first[1], first[2] / 2])
    taken = np.stack([low[0] + h * low[1] + h * h * low[2], low[1] + 2 * h * low[2], 2 * low[2]])
    c = np.concatenate([low, np.linalg.solve(powers, last - taken)])
    k = np.arange(6)
    return (t**k) @ c, (k[1:] * t ** (k[1:] - 1)) @ c[1:]


class TrajectoryController:
    """A simulated robot. All that is public may be changed while it runs."""

    def __init__(self, joints: Sequence[str], q: np.ndarray, namespace: str = "", *, sim_time: float = 0.0, **parameters):
        """A robot that stands at q; `sim_time` is the speed of the clock that it publishes on /clock, 0 for none."""
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        self.joints = list(joints)
        self.q = np.array(q, dtype=float)
        self.v = np.zeros_like(self.q)
        self.active = True
        self.publishes = True
        self.stamp_offset = 0.0  # s, of the states
        self.zero_stamps = False
        self.disorder = False  # other orders, further joints, one message twice, late ones
        self.accepted: list = []  # messages
        self.refused: list[str] = []
        self.jumps: list[float] = []  # rad, of the reference at a new message
        self.delays: list[float] = []  # s, after the first point of a message that it came
        self.rows: list[np.ndarray] = []  # reference at each update
        self.speeds: list[np.ndarray] = []
        self.sim_time = sim_time
        self._began = time.monotonic()
        self._context = Context()
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node(CONTROLLER, namespace=namespace, context=self._context)
        for name, value in {"joints": self.joints, "allow_partial_joints_goal": False, **parameters}.items():
            self.node.declare_parameter(name, value)
        self.node.create_subscription(JointTrajectory, "~/joint_trajectory", self._take, 1)
        self._publisher = self.node.create_publisher(
            JointState, f"/{namespace}/joint_states" if namespace else "/joint_states", 1
        )
        self._clock = self.node.create_publisher(Clock, "/clock", 1) if sim_time else None
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._present: tuple[float, np.ndarray, np.ndarray] | None = None  # start, times (T,), states (T, 3, n)
        self._updates = 0
        self._closing = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def now(self) -> float:
        if self.sim_time:
            return 1.0 + self.sim_time * (time.monotonic() - self._began)
        return time.time()

    def close(self) -> None:
        import rclpy

        self._closing = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for_rest(self, seconds: float = 20.0) -> None:
        """Waits until the reference has not changed for a quarter of a second, and something was played."""
        deadline = time.monotonic() + seconds
        while not self.accepted or len(self.rows) < 60 or np.ptp(np.array(self.rows[-50:]), axis=0).max() > 0.0:
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._closing:
            due = max(due + _UPDATE_S, time.monotonic() - _UPDATE_S)
            while (left := due - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
            self._executor.spin_once(timeout_sec=0.0)
            self._update()

    def _take(self, message) -> None:
        """Why joint_trajectory_controller would refuse a message, or takes it."""
        if not self.active:
            return
        now = self.now
        begin = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points])
        if sorted(message.joint_names) != sorted(self.joints):
            self.refused.append("joints")
        elif not len(times) or (np.diff(times) <= 0.0).any():
            self.refused.append("times")
        elif begin and begin + times[-1] < now:
            self.refused.append("ends in the past")
        elif any(message.points[-1].velocities):
            self.refused.append("moves at its end")
        else:
            order = [message.joint_names.index(name) for name in self.joints]
            states = np.array([[p.positions, p.velocities, p.accelerations] for p in message.points])[:, :, order]
            before = self._reference(now)
            if now < (begin or now) + times[0]:  # from where it is to the first point
                start = np.stack([*before, np.zeros_like(self.q)])[None]
                times = np.append(0.0, times + (begin or now) - now)
                states = np.concatenate([start, states])
                begin = now
            self._present = (begin or now, times, states)
            self.jumps.append(float(np.abs(self._reference(now)[0] - before[0]).max()))
            self.delays.append(now - (begin or now) - float(times[0]))
            self.accepted.append(message)

    def _reference(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        if self._present is None:
            return self.q, np.zeros_like(self.q)
        begin, times, states = self._present
        t = now - begin
        if t >= times[-1]:
            return states[-1, 0], np.zeros_like(self.q)
        k = max(int(np.searchsorted(times, t, side="right")) - 1, 0)
        return quintic(times[k + 1] - times[k], t - times[k], states[k], states[k + 1])

    def _update(self) -> None:
        now = self.now
        self.q, self.v = self._reference(now)
        self.rows.append(self.q)
        self.speeds.append(self.v)
        self._updates += 1
        if self._clock is not None:
            from rosgraph_msgs.msg import Clock

            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = divmod(round(1e9 * now), 10**9)
            self._clock.publish(clock)
        if self.publishes and self._updates % 2:
            self._publish(now)

    def _publish(self, now: float) -> None:
        from sensor_msgs.msg import JointState

        message = JointState()
        if not self.zero_stamps:
            nanoseconds = round(1e9 * (now + self.stamp_offset))
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        message.name = list(self.joints)
        message.position = self.q.tolist()
        message.velocity = self.v.tolist()
        if self.disorder:
            order = np.random.default_rng(self._updates).permutation(len(self.joints) + 1)
            names = [*self.joints, "finger"]
            message.name = [names[k] for k in order]
            message.position = np.append(self.q, 0.04)[order].tolist()
            message.velocity = []
        self._publisher.publish(message)
        if self.disorder:
            self._publisher.publish(message)
            message.header.stamp.sec -= 1  # and one that was on its way for long
            message.position = [0.0] * len(message.name)
            message.header.stamp.nanosec = min(message.header.stamp.nanosec + 200_000_000, 999_999_999)
            self._publisher.publish(message)


@contextmanager
def controller_of(arm, namespace: str, q=None, joints=None, **how):
    """A running robot with the joints of an arm."""
    use_loopback()
    robot = TrajectoryController(joints or arm.joint_names, arm.home if q is None else q, namespace, **how)
    try:
        yield robot
    finally:
        robot.close()
