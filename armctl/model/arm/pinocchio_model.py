"""The Pinocchio model of an arm, built from the compiled MuJoCo model, body by body.

Every joint turns about, or slides along, the z axis of its own frame. Joints outside the chain are held where they are, so the
bodies behind them are rigidly connected to the link that carries them. Joints that follow a joint of the chain are Pinocchio's
mimic joints.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.pose import Pose
from armctl.core.validation import Array, BoolArray, frozen
from armctl.model.arm.joint_frames import joint_frames
from armctl.model.arm.joint_map import JointMap
from armctl.model.arm.passive_forces import is_enabled
from armctl.model.mjmodel.queries import last_joint_above

WORLD_AXES_AT_TIP = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class TipFrame(NamedTuple):
    """A tip: a frame in one of the bodies."""

    name: str
    body: int
    T_body_tip: Pose


class _PinocchioScratch(threading.local):
    """Pinocchio's scratch memory and the place of the tip in it, one for each thread."""

    def __init__(self, pin_model: pin.Model, tip_frame: int):
        self.data = pin_model.createData()
        T = self.data.oMf[tip_frame]
        self.tip = T.translation, T.rotation


@dataclass(frozen=True, eq=False)
class PinocchioModel:
    """Kinematics and inertia of an arm: its first tip behind a chain of k joints, other joints, and their tips."""

    joint_map: JointMap  # how the n move the chain's joints, which come first in it, and what else
    pin_model: pin.Model  # the Pinocchio model; its frame `tip_frame` is the first tip
    tip_frame: int  # index of the first tip's frame; those of further tips follow
    # (k, 4, 4), each joint's frame at zero in the frame of the joint before it (the first one's in the world)
    placements: Array
    is_slide: BoolArray  # (k,) bool, True where the joint slides along its z axis instead of turning about it
    T_last_tip: Array  # (4, 4), the tip in the last joint's frame
    # A second Pinocchio model that carries only what gravity compensation in the MuJoCo model lifts (`gravcomp`), or None where
    # nothing is lifted
    gravity_support: pin.Model | None

    @property
    def chain_length(self) -> int:
        """The number k of joints from the base to the tip, coupled joints included."""
        return len(self.placements)

    def tip(self, q: Array) -> tuple[Array, Array]:
        """Position (3,) m and rotation (3, 3) of the tip in the world at q (n,); valid until this thread's next call."""
        memory = self._memory
        pin.framesForwardKinematics(self.pin_model, memory.data, q)
        return memory.tip

    @property
    def scratch(self) -> pin.Data:
        """Pinocchio's scratch memory of this thread; what it holds is valid until this thread's next call."""
        return self._memory.data

    @cached_property
    def _memory(self) -> _PinocchioScratch:
        return _PinocchioScratch(self.pin_model, self.tip_frame)

    def further_tip(self, q: Array, index: int) -> tuple[Array, Array]:
        """As `tip`, of a tip by its number; the first one is 0."""
        data = self._memory.data
        pin.framesForwardKinematics(self.pin_model, data, q)
        T = data.oMf[self.tip_frame + index]
        return T.translation, T.rotation

    def carried(self, index: int) -> tuple[int, Array]:
        """The joint that carries a tip by its number, -1 for the world, and the tip in that joint's frame (12,)."""
        frame = self.pin_model.frames[self.tip_frame + index]
        placement = frame.placement
        return frame.parentJoint - 1, np.concatenate([placement.rotation.ravel(), placement.translation])

    def jacobian(self, q: Array, index: int = 0) -> Array:
        """The Jacobian (6, n) of a tip by its number at q (n,), linear first, world axes."""
        J = pin.computeFrameJacobian(self.pin_model, self._memory.data, q, self.tip_frame + index, WORLD_AXES_AT_TIP)
        return J.reshape(6, -1)  # Pinocchio drops the column of a single joint

    def __reduce__(self):
        return type(self), tuple(getattr(self, field.name) for field in fields(self))


class ClosedPinocchioModel(PinocchioModel):
    """The same with closed loops: each of the m joints is one of the Pinocchio model's, and the n driven ones move them all."""

    def tip(self, q: Array) -> tuple[Array, Array]:
        """As that of a tree."""
        return super().tip(self.joint_map.positions(q))

    def further_tip(self, q: Array, index: int) -> tuple[Array, Array]:
        """As that of a tree."""
        return super().further_tip(self.joint_map.positions(q), index)

    def jacobian(self, q: Array, index: int = 0) -> Array:
        """As that of a tree."""
        return super().jacobian(self.joint_map.positions(q), index) @ self.joint_map.ratio_at(q)


def build_pinocchio_model(
    model: mujoco.MjModel, chain_length: int, joint_map: JointMap, qpos: Array, tips: Sequence[TipFrame]
) -> PinocchioModel:
    """The rigid-body model of an arm; `qpos` holds all joints outside it.

    Of the joints of `joint_map`, the first `chain_length` are those from the base to the first tip.
    """
    joints = joint_map.joints
    data, frames, joint_placements, parents, is_slide = joint_frames(model, joints, qpos)
    pin_model = pin.Model()
    has_gravity = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    pin_model.gravity.linear = model.opt.gravity if has_gravity else np.zeros(3)
    placements = []
    for i, (joint, above, placement) in enumerate(zip(joints, parents, joint_placements, strict=True)):
        kind = pin.JointModelPZ() if is_slide[i] else pin.JointModelRZ()
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"joint{joint}"
        pin_model.addJoint(above + 1, kind, placement, name)
        placements.append(placement.homogeneous)
    if joint_map.closure is None:
        for k, (ratio, offset) in enumerate(zip(joint_map.ratio, joint_map.offset, strict=True)):
            if k not in joint_map.leaders:  # a joint that follows another is Pinocchio's mimic joint
                leader = int(joint_map.leaders[np.flatnonzero(ratio)[0]])
                pin_model = pin.transformJointIntoMimic(pin_model, leader + 1, k + 1, float(ratio.sum()), float(offset))
    support = pin_model.copy() if has_gravity and np.any(model.body_gravcomp) else None
    armature = model.dof_armature[joint_map.dof_adr]
    pin_model.armature = joint_map.ratio.T**2 @ armature if joint_map.closure is None else armature

    owners = last_joint_above(model, joints)
    for body, owner in enumerate(owners):
        if owner < 0 or not (model.body_mass[body] or model.body_inertia[body].any()):
            continue
        T_joint_inertia = frames[owner].actInv(_se3(data.xipos[body], data.ximat[body]))
        mass = model.body_mass[body]
        moments = model.body_inertia[body]
        pin_model.appendBodyToJoint(owner + 1, pin.Inertia(mass, np.zeros(3), np.diag(moments)), T_joint_inertia)
        if support is not None:
            lifted = pin.Inertia(mass * model.body_gravcomp[body], np.zeros(3), np.zeros((3, 3)))
            support.appendBodyToJoint(owner + 1, lifted, T_joint_inertia)

    placed = [_se3(data.xpos[each.body], data.xmat[each.body]) * _pinocchio_pose(each.T_body_tip) for each in tips]
    T_last_tip = frames[chain_length - 1].actInv(placed[0])
    tip_frame = pin_model.addFrame(pin.Frame("tip", chain_length, 0, T_last_tip, pin.FrameType.OP_FRAME))
    for tip, T_world_tip in zip(tips[1:], placed[1:], strict=True):
        owner = owners[tip.body]
        frame = pin.Frame(f"tip {tip.name}", owner + 1, 0, frames[owner].actInv(T_world_tip), pin.FrameType.OP_FRAME)
        pin_model.addFrame(frame)
    kind = PinocchioModel if joint_map.closure is None else ClosedPinocchioModel
    return kind(
        joint_map=joint_map,
        pin_model=pin_model,
        tip_frame=tip_frame,
        placements=frozen(np.array(placements[:chain_length])),
        is_slide=frozen(is_slide[:chain_length]),
        T_last_tip=frozen(T_last_tip.homogeneous),
        gravity_support=support,
    )


def _pinocchio_pose(T: Pose) -> pin.SE3:
    return pin.SE3(T.rotation, T.position)


def _se3(position: Array, rotation: Array) -> pin.SE3:
    return pin.SE3(rotation.reshape(3, 3).copy(), position.copy())
