"""The frames of an arm's joints: each joint turns about, or slides along, the z axis of its own frame."""

from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.validation import Array, BoolArray
from armctl.model.mjmodel.queries import Joints, last_joint_above


class JointFrames(NamedTuple):
    """The frames of m joints, parents before children."""

    data: mujoco.MjData  # the model with these joints where `qpos0` has them
    frames: list[pin.SE3]  # (m,) in the world there
    placements: list[pin.SE3]  # (m,) at position zero, in the frame of the joint before (in the world)
    parents: list[int]  # (m,) the joint before; -1 for the base
    is_slide: BoolArray  # (m,)


def joint_frames(model: mujoco.MjModel, joints: Joints, qpos: Array) -> JointFrames:
    """The frames of some joints; all others are held at `qpos` (nq,)."""
    data = mujoco.MjData(model)
    zero = model.qpos0[model.jnt_qposadr[list(joints)]]
    data.qpos[:] = qpos
    data.qpos[model.jnt_qposadr[list(joints)]] = zero
    mujoco.mj_kinematics(model, data)
    frames = [_joint_frame(data.xanchor[j], data.xaxis[j]) for j in joints]
    is_slide = np.array([model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE for j in joints])
    parents = _joints_behind(model, joints)
    placements = []
    for i, above in enumerate(parents):
        previous = frames[above] if above >= 0 else pin.SE3.Identity()
        placements.append(previous.actInv(frames[i]) * _joint_displacement(-zero[i], bool(is_slide[i])))
    return JointFrames(data, frames, placements, parents, is_slide)


def _joints_behind(model: mujoco.MjModel, joints: Joints) -> list[int]:
    """For every joint, the position in `joints` of its parent joint, -1 if it has none."""
    carried = last_joint_above(model, joints)
    behind: list[int] = []
    for i, joint in enumerate(joints):
        body = int(model.jnt_bodyid[joint])
        before = [k for k, other in enumerate(joints[:i]) if model.jnt_bodyid[other] == body]
        behind.append(before[-1] if before else carried[int(model.body_parentid[body])])
    return behind


def _joint_frame(anchor: Array, axis: Array) -> pin.SE3:
    """A frame at the anchor whose z axis is the joint's axis."""
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[np.abs(z).argmin()]
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    return pin.SE3(np.column_stack([x, np.cross(z, x), z]), anchor.copy())


def _joint_displacement(q: float, slides: bool) -> pin.SE3:
    """The displacement of a joint at position q: along z if it slides, else about z."""
    if slides:
        return pin.SE3(np.eye(3), np.array([0.0, 0.0, q]))
    return pin.SE3(pin.utils.rotate("z", q), np.zeros(3))
