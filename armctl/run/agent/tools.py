"""The tools of an agent: their names, what they take, and what they do with an arm's commands."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from armctl.core.errors import ArmctlError, InputError, LimitError, LinkError, ModelError, UnknownNameError
from armctl.core.json_values import json_value
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.result import GripResult, MoveResult
from armctl.core.target import TargetLike
from armctl.core.tip_targets import STAY
from armctl.core.validation import Array, integer, number, shown, vector
from armctl.run.agent.answer import ToolAnswer, point_text, pose_values, rounded
from armctl.run.agent.sight import Eye, bodies, points
from armctl.run.execution.commands import Commands
from armctl.run.links.hand import Hand
from armctl.run.links.robot import Robot
from armctl.run.sim.gripper.gripper import Gripper

_MIN_PIXELS = 64
_MAX_PIXELS = 1280
_DEFAULT_SIZE = (640, 480)
_KEPT_WAYS = 32  # motions that can be undone
_MIN_SPEED = 0.01
_FARTHEST_M = 1000.0  # of a position: beyond it, numbers are no places

Given = Mapping[str, Any]


def _numbers(count: int, text: str) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}, "minItems": count, "maxItems": count, "description": text}


def _number(text: str, **bounds: float) -> dict[str, Any]:
    return {"type": "number", "description": text, **bounds}


_POSITION = _numbers(3, "of the tip, m, in the world")
_QUAT = _numbers(4, "orientation of the tip, w x y z; any orientation if left out")
_RPY = _numbers(3, "instead of quat: roll, pitch, yaw, rad")
_SPEED = _number("fraction of the full speed, above 0 and at most 1", minimum=_MIN_SPEED, maximum=1)
_TIP = {"type": "string", "description": "which tip, of an arm with several; the others stay"}
_CAMERA = {"type": "string", "description": "the name of a camera of the model, as look lists them"}
_Q = {
    "description": "rad (m): a list in the order of state's joints, or positions by name of those that move",
    "anyOf": [
        {"type": "array", "items": {"type": "number"}},
        {"type": "object", "additionalProperties": {"type": "number"}},
    ],
}
_TARGET = {"position": _POSITION, "quat": _QUAT, "rpy": _RPY, "speed": _SPEED}


@dataclass(frozen=True)
class AgentTool:
    """A tool.

    Attributes:
        text: What it does, for the language model.
        run: Does it, with the arguments that were given.
        takes: The arguments by name, each as a JSON schema.
        needs: Those that must be given.
        moves: Whether something may move.
    """

    text: str
    run: Callable[[ArmTools, Given], ToolAnswer]
    takes: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))
    needs: tuple[str, ...] = ()
    moves: bool = False

    @property
    def schema(self) -> dict[str, Any]:
        """The JSON schema of its arguments."""
        properties = {name: dict(schema) for name, schema in self.takes.items()}
        return {"type": "object", "properties": properties, "required": list(self.needs), "additionalProperties": False}

    def checked(self, name: str, arguments: object) -> Given:
        """The arguments of a call by their names, without those that are null; their values are checked where they are read."""
        given = {} if arguments is None else arguments
        if not isinstance(given, Mapping):
            raise InputError(f"{name}: expected arguments by name, got {shown(arguments)}")
        for key in given:
            if key not in self.takes:
                raise UnknownNameError.from_known(f"argument of {name}", key, self.takes)
        given = {key: value for key, value in given.items() if value is not None}
        for key in self.needs:
            if key not in given:
                raise InputError(f"{name}: {key} is missing: {self.takes[key]['description']}")
        return given


class ArmTools:
    """The commands of one arm, simulated or real, as tools."""

    def __init__(self, robot: Commands):
        self.robot = robot
        self.logs: deque[Log] = deque(maxlen=_KEPT_WAYS)  # of the motions, that undo goes back
        self._eye = Eye(robot)
        self._hand: Gripper | Hand | None = None

    def state(self, given: Given) -> ToolAnswer:
        """Where the arm is."""
        robot = self.robot
        arm = robot.arm
        values: dict[str, Any] = {
            "arm": arm.name,
            "kind": "robot" if isinstance(robot, Robot) else "simulation",
            "time": round(float(robot.data.time), 6),
            "joints": dict(zip(arm.joint_names, rounded(robot.state.q), strict=True)),
            "joint_units": list(arm.units),
            "lowest": rounded(arm.limits.q_min),
            "highest": rounded(arm.limits.q_max),
            "tips": {tip: pose_values(pose) for tip, pose in robot.tips.items()},
            "motions_to_undo": len(self.logs),
        }
        hand = self._gripper_or_none()
        if hand is not None:
            held = {"held": hand.held} if isinstance(hand, Gripper) else {}
            values["gripper"] = {"width": _length(hand.width), "width_max": _length(hand.width_max), **held}
        if isinstance(robot, Robot):
            values["fault"] = robot.fault
        return _looked(values)

    def look(self, given: Given) -> ToolAnswer:
        """What is around the arm."""
        if "camera" in given:
            return _looked(points(self.robot, _name("camera", given)))
        return _looked(bodies(self.robot))

    def picture(self, given: Given) -> ToolAnswer:
        """A picture of the scene."""
        camera = _name("camera", given) if "camera" in given else None
        width = integer("width", given.get("width", _DEFAULT_SIZE[0]), _MIN_PIXELS, _MAX_PIXELS)
        height = integer("height", given.get("height", _DEFAULT_SIZE[1]), _MIN_PIXELS, _MAX_PIXELS)
        seen = "the scene" if camera is None else f"camera {camera}"
        return ToolAnswer(True, f"{seen}, {width} x {height} pixels", picture=self._eye.picture(camera, (width, height)))

    def move_to(self, given: Given) -> ToolAnswer:
        """To a target, around obstacles."""
        target = _target(given)
        result = self.robot.move_to(self._by_tip(target, given), speed=_speed(given))
        return self._moved(result, tip=target)

    def move_l(self, given: Given) -> ToolAnswer:
        """To a target on a straight line."""
        target = _target(given)
        result = self.robot.move_l(self._by_tip(target, given), speed=_speed(given))
        return self._moved(result, tip=target)

    def move_j(self, given: Given) -> ToolAnswer:
        """To joint positions."""
        q = self._joints(given["q"])
        speed = _speed(given)
        try:
            result = self.robot.move_j(q, speed=speed)
        except LimitError as error:
            return self._refused(str(error), str(error), q=q)
        return self._moved(result, q=q)

    def undo(self, given: Given) -> ToolAnswer:
        """Back along the way of the last motion."""
        if not self.logs:
            raise InputError("undo: there is no motion to go back")
        log = self.logs[-1]
        result = self.robot.move_back(log, speed=_speed(given))
        if result.log is None:
            return self._moved(result, q=log.q_ref[0])
        self.logs.pop()
        if not result:
            return self._moved(result, q=log.q_ref[0])
        return self._arrived(result)

    def grasp(self, given: Given) -> ToolAnswer:
        """Closes the gripper."""
        hand = self._gripper()
        return _gripped(hand.grasp(number("force", given["force"], 0.0)) if "force" in given else hand.close())

    def open(self, given: Given) -> ToolAnswer:
        """Opens the gripper."""
        hand = self._gripper()
        return _gripped(hand.move(number("width", given["width"], 0.0)) if "width" in given else hand.open())

    def _moved(self, result: MoveResult, *, q: Array | None = None, tip: TargetLike | None = None) -> ToolAnswer:
        """The answer to a motion: where the arm is, or why it did not move and what is safe instead."""
        if result.log is not None:
            self.logs.append(result.log)
        if result.ok:
            return self._arrived(result)
        if result.log is not None:
            return ToolAnswer(False, str(result), {"reason": result.reason, "moved": True})
        return self._refused(str(result), result.reason, q=q, tip=tip)

    def _refused(self, text: str, reason: str, *, q: Array | None = None, tip: TargetLike | None = None) -> ToolAnswer:
        """The answer to what is not done: why, and what is safe instead."""
        values: dict[str, Any] = {"reason": reason, "moved": False}
        nearest = self._nearest(q, tip)
        if nearest is not None:
            pose = self.robot.arm.fk(nearest, self.robot.arm.tip)
            values["nearest_safe"] = {"q": rounded(nearest), **pose_values(pose)}
            text = f"{text}; the nearest safe pose has the tip at {point_text(pose.position)}"
        return ToolAnswer(False, text, values)

    def _arrived(self, result: MoveResult) -> ToolAnswer:
        robot = self.robot
        touched = sorted({contact.other for contact in result.contacts})
        values = {"duration": round(result.duration, 6), "clearance": result.clearance, "touched": touched}
        tips = {tip: pose_values(pose) for tip, pose in robot.tips.items()}
        text = f"{result}; the tip is at {point_text(robot.tip.position)}"
        return ToolAnswer(True, text, {**values, "tips": tips})

    def _nearest(self, q: Array | None, tip: TargetLike | None) -> Array | None:
        """(n,) rad, the nearest safe configuration to what was refused; None if none is known."""
        arm = self.robot.arm
        if q is None and arm.further_tips:
            return None
        try:
            state = arm.limits.clamp(self.robot.state.q)
            answer = self.robot.gate().admit(state, q=q, tip=tip)
        except ArmctlError:  # it cannot be asked for at all, and the reason says so
            return None
        return answer.nearest

    def _by_tip(self, target: TargetLike, given: Given) -> Any:
        """A target, or of an arm with several tips targets by tip."""
        arm = self.robot.arm
        if not arm.further_tips:
            if "tip" in given and given["tip"] not in arm.tips:
                raise UnknownNameError.from_known("tip", given["tip"], arm.tips)
            return target
        if "tip" not in given:
            raise InputError(f"tip: {arm.name:.60} has several: {', '.join(arm.tips):.200}; say which")
        tip = _name("tip", given)
        if tip not in arm.tips:
            raise UnknownNameError.from_known("tip", tip, arm.tips)
        return {each: target if each == tip else STAY for each in arm.tips}

    def _joints(self, given: object) -> Array:
        """(n,) rad, from a list, or from positions by the names of the joints that move."""
        arm = self.robot.arm
        if not isinstance(given, Mapping):
            return vector("q", given, arm.n)  # type: ignore[arg-type]
        for name in given:
            if name not in arm.joint_names:
                raise UnknownNameError.from_known("joint", name, arm.joint_names)
        now = arm.limits.clamp(self.robot.state.q)
        return vector("q", [number(f"q: {name}", given.get(name, x)) for name, x in zip(arm.joint_names, now, strict=True)])

    def _gripper(self) -> Gripper | Hand:
        """The gripper of the arm; ModelError or LinkError if there is none."""
        if self._hand is None:
            robot = self.robot
            if not hasattr(type(robot), "gripper"):
                raise ModelError("gripper: these commands have none")
            self._hand = robot.gripper  # type: ignore[attr-defined]  # of a Simulation and a Robot
        assert self._hand is not None
        return self._hand

    def _gripper_or_none(self) -> Gripper | Hand | None:
        try:
            return self._gripper()
        except (ModelError, LinkError):
            return None


def _looked(values: dict[str, Any]) -> ToolAnswer:
    values = json_value(values)
    return ToolAnswer(True, json.dumps(values, allow_nan=False), values)


def _length(width: float) -> float:
    """m, for JSON."""
    return rounded(np.array([width]))[0]


def _gripped(result: GripResult) -> ToolAnswer:
    values = {"grasped": result.grasped, "held": result.held, "width": _length(result.width), "reason": result.reason}
    return ToolAnswer(result.ok, str(result), values)


def _target(given: Given) -> TargetLike:
    position = vector("position", given["position"], 3)
    if np.abs(position).max() > _FARTHEST_M:
        raise InputError(f"position: {shown(given['position'])} is more than {_FARTHEST_M:g} m away; positions are in metres")
    if "quat" in given and "rpy" in given:
        raise InputError("quat: give either quat or rpy, not both")
    if "quat" in given:
        return Pose(position, quat=vector("quat", given["quat"], 4))
    return position if "rpy" not in given else Pose(position, rpy=vector("rpy", given["rpy"], 3))


def _speed(given: Given) -> float:
    return number("speed", given.get("speed", 1.0), _MIN_SPEED, 1.0)


def _name(what: str, given: Given) -> str:
    if not isinstance(given[what], str):
        raise InputError(f"{what}: expected a name, got {shown(given[what])}")
    return given[what]


TOOLS: Mapping[str, AgentTool] = MappingProxyType(
    {
        "state": AgentTool(
            text="Where the joints, the tips and the gripper are, and the limits of the joints.", run=ArmTools.state
        ),
        "look": AgentTool(
            text="What is around the arm: bodies with poses and boxes in their own frames, loose ones too; with a camera, the "
            "points that it sees and that are not on the robot.",
            run=ArmTools.look,
            takes={"camera": _CAMERA},
        ),
        "picture": AgentTool(
            text="A picture of the scene, or of a camera.",
            run=ArmTools.picture,
            takes={
                "camera": _CAMERA,
                "width": {"type": "integer", "minimum": _MIN_PIXELS, "maximum": _MAX_PIXELS},
                "height": {"type": "integer", "minimum": _MIN_PIXELS, "maximum": _MAX_PIXELS},
            },
        ),
        "move_to": AgentTool(
            text="Moves the tip to a target, around all bodies. A refusal says why, and which pose is safe instead.",
            run=ArmTools.move_to,
            takes={**_TARGET, "tip": _TIP},
            needs=("position",),
            moves=True,
        ),
        "move_l": AgentTool(
            text="Moves the tip to a target on a straight line; refused if the line touches anything.",
            run=ArmTools.move_l,
            takes={**_TARGET, "tip": _TIP},
            needs=("position",),
            moves=True,
        ),
        "move_j": AgentTool(
            text="Moves the joints, around all bodies.",
            run=ArmTools.move_j,
            takes={"q": _Q, "speed": _SPEED},
            needs=("q",),
            moves=True,
        ),
        "grasp": AgentTool(
            text="Closes the gripper until both fingers touch a body, and holds it.",
            run=ArmTools.grasp,
            takes={"force": _number("N; gentle if left out", minimum=0)},
            moves=True,
        ),
        "open": AgentTool(
            text="Opens the gripper.",
            run=ArmTools.open,
            takes={"width": _number("m; completely if left out", minimum=0)},
            moves=True,
        ),
        "undo": AgentTool(
            text="Moves back along the way of the last motion; repeated, of the one before.",
            run=ArmTools.undo,
            takes={"speed": _SPEED},
            moves=True,
        ),
    }
)
