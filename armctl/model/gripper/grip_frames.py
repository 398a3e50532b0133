"""GripFrames: where a gripper holds what is between its pads, in the frame of the tip."""

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array, frozen
from armctl.model.arm.arm import Arm
from armctl.model.gripper.gripper_model import GripperModel
from armctl.model.gripper.jaws import MAX_JAW_DISTANCE, MIN_OPENING, geom_points

ALONG_AXIS = 0.7  # cosine, above which a tool points along the axis of the last joint
_FACE_DEPTH = 1e-3  # m, behind the foremost point of a pad: what is nearer to the other pad than this is its face


@dataclass(frozen=True, eq=False)
class GripFrames:
    """Where a gripper holds, at each of its widths.

    The frame of a grip has its origin in the middle between the pads. Its x axis is the direction in which they close, its z
    axis the one in which the fingers point.

    Attributes:
        width: (k,) m, increasing.
        centers: (k, 3) m, the origin at each width, in the frame of the tip.
        closing: (3,) the x axis, likewise.
        pointing: (3,) the z axis, likewise.
        depth: m, how far the faces of the pads extend from the origin to either side along the z axis.
    """

    width: Array
    centers: Array
    closing: Array
    pointing: Array
    depth: float

    @property
    def width_max(self) -> float:
        """The distance between the pads when open, m."""
        return float(self.width[-1])

    def at(self, width: float) -> Pose:
        """T_tip_grip at a width, m."""
        center = [np.interp(width, self.width, column) for column in self.centers.T]
        side = np.cross(self.pointing, self.closing)
        return Pose.from_rotation(center, np.column_stack([self.closing, side, self.pointing]))


class _Faces(NamedTuple):
    """Two pads that face each other: the middle between them, and how far they extend from it."""

    center: Array  # (3,) m
    depth: float  # m


def grip_frames(arm: Arm, gripper: GripperModel, tip: str | None = None) -> GripFrames:
    """Where a gripper behind one of an arm's tips holds, the first tip if left out."""
    model = arm.model
    number = 0 if tip is None else arm.tips.index(tip)
    frame = arm.tip_frames[number]
    data = mujoco.MjData(model)
    centers = np.zeros((len(gripper.width), 3))
    closing = np.zeros(3)
    pointing = np.zeros(3)
    depth = 0.0
    for k in reversed(range(len(gripper.width))):  # from open to closed: the pads of a closed gripper have no direction
        data.qpos[:] = gripper.qpos[k]
        mujoco.mj_kinematics(model, data)
        T_tip_world = (Pose(data.xpos[frame.body], data.xquat[frame.body]) @ frame.T_body_tip).inverse()
        ends = np.array([T_tip_world.transform(end) for end in _nearest(model, data, gripper)])
        if k == len(gripper.width) - 1:
            pointing = _pointing(arm, data, arm.last_bodies[number], T_tip_world, ends)
        if np.linalg.norm(ends[1] - ends[0]) > MIN_OPENING or not closing.any():
            across = ends[1] - ends[0] - pointing * (pointing @ (ends[1] - ends[0]))
            closing = across / np.linalg.norm(across)
        faces = _faces(model, data, gripper, T_tip_world, ends, closing, pointing)
        centers[k] = faces.center
        depth = faces.depth
    return GripFrames(
        width=gripper.width, centers=frozen(centers), closing=frozen(closing), pointing=frozen(pointing), depth=depth
    )


def _nearest(model: mujoco.MjModel, data: mujoco.MjData, gripper: GripperModel) -> Array:
    """(2, 3) m, the points of the jaws that are nearest to each other, in the world."""
    jaws = gripper.jaws
    if jaws.pads:
        segment = np.zeros(6)
        mujoco.mj_geomDistance(model, data, *jaws.pads, MAX_JAW_DISTANCE, segment)
        return segment.reshape(2, 3)
    return np.array([data.xpos[p.body] + data.xmat[p.body].reshape(3, 3) @ p.position for p in jaws.points])


def _pointing(arm: Arm, data: mujoco.MjData, last: int, T_tip_world: Pose, ends: Array) -> Array:
    """(3,) the direction of the fingers: from the last joint to the pads, along its axis if that is nearly the direction."""
    joint = int(arm.model.body_jntadr[last])
    axis = T_tip_world.rotation @ data.xaxis[joint]
    across = ends[1] - ends[0]
    across = across / np.linalg.norm(across)
    offset = ends.mean(axis=0) - T_tip_world.transform(data.xanchor[joint])
    offset = offset - across * (across @ offset)
    length = float(np.linalg.norm(offset))
    if abs(axis @ offset) >= ALONG_AXIS * length:
        return axis if axis @ offset >= 0.0 else -axis
    return offset / length


def _faces(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    gripper: GripperModel,
    T_tip_world: Pose,
    ends: Array,
    closing: Array,
    pointing: Array,
) -> _Faces:
    """The faces of the pads, in the frame of the tip; the middle of the nearest points where the jaws have no pads.

    A finger may have several pads in one plane; they are one face.
    """
    middle = ends.mean(axis=0)
    if not gripper.jaws.pads:
        return _Faces(middle, 0.0)
    axes = np.array([closing, np.cross(pointing, closing), pointing])
    fronts = []
    low = np.full(2, -np.inf)
    high = np.full(2, np.inf)
    for pad, sign in zip(gripper.jaws.pads, (1.0, -1.0), strict=True):
        front = sign * float((sign * _points(model, data, pad, T_tip_world) @ closing).max())
        body = int(model.geom_bodyid[pad])
        solid = [g for g in np.flatnonzero(model.geom_bodyid == body) if model.geom_contype[g] | model.geom_conaffinity[g]]
        # What comes farther forward, as the root of a jaw that turns, only crosses the plane of the pad.
        shapes = [_points(model, data, int(geom), T_tip_world) for geom in solid]
        shapes = [points for points in shapes if sign * front - float((sign * points @ closing).max()) >= -_FACE_DEPTH]
        points = np.concatenate(shapes)
        face = points[np.abs(points @ closing - front) <= _FACE_DEPTH] @ axes[1:].T
        low = np.maximum(low, face.min(axis=0))
        high = np.minimum(high, face.max(axis=0))
        fronts.append(front)
    across, along = np.where(low <= high, 0.5 * (low + high), axes[1:] @ middle)
    center = np.array([0.5 * sum(fronts), across, along]) @ axes
    return _Faces(center, 0.5 * max(0.0, float(high[1] - low[1])))


def _points(model: mujoco.MjModel, data: mujoco.MjData, geom: int, T_tip_world: Pose) -> Array:
    """(k, 3) m, points of a geom in the frame of the tip."""
    body = int(model.geom_bodyid[geom])
    world = data.xpos[body] + geom_points(model, geom) @ data.xmat[body].reshape(3, 3).T
    return T_tip_world.position + world @ T_tip_world.rotation.T
