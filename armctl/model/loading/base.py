"""The base of a robot: held where its keyframe puts it, or moved by joints of its own."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, shown
from armctl.model.loading.home import keyframe_qpos
from armctl.model.mjmodel.couplings import Couplings
from armctl.model.mjmodel.queries import SCALAR, Joints, body_name, is_below, is_free, joint_actuators, joints_of, object_id

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


@dataclass(frozen=True, eq=False)
class HeldBase:
    """A body whose joints to the world were removed."""

    body: mujoco.MjsBody
    positions: int  # how many positions and speeds the joints had
    speeds: int


def may_float(spec: mujoco.MjSpec) -> bool:
    """Whether a specification has a body that `hold_free_bases` could hold, so that it is worth compiling."""
    types = [joint.type for joint in spec.joints]
    if mujoco.mjtJoint.mjJNT_FREE in types:
        return True
    return types.count(_SLIDE) > 1 and any(sum(j.type == _SLIDE for j in body.joints) > 1 for body in spec.bodies)


def hold_free_bases(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[HeldBase]:
    """Removes the joints of every base that floats, or slides in a plane, in place; its keyframe says where it stays.

    Such a base carries actuated joints, and its own joints are a free one, or hinges and at least two slides that have neither
    motors nor limits, as those of planar walkers.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = keyframe_qpos(model)
    mujoco.mj_kinematics(model, data)
    actuated = [int(model.jnt_bodyid[joint]) for joint in joint_actuators(model)]
    couplings = Couplings(model)
    joints = {j.id: j for j in spec.joints}
    bodies = {b.id: b for b in spec.bodies}
    held: list[HeldBase] = []
    for body in range(1, model.nbody):
        own = joints_of(model, body)
        floats = bool(own) and (is_free(model, own[0]) or _slides_in_a_plane(couplings, body, own))
        if not floats or not any(is_below(model, other, body) for other in actuated):
            continue
        bodies[body].set_frame(spec.worldbody.add_frame())  # the keyframe's pose is in the world, whatever frame the file uses
        bodies[body].pos = data.xpos[body]
        bodies[body].quat = data.xquat[body]
        bodies[body].alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        for joint in own:
            spec.delete(joints[joint])
        is_free_base = is_free(model, own[0])
        held.append(HeldBase(bodies[body], positions=7 if is_free_base else len(own), speeds=6 if is_free_base else len(own)))
    return held


def _slides_in_a_plane(couplings: Couplings, body: int, own: Joints) -> bool:
    """Whether a body hangs on the world by slides and hinges that nothing drives, limits or couples."""
    model = couplings.model
    tendon_joints = model.wrap_objid[model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT].tolist()
    return (
        int(model.body_parentid[body]) == 0
        and sum(model.jnt_type[joint] == _SLIDE for joint in own) > 1
        and all(model.jnt_type[joint] in SCALAR and not model.jnt_limited[joint] for joint in own)
        and not set(own) & (joint_actuators(model).keys() | set(tendon_joints))
        and not any(couplings.reason(joint, frozenset([joint])) for joint in own)
    )


def add_base_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, kind: str, held: list[HeldBase]) -> None:
    """Gives the robot's base joints and motors of its own, in place: "planar" or "free".

    The base is the body that is held instead of floating, or else that which stands on the world and carries actuated joints.
    """
    root = _root(spec, model, held)
    removed = next((base for base in held if base.body == root), HeldBase(root, positions=0, speeds=0))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, root.quat if removed.positions else data.xquat[root.id])
    to_body: Array = rotation.reshape(3, 3).T
    for name, joint_type, axis in BASE_JOINTS[kind]:
        # The defaults of the file are those of its own joints and motors.
        limits = {"range": [-_PITCH_RANGE, _PITCH_RANGE], "limited": _YES} if name == "base pitch" else {"limited": _NO}
        plain = {"armature": 0.0, "frictionloss": 0.0, "actfrclimited": _NO}
        joint = root.add_joint(name=name, type=joint_type, axis=to_body @ axis, **plain, **limits)
        joint.damping[:] = 0.0
        joint.stiffness[:] = 0.0
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=_NO, forcelimited=_NO)
    _insert_in_keyframes(spec, model, kind, removed)


def _insert_in_keyframes(spec: mujoco.MjSpec, model: mujoco.MjModel, kind: str, base: HeldBase) -> None:
    """Puts zeros for the base's joints into the keyframes, in the place of its own if it had some."""
    joints = [joint for joint in range(model.njnt) if model.jnt_bodyid[joint] >= base.body.id]
    start = int(model.jnt_qposadr[joints[0]])
    dof = int(model.jnt_dofadr[joints[0]])
    added = np.zeros(len(BASE_JOINTS[kind]))
    for row, key in enumerate(spec.keys):
        qpos = model.key_qpos[row]
        qvel = model.key_qvel[row]
        key.qpos = np.concatenate([qpos[:start], added, qpos[start + base.positions :]])
        key.qvel = np.concatenate([qvel[:dof], added, qvel[dof + base.speeds :]])


def base_joints(model: mujoco.MjModel, kind: str | None) -> Joints:
    """The joints that `add_base_joints` gave the base, none if it is held."""
    return tuple(object_id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name, _, _ in BASE_JOINTS.get(kind or "", ()))


def _root(spec: mujoco.MjSpec, model: mujoco.MjModel, held: list[HeldBase]) -> mujoco.MjsBody:
    bodies = {b.id: b for b in spec.bodies}
    moved = model.body_rootid[model.jnt_bodyid[list(joint_actuators(model))]]
    found = [base.body for base in held] or [bodies[root] for root in sorted(set(moved.tolist()))]
    names = " and ".join(shown(body.name or body_name(model, body.id)) for body in found)
    if len(found) != 1:
        raise ModelError(f"base: {names} stand on the world, and one base cannot move them all; put them on one body")
    if len(found[0].joints):
        raise ModelError(f"base: {names}, the first body, has joints of its own; put it on a body without joints")
    return found[0]
