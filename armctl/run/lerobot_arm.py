"""LeRobotArm: a simulation or a robot behind the interface of LeRobot's `Robot`, without the package lerobot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from armctl.core.errors import InputError, LinkError, ModelError
from armctl.core.validation import Array, choice, flag, instance, number, shown, vector, words
from armctl.model.arm.arm import Arm
from armctl.run.execution.commands import Commands
from armctl.run.execution.follow import StreamRun
from armctl.run.links.so101 import JOINTS as SO101_JOINTS
from armctl.run.sim.gripper.gripper import Gripper
from armctl.run.sim.simulation import Simulation

UNITS = ("rad", "degrees", "range_m100_100")
ZEROS = ("model", "middle")
_REMEDIES = {
    "rad": 'LeRobotArm(..., units="degrees") reads them, and units="range_m100_100" reads -100 to 100',
    "degrees": 'the action was read with units="degrees"',
    "range_m100_100": 'the action was read with units="range_m100_100"; units="degrees" reads degrees',
}
_SO100_JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")  # in the makers' models, from the base
_GRIPPER = "gripper.pos"
_OPEN = 100.0  # LeRobot's number of an open gripper; 0 is closed
_GRIPPER_OVERSHOOT = 20.0  # by which a policy may be outside of them
_RANGE = 100.0  # LeRobot's numbers of the ends of a joint's range: +-100


class LeRobotArm:
    """An `armctl.Simulation` or `armctl.Robot` as LeRobot's loops use a robot, without cameras.

    Observations and actions have a number for each joint, such as `{"shoulder_pan.pos": 0.1}`, and for the gripper of a
    simulation. LeRobot's own arms speak degrees or -100..100: say so with `units`. Each `send_action` is a target of a stream,
    and lets one frame pass, in a simulation at once.

    Attributes:
        robot: The simulation or robot, whose `log` is made by `disconnect`.
        robot_type: The name of the arm's model.
        units: The unit of the joints' numbers.
    """

    name = "armctl"
    id = "arm"
    cameras: ClassVar[dict[str, Any]] = {}
    calibration: ClassVar[dict[str, Any]] = {}
    is_calibrated = True  # the model has the zero positions

    def __init__(
        self,
        robot: Commands,
        *,
        frames_per_second: float = 30.0,
        latency: float = 0.0,
        units: str = "rad",
        zeros: str = "model",
        names: Sequence[str] | None = None,
        gripper: bool = True,
    ):
        """An arm that is not connected.

        Args:
            robot: A Simulation or a Robot. It stays open after `disconnect`.
            frames_per_second: 1/s, of the actions.
            latency: s, by how much an action is older than its call; the stream predicts across it.
            units: "rad" (m for a slide joint), "degrees" (mm), or "range_m100_100", LeRobot's -100 to 100 over the range of
                each joint.
            zeros: Where angles are zero: "model", or "middle", the middle of each joint's range, from which LeRobot counts the
                degrees of an arm that it has calibrated.
            names: The n names of the joints in observations and actions, from the base. By default those of the model, and
                LeRobot's `shoulder_pan` to `wrist_roll` for an SO-100 or SO-101; actions may use the model's too.
            gripper: Whether `gripper.pos`, 0 (closed) to 100 (open), moves the gripper of a simulation. False ignores it; a
                robot's gripper cannot move with a stream.

        Raises:
            InputError: An argument of another type, or a number out of its bounds, or a joint without a range for which
                -100 to 100 or a middle is asked.
        """
        instance("robot", robot, Commands, 'armctl.Simulation("panda") is one')
        arm = robot.arm
        self.robot = robot
        self.robot_type = arm.name
        self.units = choice("units", units, UNITS)
        self._frame = 1.0 / number("frames_per_second", frames_per_second, 0.1, 1.0 / robot.dt)
        self._latency = number("latency", latency, 0.0, 1.0)
        self._zero, self._scale = _scales(arm, self.units, choice("zeros", zeros, ZEROS))
        chosen = _names(arm) if names is None else words("names", names)
        if len(chosen) != arm.n or len(set(chosen)) < arm.n:
            raise InputError(f"names: expected {arm.n} different names of joints, got {shown(names)}")
        self._keys = [f"{name}.pos" for name in chosen]
        self._model_keys = [f"{name}.pos" for name in arm.joint_names]
        self._moves_gripper = flag("gripper", gripper)
        self._gripper = _gripper_of(robot) if self._moves_gripper else None
        self._run: StreamRun | None = None

    @property
    def action_features(self) -> dict[str, type]:
        """The type of each number of an action, and of an observation."""
        return dict.fromkeys([*self._keys, *([] if self._gripper is None else [_GRIPPER])], float)

    observation_features = action_features

    @property
    def is_connected(self) -> bool:
        """Whether actions are taken."""
        return self._run is not None

    def connect(self, calibrate: bool = True) -> None:
        """Begins a stream where the arm is.

        Args:
            calibrate: As LeRobot's robots have it; there is nothing to calibrate.

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
        found = dict(zip(self._keys, self._numbers(self.robot.state.q), strict=True))
        if self._gripper is not None:
            found[_GRIPPER] = _OPEN * self._gripper.width / self._gripper.width_max
        return found

    def send_action(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Moves towards the positions for one frame.

        Args:
            action: A number for each joint, and `gripper.pos` or not.

        Returns:
            The action, inside the position limits.

        Raises:
            InputError: A number is missing or not finite, or there are others.
            LimitError: A joint's number is so far outside its range that it has another unit. The arm does not move.
            LinkError: It is not connected, or the robot stopped, with the reason.
        """
        run = self._connected()
        keys, q = self._read(action)
        opening = self._read_opening(action)
        run.stream.push(run.stream.t - self._latency, q)
        if opening is not None and self._gripper is not None:
            self._gripper.command(opening / _OPEN * self._gripper.width_max)
        failure = run.advance(self._frame)
        if failure:
            raise LinkError(failure)
        sent = dict(zip(keys, self._numbers(self.robot.arm.limits.clamp(q)), strict=True))
        return sent if opening is None else {**sent, _GRIPPER: opening}

    def disconnect(self) -> None:
        """Ends the stream: the arm comes to rest, and the robot's `log` is made. Without a connection, nothing."""
        run = self._run
        self._run = None
        if run is not None:
            run.__exit__(None, None, None)

    def _read(self, action: Mapping[str, Any]) -> tuple[list[str], Array]:
        """The keys of the joints in an action, and their positions (n,) rad."""
        if not isinstance(action, Mapping):
            raise InputError(f"action: expected a dictionary with {', '.join(self._keys):.200}, got {shown(action)}")
        given = set(action) - {_GRIPPER}
        keys = self._model_keys if given == set(self._model_keys) else self._keys
        if given != set(keys):
            raise InputError(f"action: expected a dictionary with {', '.join(self._keys):.200}, got {shown(action)}")
        arm = self.robot.arm
        q = self._zero + self._scale * vector("action", [action[key] for key in keys], arm.n)
        arm.check_units("action", q, _REMEDIES[self.units])
        return keys, q

    def _read_opening(self, action: Mapping[str, Any]) -> float | None:
        """The gripper's number, 0 to 100; None if there is none, or it is ignored."""
        if _GRIPPER not in action or not self._moves_gripper:
            return None
        if self._gripper is None:
            raise InputError(
                f"action: {_GRIPPER}: {self.robot.arm.name:.60} has no gripper that moves with a stream; "
                "LeRobotArm(..., gripper=False) ignores it"
            )
        opening = number(f"action: {_GRIPPER}", action[_GRIPPER], -_GRIPPER_OVERSHOOT, _OPEN + _GRIPPER_OVERSHOOT)
        return min(max(opening, 0.0), _OPEN)

    def _numbers(self, q: Array) -> list[float]:
        return ((q - self._zero) / self._scale).tolist()

    def _connected(self) -> StreamRun:
        if self._run is None:
            raise LinkError("not connected; call connect() first")
        return self._run


def _names(arm: Arm) -> tuple[str, ...]:
    """The joints' names in actions: LeRobot's for the models of its own arms."""
    return SO101_JOINTS if arm.joint_names == _SO100_JOINTS else arm.joint_names


def _scales(arm: Arm, units: str, zeros: str) -> tuple[Array, Array]:
    """The positions (n,) rad of the number 0, and the rad by which a number of 1 differs from them."""
    low = arm.limits.q_min
    high = arm.limits.q_max
    needs_range = units == "range_m100_100" or zeros == "middle"
    endless = ~(np.isfinite(low) & np.isfinite(high))
    if needs_range and endless.any():
        joint = arm.joint_names[int(endless.argmax())]
        raise InputError(f"units: {joint} has no range of which there is a middle; use units='rad' or 'degrees', zeros='model'")
    zero = 0.5 * (low + high) if needs_range else np.zeros(arm.n)
    if units == "range_m100_100":
        return zero, 0.5 * (high - low) / _RANGE
    is_slide = np.array(arm.units) == "m"
    return zero, np.where(is_slide, 1e-3, np.radians(1.0)) if units == "degrees" else np.ones(arm.n)


def _gripper_of(robot: Commands) -> Gripper | None:
    """The gripper of a simulation; None if there is none that a number can open."""
    if not isinstance(robot, Simulation):
        return None
    try:
        return robot.gripper
    except ModelError:
        return None
