"""Tool: what is at the end of an arm, as it works on a table."""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.model.arm.arm import Arm
from armctl.model.gripper.grip_frames import ALONG_AXIS
from armctl.model.gripper.gripper_model import GripperModel, find_gripper_model, make_usable
from armctl.model.gripper.jaws import MAX_JAW_DISTANCE
from armctl.model.mjmodel.brake import brake
from armctl.model.mjmodel.queries import is_below
from armctl.run.sim.gripper.gripper import PAD_SPEED

_MIN_OFFSET = 1e-3  # m, between the last joint and the tip: below it the joint's axis is where the tool points
_NEAR_END = 0.04  # m from the end of the tool: what touches an object on the table
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_ROUND = {int(kind) for kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)}
_RING = np.array([[np.cos(a), np.sin(a), z] for a in np.arange(8) * np.pi / 4 for z in (-1.0, 1.0)])
_MAX_TOOL = 0.5  # m from the tip
_SETTLE_TIME = 1.0  # s


class Grip(NamedTuple):
    """The gripper behind an arm's tip."""

    model: GripperModel  # the gripper as it was found in the MuJoCo model
    qpos_adr: IntArray  # addresses in `MjData.qpos` of its joints
    closed: mujoco.MjData  # the state of the arm at home when it is closed
    opened: mujoco.MjData  # the state of the arm at home when it is open
    indices: IntArray  # (2, actuators) of its actuators in `MjData.ctrl` and in `MjData.actuator_length`
    ends: Array  # (4, actuators) the controls when closed and open, and the actuators' lengths when closed and open
    speed: float  # 1/s, the fraction of the way from closed to open that its controls move in a second

    @property
    def width_max(self) -> float:
        """The distance between the pads when open, m."""
        return float(self.model.width[-1])


def find_grip(arm: Arm) -> Grip:
    """The gripper behind an arm's tip; ModelError if nothing moves there, or a hand of many actuators."""
    gripper = find_gripper_model(arm)
    actuators = list(gripper.actuators)
    indices = np.array([arm.model.actuator_ctrladr[actuators], actuators], np.int64)
    joints = np.unique(arm.model.dof_jntid[gripper.dofs])
    return Grip(
        model=gripper,
        qpos_adr=arm.model.jnt_qposadr[joints].astype(np.int64),
        closed=state_at(arm, gripper, gripper.ctrl[0]),
        opened=state_at(arm, gripper, gripper.ctrl[-1]),
        indices=indices,
        ends=np.array([gripper.ctrl[0], gripper.ctrl[-1], gripper.length[0], gripper.length[-1]]),
        speed=PAD_SPEED / float(np.ptp(gripper.width)),
    )


def state_at(arm: Arm, gripper: GripperModel, ctrl: Array) -> mujoco.MjData:
    """The state at home in which controls (actuators,) hold the gripper, without contacts and gravity."""
    model = copy.copy(arm.model)
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    brake(model, np.setdiff1d(np.arange(model.nv), gripper.dofs))
    make_usable(model, gripper)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    data.ctrl[model.actuator_ctrladr[list(gripper.actuators)]] = ctrl
    mujoco.mj_step(model, data, round(_SETTLE_TIME / model.opt.timestep))
    mujoco.mj_forward(model, data)
    return data


class Tool(NamedTuple):
    """The end of an arm."""

    axis: str  # "x", "y" or "z": the axis of the tip along which the tool points
    sign: float  # 1 or -1, the direction on it
    overhang: float  # m, how far the tool extends beyond the tip
    radius: float  # m, how far the end of the tool extends to the sides of the tip

    @property
    def end(self) -> Array:
        """(3,) m, the end of the tool in the tip's frame."""
        end = np.zeros(3)
        end["xyz".index(self.axis)] = self.sign * self.overhang
        return end

    @property
    def rotation_down(self) -> Array:
        """(3, 3) a rotation of the tip in which the tool points down."""
        column = "xyz".index(self.axis)
        rotation = np.zeros((3, 3))
        rotation[:, column] = [0.0, 0.0, -self.sign]
        rotation[:, (column + 1) % 3] = [1.0, 0.0, 0.0]
        rotation[:, (column + 2) % 3] = np.cross(rotation[:, column], rotation[:, (column + 1) % 3])
        return rotation


def find_tool(arm: Arm, states: Sequence[mujoco.MjData]) -> Tool:
    """The tool of an arm, in states such as those with the gripper closed and open.

    It points from the last joint to the tip: along the joint's axis if that is nearly the direction. If the tip is at the
    joint, it points along the axis to where the tool extends farther.
    """
    points = np.concatenate([_points(arm, data) for data in states] or [np.zeros((1, 3))])
    points = points[np.linalg.norm(points, axis=1) < _MAX_TOOL]
    direction = _direction(arm, states[0], points)
    column = int(np.abs(direction).argmax())
    sign = float(np.sign(direction[column]))
    if not len(points):
        return Tool("xyz"[column], sign, 0.0, 0.0)
    depth = sign * points[:, column]
    overhang = float(depth.max())
    sides = np.delete(points, column, axis=1)[depth > overhang - _NEAR_END]
    return Tool("xyz"[column], sign, overhang, float(np.linalg.norm(sides, axis=1).max()))


def jaw_center(arm: Arm, grip: Grip, tool: Tool, width: float) -> Array:
    """(3,) m, the middle between the jaws at a width (m) in the tip's frame, beside the line along which the tool points.

    Jaws that move alike are in the same distance of that line. Of a jaw that does not move, the middle depends on the width.
    """
    data = state_at(arm, grip.model, grip.model.ctrl_at(width))
    first, second = _nearest(arm, grip, data)
    rotation, position = _tip(arm, data)
    apart = rotation.T @ (second - first)
    apart["xyz".index(tool.axis)] = 0.0
    apart /= max(float(np.linalg.norm(apart)), 1e-9)
    return apart * float(apart @ (rotation.T @ (0.5 * (first + second) - position)))


def _nearest(arm: Arm, grip: Grip, data: mujoco.MjData) -> Array:
    """(2, 3) m, the points of the jaws that are nearest to each other."""
    jaws = grip.model.jaws
    if jaws.pads:
        segment = np.zeros(6)
        mujoco.mj_geomDistance(arm.model, data, *jaws.pads, MAX_JAW_DISTANCE, segment)
        return segment.reshape(2, 3)
    return np.array([data.xpos[p.body] + data.xmat[p.body].reshape(3, 3) @ p.position for p in jaws.points])


def _direction(arm: Arm, data: mujoco.MjData, points: Array) -> Array:
    """(3,) the direction in which the tool with these points (k, 3) points, in the tip's frame."""
    joint = arm.joint_map.joints[-1]
    tip = _tip(arm, data)
    offset = tip[0].T @ (tip[1] - data.xanchor[joint])
    axis = tip[0].T @ data.xaxis[joint]
    length = float(np.linalg.norm(offset))
    if length < _MIN_OFFSET:
        extents = points @ axis
        return -axis if len(points) and -extents.min() > extents.max() else axis
    if abs(axis @ offset) > ALONG_AXIS * length:
        return np.sign(axis @ offset) * axis
    return offset / length


def _points(arm: Arm, data: mujoco.MjData) -> Array:
    """(k, 3) m, points of everything behind the last joint that can touch, in the tip's frame."""
    model = arm.model
    last = arm.last_bodies[0]
    rotation, position = _tip(arm, data)
    points = [np.zeros((0, 3))]
    for geom in range(model.ngeom):
        if not is_below(model, int(model.geom_bodyid[geom]), last):
            continue
        if not model.geom_contype[geom] and not model.geom_conaffinity[geom]:
            continue
        if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_MESH):
            mesh = int(model.geom_dataid[geom])
            first = int(model.mesh_vertadr[mesh])
            local = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
        else:
            unit = _RING if int(model.geom_type[geom]) in _ROUND else _CORNERS
            local = model.geom_aabb[geom, :3] + unit * model.geom_aabb[geom, 3:]
        world = data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
        points.append((world - position) @ rotation)
    return np.concatenate(points)


def _tip(arm: Arm, data: mujoco.MjData) -> tuple[Array, Array]:
    """Rotation (3, 3) and position (3,) of the tip in a state."""
    body = data.xmat[arm.tip_body].reshape(3, 3)
    return body @ arm.T_body_tip.rotation, data.xpos[arm.tip_body] + body @ arm.T_body_tip.position
