"""The geometry of an arm as frames in a chain, each with small errors: measured poses, their Jacobian, and corrected models."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.core.pose import Pose, computed_pose
from armctl.core.validation import Array, shown
from armctl.model.arm.arm import Arm, with_model

KINDS = ("offsets", "base", "tool", "lengths", "axes", "sensor", "marker")
_SMALL_ANGLE = 1e-6  # rad, below which sin(x) / x is 1 in double precision


class Parameter(NamedTuple):
    name: str  # such as "joint2 offset", "joint2 x", "base rz"
    kind: str  # one of `KINDS`
    frame: int  # the number of the frame in the chain
    turns: bool  # whether it turns the frame (rad) instead of shifting it (m)
    axis: Array  # (3,) about which, in the frame; or along which, in the frame before it


class MeasuredPoses(NamedTuple):
    """Predicted poses: positions (K, 3) m, rotations (K, 3, 3), and derivatives of both (K, 3, p), rotations as vectors."""

    position: Array
    rotation: Array
    position_by: Array
    rotation_by: Array


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A frame in the one before it, and which joint moves behind it: -1 for none."""

    position: Array
    rotation: Array
    joint: int = -1


class KinematicChain:
    """Sensor, base, joints, tool and marker: the pose of the marker that the sensor measures, and errors of all frames.

    With a sensor on the hand, the chain leads from the marker in the world to the sensor, and the measured pose is the inverse.
    """

    def __init__(self, arm: Arm, on_hand: bool = False):
        model = arm.model
        joints = arm.joint_map.joints
        bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
        if not arm.joint_map.is_plain:
            raise ModelError(f"{arm.name:.80}: a joint follows another one; its geometry cannot be calibrated")
        if len(set(bodies)) < len(bodies):
            raise ModelError(f"{arm.name:.80}: two joints move one body; give each a body of its own")
        self.arm = arm
        self.on_hand = on_hand
        self._is_slide = arm.pinocchio_model.is_slide
        data = mujoco.MjData(model)
        data.qpos[:] = arm.qpos(np.zeros(arm.n))
        mujoco.mj_kinematics(model, data)
        world = np.eye(4)
        origin = data.xpos[model.body_parentid[bodies[0]]].copy()
        self.frames = [Frame(np.zeros(3), np.eye(3)), Frame(origin, np.eye(3))]
        first, last = ("marker", "sensor") if on_hand else ("sensor", "marker")
        parameters = _six(first, 0, np.eye(3)) + _six("base", 1, np.eye(3))
        for i, (name, body) in enumerate(zip(arm.joint_names, bodies, strict=True)):
            placement = arm.pinocchio_model.placements[i]
            before = world[:3, :3]
            world = world @ placement
            self.frames.append(Frame(placement[:3, 3] - (origin if i == 0 else 0.0), placement[:3, :3], i))
            z = np.array([0.0, 0.0, 1.0])
            slides = bool(self._is_slide[i])
            parameters.append(Parameter(f"{name} offset", "offsets", i + 2, not slides, placement[:3, 2] if slides else z))
            if i == 0:
                continue  # the base has these errors
            parent = data.xmat[model.body_parentid[body]].reshape(3, 3)
            own = world[:3, :3].T @ data.xmat[body].reshape(3, 3)
            for axis in range(3):
                parameters.append(Parameter(f"{name} {'xyz'[axis]}", "lengths", i + 2, False, before.T @ parent[:, axis]))
            for axis in sorted(np.abs(own[2]).argsort(kind="stable")[:2].tolist()):
                tilt = own[:, axis] * (1.0, 1.0, 0.0)
                parameters.append(Parameter(f"{name} r{'xyz'[axis]}", "axes", i + 2, True, tilt / np.linalg.norm(tilt)))
        T_last_tip = arm.pinocchio_model.T_last_tip
        tip_body = world[:3, :3].T @ data.xmat[arm.tip_body].reshape(3, 3)
        self.frames.append(Frame(T_last_tip[:3, 3], T_last_tip[:3, :3]))
        self.frames.append(Frame(np.zeros(3), np.eye(3)))
        parameters += _six("tool", arm.n + 2, tip_body)
        parameters += _six(last, arm.n + 3, np.eye(3))
        self.parameters = sorted(parameters, key=lambda parameter: KINDS.index(parameter.kind))

    def select(self, wanted: Sequence[str], positions_only: bool) -> list[Parameter]:
        """Parameters by kind or by name, in the order wanted; no rotation of the marker where only its point is measured."""
        known = [*KINDS, *(parameter.name for parameter in self.parameters)]
        if isinstance(wanted, str) or not all(name in known for name in wanted):
            raise InputError(
                f"parameters: expected a list of {', '.join(KINDS)}, or names like {known[-1]!r}, got {shown(wanted)}"
            )
        chosen = {p.name: p for name in wanted for p in self.parameters if name in (p.kind, p.name)}
        point = 0 if self.on_hand else max((p.frame for p in chosen.values()), default=0)
        kinds = ("tool", "marker")
        return [p for p in chosen.values() if not (positions_only and p.turns and p.frame == point and p.kind in kinds)]

    def predict(self, q: Array, parameters: Sequence[Parameter], x: Array) -> MeasuredPoses:
        """What the sensor measures at configurations (K, n), with errors x of some parameters (p,)."""
        count = len(q)
        position = np.zeros((count, 3))
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
        turned = np.zeros((count, 3, len(x)))
        shifted = np.zeros((count, 3, len(x)))
        about = np.zeros((count, 3, len(x)))
        for number, frame in enumerate(self.frames):
            shift, turn = _errors(number, parameters, x)
            own = [(k, p) for k, p in enumerate(parameters) if p.frame == number]
            for k, parameter in own:
                if not parameter.turns:
                    shifted[:, :, k] = rotation @ parameter.axis
            position = position + rotation @ (frame.position + shift)
            rotation = rotation @ (frame.rotation @ _exp(turn))
            for k, parameter in own:
                if parameter.turns:
                    turned[:, :, k] = rotation @ (_right_jacobian(turn) @ parameter.axis)
                    about[:, :, k] = position
            if frame.joint >= 0:
                moved = q[:, frame.joint]
                if self._is_slide[frame.joint]:
                    position = position + moved[:, None] * rotation[:, :, 2]
                else:
                    rotation = rotation @ _about_z(moved)
        shifted += np.cross(turned, position[:, :, None] - about, axis=1)
        if not self.on_hand:
            return MeasuredPoses(position, rotation, shifted, turned)
        back = rotation.transpose(0, 2, 1)
        shifted = back @ (np.cross(turned, position[:, :, None], axis=1) - shifted)
        return MeasuredPoses(-(back @ position[:, :, None])[:, :, 0], back, shifted, -back @ turned)

    def place_outer_frames(self, first: Pose, last: Pose) -> None:
        """Sets the ends of the chain: a fixed sensor's frame and its marker's, or a fixed marker's and its sensor's."""
        self.frames[0] = Frame(first.position, first.rotation)
        self.frames[-1] = Frame(last.position, last.rotation)

    def frame_pose(self, number: int, parameters: Sequence[Parameter], x: Array) -> Pose:
        frame = self.frames[number]
        shift, turn = _errors(number, parameters, x)
        return computed_pose(frame.position + shift, frame.rotation @ _exp(turn))

    def corrected(self, parameters: Sequence[Parameter], x: Array) -> Arm:
        """The arm with errors of base, joints and tool in its model, so that its geometry is that of the real arm."""
        arm = self.arm
        old = arm.model
        model = copy.copy(old)
        data = mujoco.MjData(old)
        data.qpos[:] = arm.qpos(old.qpos0[arm.qpos_adr])
        mujoco.mj_kinematics(old, data)
        bodies = [int(old.jnt_bodyid[joint]) for joint in arm.joint_map.joints]
        moved = {0: np.eye(4)}  # how a body moves in the world
        base = int(old.body_parentid[bodies[0]])
        nominal = np.eye(4)
        actual = np.eye(4)
        for number, body in enumerate([base, *bodies], start=1):
            nominal = nominal @ self.frame_pose(number, (), np.zeros(0)).matrix
            actual = actual @ self.frame_pose(number, parameters, x).matrix
            if body:  # the world itself stays where it is
                moved[body] = actual @ np.linalg.inv(nominal)
            if number >= 2:
                J = self._joint(number - 2, float(data.qpos[arm.qpos_adr[number - 2]]))
                nominal = nominal @ J
                actual = actual @ J
        for body in range(1, old.nbody):
            parent = int(old.body_parentid[body])
            moved.setdefault(body, moved[parent])
            if not np.allclose(moved[body], moved[parent], rtol=0.0, atol=1e-15):
                T_parent = _pose(data, parent)
                T = np.linalg.inv(moved[parent] @ T_parent) @ moved[body] @ _pose(data, body)
                model.body_pos[body] = T[:3, 3]
                mujoco.mju_mat2Quat(model.body_quat[body], T[:3, :3].ravel())
        T_body_tip = self._tip(parameters, x)
        site = mujoco.mj_name2id(old, mujoco.mjtObj.mjOBJ_SITE, arm.tip)
        if site >= 0:
            model.site_pos[site] = T_body_tip.position
            model.site_quat[site] = T_body_tip.quat
            model.site_sameframe[site] = 0
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return with_model(replace(arm, T_body_tip=T_body_tip), model)

    def _tip(self, parameters: Sequence[Parameter], x: Array) -> Pose:
        number = self.arm.n + 2
        nominal = self.frame_pose(number, (), np.zeros(0))
        actual = self.frame_pose(number, parameters, x)
        T_last_body = nominal @ self.arm.T_body_tip.inverse()
        return T_last_body.inverse() @ actual

    def _joint(self, i: int, q: float) -> Array:
        """(4, 4), the displacement of a joint."""
        T = np.eye(4)
        if self._is_slide[i]:
            T[2, 3] = q
        else:
            T[:3, :3] = _about_z(np.array([q]))[0]
        return T


def _six(kind: str, frame: int, axes: Array) -> list[Parameter]:
    """The errors of a frame that may be anywhere: shifts along some axes of the frame before it, and turns about its own."""
    turns = np.eye(3)
    shifts = [Parameter(f"{kind} {'xyz'[k]}", kind, frame, False, axes[:, k]) for k in range(3)]
    return shifts + [Parameter(f"{kind} r{'xyz'[k]}", kind, frame, True, turns[k]) for k in range(3)]


def _errors(frame: int, parameters: Sequence[Parameter], x: Array) -> tuple[Array, Array]:
    """Shift (3,) m and rotation vector (3,) rad of a frame."""
    shift = np.zeros(3)
    turn = np.zeros(3)
    for parameter, value in zip(parameters, x, strict=True):
        if parameter.frame == frame:
            if parameter.turns:
                turn += value * parameter.axis
            else:
                shift += value * parameter.axis
    return shift, turn


def cross_matrix(v: Array) -> Array:
    """(3, 3), whose product with a vector is the cross product of v and the vector."""
    return np.cross(v, np.eye(3), axisb=0, axisc=0)


def _exp(turn: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(turn).as_matrix()


def _right_jacobian(turn: Array) -> Array:
    """(3, 3), the rotation vector in the turned frame by that of a change of `turn`: Chirikjian, Stochastic Models (2012)."""
    angle = float(np.linalg.norm(turn))
    if angle < _SMALL_ANGLE:
        return np.eye(3)
    W = cross_matrix(turn)
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W


def _about_z(angles: Array) -> Array:
    """(K, 3, 3) rotations about z."""
    R = np.zeros((len(angles), 3, 3))
    R[:, 0, 0] = np.cos(angles)
    R[:, 1, 1] = R[:, 0, 0]
    R[:, 1, 0] = np.sin(angles)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R


def _pose(data: mujoco.MjData, body: int) -> Array:
    """(4, 4), a body in the world."""
    T = np.eye(4)
    T[:3, 3] = data.xpos[body]
    T[:3, :3] = data.xmat[body].reshape(3, 3)
    return T
