"""LeRobotArm: a simulation or a robot behind the interface of LeRobot's `Robot`, without the package lerobot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from armctl.core.errors import InputError, LinkError
from armctl.core.validation import instance, number, shown, vector
from armctl.sim.commands import Commands
from armctl.sim.follow import StreamRun


class LeRobotArm:
    """An `armctl.Simulation` or `armctl.Robot` as LeRobot's loops use a robot, without gripper and cameras.

    Observations and actions have a number for each joint, such as `{"joint1.pos": 0.1}`, in rad (m for a slide joint). Each
    `send_action` is a target of a stream, and lets one frame pass, in a simulation at once.

    Attributes:
        robot: The simulation or robot, whose `log` is made by `disconnect`.
        robot_type: The name of the arm's model.
    """

    name = "armctl"
    id = "arm"
    cameras: ClassVar[dict[str, Any]] = {}
    calibration: ClassVar[dict[str, Any]] = {}
    is_calibrated = True  # the model has the zero positions

    def __init__(self, robot: Commands, *, frames_per_second: float = 30.0, latency: float = 0.0):
        """An arm that is not connected.

        Args:
            robot: A Simulation or a Robot. It stays open after `disconnect`.
            frames_per_second: 1/s, of the actions.
            latency: s, by how much an action is older than its call; the stream predicts across it.

        Raises:
            InputError: An argument of another type, or a number out of its bounds.
        """
        instance("robot", robot, Commands, 'armctl.Simulation("panda") is one')
        self.robot = robot
        self.robot_type = robot.arm.name
        self._frame = 1.0 / number("frames_per_second", frames_per_second, 0.1, 1.0 / robot.dt)
        self._latency = number("latency", latency, 0.0, 1.0)
        self._keys = [f"{name}.pos" for name in robot.arm.joint_names]
        self._run: StreamRun | None = None

    @property
    def action_features(self) -> dict[str, type]:
        """The type of each number of an action, and of an observation."""
        return dict.fromkeys(self._keys, float)

    observation_features = action_features

    @property
    def is_connected(self) -> bool:
        """Whether actions are taken."""
        return self._run is not None

    def connect(self, calibrate: bool = True) -> None:
        """Begins a stream where the arm is. There is nothing to calibrate.

        Raises:
            LinkError: It is connected already.
        """
        if self._run is not None:
            raise LinkError("connected already; call disconnect() first")
        self._run = self.robot.streaming().__enter__()

    def configure(self) -> None:
        """Does nothing."""

    calibrate = configure

    def get_observation(self) -> dict[str, Any]:
        """The measured positions.

        Returns:
            A number for each of `observation_features`.

        Raises:
            LinkError: It is not connected.
        """
        self._connected()
        return dict(zip(self._keys, self.robot.state.q.tolist(), strict=True))

    def send_action(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Moves towards the positions for one frame.

        Args:
            action: A number for each of `action_features`.

        Returns:
            The action, inside the position limits.

        Raises:
            InputError: A number is missing or not finite, or there are others.
            LinkError: It is not connected, or the robot stopped, with the reason.
        """
        run = self._connected()
        if not isinstance(action, Mapping) or set(action) != set(self._keys):
            raise InputError(f"action: expected a dictionary with {', '.join(self._keys):.200}, got {shown(action)}")
        q = vector("action", [action[key] for key in self._keys], self.robot.arm.n)
        run.stream.push(run.stream.t - self._latency, q)
        failure = run.advance(self._frame)
        if failure:
            raise LinkError(failure)
        return dict(zip(self._keys, self.robot.arm.limits.clamp(q).tolist(), strict=True))

    def disconnect(self) -> None:
        """Ends the stream: the arm comes to rest, and the robot's `log` is made. Without a connection, nothing."""
        run = self._run
        self._run = None
        if run is not None:
            run.__exit__(None, None, None)

    def _connected(self) -> StreamRun:
        if self._run is None:
            raise LinkError("not connected; call connect() first")
        return self._run
