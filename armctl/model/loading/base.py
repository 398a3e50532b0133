"""The base of a robot: held where its keyframe puts it, or moved by joints of its own."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, shown
from armctl.model.loading.home import keyframe_qpos
from armctl.model.mjmodel.queries import Joints, body_name, is_below, is_free, joint_actuators, object_id

_SLIDE = mujoco.mjtJoint.mjJNT_SLIDE
_HINGE = mujoco.mjtJoint.mjJNT_HINGE
_YES = mujoco.mjtLimited.mjLIMITED_TRUE
_NO = mujoco.mjtLimited.mjLIMITED_FALSE
_PITCH_RANGE = 1.4  # rad: at a quarter turn, yaw and roll turn about the same axis
# The joints of a base that moves, from the world on: name, kind and axis in the world. They are at zero at home.
BASE_JOINTS: dict[str, tuple[tuple[str, mujoco.mjtJoint, tuple[float, float, float]], ...]] = {
    "planar": (
        ("base x", _SLIDE, (1.0, 0.0, 0.0)),
        ("base y", _SLIDE, (0.0, 1.0, 0.0)),
        ("base yaw", _HINGE, (0.0, 0.0, 1.0)),
    ),
    "free": (
        ("base x", _SLIDE, (1.0, 0.0, 0.0)),
        ("base y", _SLIDE, (0.0, 1.0, 0.0)),
        ("base z", _SLIDE, (0.0, 0.0, 1.0)),
        ("base yaw", _HINGE, (0.0, 0.0, 1.0)),
        ("base pitch", _HINGE, (0.0, 1.0, 0.0)),
        ("base roll", _HINGE, (1.0, 0.0, 0.0)),
    ),
}


def hold_free_bases(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[mujoco.MjsBody]:
    """Removes the free joint of every body that carries actuated joints, in place; its keyframe says where it stays.

    Returns the bodies.
    """
    qpos = keyframe_qpos(model)
    actuated = [int(model.jnt_bodyid[joint]) for joint in joint_actuators(model)]
    joints = {j.id: j for j in spec.joints}
    bodies = {b.id: b for b in spec.bodies}
    held: list[mujoco.MjsBody] = []
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if not is_free(model, joint) or not any(is_below(model, other, body) for other in actuated):
            continue
        start = int(model.jnt_qposadr[joint])
        bodies[body].set_frame(spec.worldbody.add_frame())  # the keyframe's pose is in the world, whatever frame the file uses
        bodies[body].pos = qpos[start : start + 3]
        bodies[body].quat = qpos[start + 3 : start + 7]
        bodies[body].alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        spec.delete(joints[joint])
        held.append(bodies[body])
    return held


def add_base_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, kind: str, held: list[mujoco.MjsBody]) -> None:
    """Gives the robot's base joints and motors of its own, in place: "planar" or "free".

    The base is the body whose free joint was removed, or else that which stands on the world and carries actuated joints.
    """
    root = _root(spec, model, held)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, root.quat if root in held else data.xquat[root.id])
    to_body: Array = rotation.reshape(3, 3).T
    for name, joint_type, axis in BASE_JOINTS[kind]:
        # The defaults of the file are those of its own joints and motors.
        limits = {"range": [-_PITCH_RANGE, _PITCH_RANGE], "limited": _YES} if name == "base pitch" else {"limited": _NO}
        plain = {"armature": 0.0, "frictionloss": 0.0, "actfrclimited": _NO}
        joint = root.add_joint(name=name, type=joint_type, axis=to_body @ axis, **plain, **limits)
        joint.damping[:] = 0.0
        joint.stiffness[:] = 0.0
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=_NO, forcelimited=_NO)
    _insert_in_keyframes(spec, model, root.id, kind, root in held)


def _insert_in_keyframes(spec: mujoco.MjSpec, model: mujoco.MjModel, root: int, kind: str, is_held: bool) -> None:
    """Puts zeros for the base's joints into the keyframes, in the place of the free joint if there was one."""
    joints = [joint for joint in range(model.njnt) if model.jnt_bodyid[joint] >= root]
    start = int(model.jnt_qposadr[joints[0]])
    dof = int(model.jnt_dofadr[joints[0]])
    added = np.zeros(len(BASE_JOINTS[kind]))
    for row, key in enumerate(spec.keys):
        qpos = model.key_qpos[row]
        qvel = model.key_qvel[row]
        key.qpos = np.concatenate([qpos[:start], added, qpos[start + (7 if is_held else 0) :]])
        key.qvel = np.concatenate([qvel[:dof], added, qvel[dof + (6 if is_held else 0) :]])


def base_joints(model: mujoco.MjModel, kind: str | None) -> Joints:
    """The joints that `add_base_joints` gave the base, none if it is held."""
    return tuple(object_id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name, _, _ in BASE_JOINTS.get(kind or "", ()))


def _root(spec: mujoco.MjSpec, model: mujoco.MjModel, held: list[mujoco.MjsBody]) -> mujoco.MjsBody:
    bodies = {b.id: b for b in spec.bodies}
    moved = model.body_rootid[model.jnt_bodyid[list(joint_actuators(model))]]
    found = held or [bodies[root] for root in sorted(set(moved.tolist()))]
    names = " and ".join(shown(body.name or body_name(model, body.id)) for body in found)
    if len(found) != 1:
        raise ModelError(f"base: {names} stand on the world, and one base cannot move them all; put them on one body")
    if len(found[0].joints):
        raise ModelError(f"base: {names}, the first body, has joints of its own; put it on a body without joints")
    return found[0]
