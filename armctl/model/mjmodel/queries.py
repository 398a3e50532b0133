"""Queries of a compiled model: names, joints of a body, parents and descendants, actuators of joints."""

import math

import mujoco
import numpy as np

from armctl.core.errors import UnknownNameError
from armctl.core.validation import Array, BoolArray

# As numbers: `numpy.int32(3) in (mjtJoint.mjJNT_HINGE,)` is False, although the two compare equal with ==.
SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
LINEAR_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
LINEAR_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

DISABLES_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_MAX_CONTACTS = 64  # whose forces are read: more take longer than a control period
ACTUATOR_GROUPS = 31  # that options can disable
_UNLIMITED_TRAVEL_M = 1000.0  # of a sliding joint; no axis of a robot is that long

Joints = tuple[int, ...]


def name_of(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """The name of an element; for a nameless one its kind and number, such as "joint3" for the fourth joint."""
    return mujoco.mj_id2name(model, kind, index) or f"{kind.name.removeprefix('mjOBJ_').lower()}{index}"


def object_id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """The number of the object of a name; -1 if there is none."""
    try:
        return mujoco.mj_name2id(model, kind, name)
    except TypeError:  # of a text that no file can contain, such as "\ud800"
        return -1


def number_of(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """The number of a body or geom by what `name_of` calls it; -1 if there is none."""
    found = object_id(model, kind, name)
    count = model.nbody if kind == mujoco.mjtObj.mjOBJ_BODY else model.ngeom
    if found < 0 and name[-1:].isdecimal():
        return next((index for index in range(count) if name_of(model, kind, index) == name), -1)
    return found


def body_named(model: mujoco.MjModel, name: str) -> int:
    """The number of the body of a name; UnknownNameError if there is none."""
    body = object_id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        raise UnknownNameError.from_known("body", name, filter(None, (model.body(i).name for i in range(model.nbody))))
    return body


def placed(model: mujoco.MjModel, qpos: Array) -> mujoco.MjData:
    """A state of a model at positions (nq,), after forward kinematics."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """The name of a joint, or "joint3" for a nameless one."""
    return name_of(model, mujoco.mjtObj.mjOBJ_JOINT, joint)


def body_name(model: mujoco.MjModel, body: int) -> str:
    """The name of a body, or "body3" for a nameless one."""
    return name_of(model, mujoco.mjtObj.mjOBJ_BODY, body)


def geom_owner_name(model: mujoco.MjModel, geom: int) -> str:
    """The name of the body that a geom is on; for a geom of the world, its own."""
    body = int(model.geom_bodyid[geom])
    return body_name(model, body) if body else name_of(model, mujoco.mjtObj.mjOBJ_GEOM, geom)


def actuator_name(model: mujoco.MjModel, actuator: int) -> str:
    """The name of an actuator, or "actuator3" for a nameless one."""
    return name_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)


def is_on_joint(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator acts on one joint, `actuator_trnid[actuator, 0]`, and not on a tendon, a site or a crank."""
    return model.actuator_trntype[actuator] in _ON_JOINT


def is_damper(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator only resists motion: its force is a control times a speed, or it has no control."""
    if not model.actuator_ctrlnum[actuator]:
        return True
    affine = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_AFFINE
    return affine and not model.actuator_gainprm[actuator, :2].any() and not model.actuator_biasprm[actuator].any()


def is_powerless(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the force of an actuator is always zero, such as that of a servo whose gains are 0 in the file."""
    if not model.actuator_gear[actuator].any():
        return True
    is_linear = model.actuator_gaintype[actuator] in LINEAR_GAINS and model.actuator_biastype[actuator] in LINEAR_BIASES
    if not is_linear or model.actuator_plugin[actuator] >= 0:
        return False
    return not model.actuator_gainprm[actuator].any() and not model.actuator_biasprm[actuator].any()


def is_disabled(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the model's options disable the group of an actuator."""
    group = int(model.actuator_group[actuator])
    return 0 <= group < ACTUATOR_GROUPS and bool(model.opt.disableactuator >> group & 1)


def joint_actuators(model: mujoco.MjModel) -> dict[int, int]:
    """The actuator that acts directly on each hinge or slide joint; the first one, if several act on the same joint."""
    found: dict[int, int] = {}
    for actuator in range(model.nactuator):  # `nu` counts controls
        joint = int(model.actuator_trnid[actuator, 0])
        if is_on_joint(model, actuator) and model.jnt_type[joint] in SCALAR and not is_damper(model, actuator):
            found.setdefault(joint, actuator)
    return found


def joint_range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """The range of a joint, rad or m; infinite where it has no limit, or one that stands for "no limit".

    Files without a notation for an unlimited sliding joint write 999999 m; such a range would set the scale of every length.
    """
    if not model.jnt_limited[joint]:
        return -math.inf, math.inf
    low, high = model.jnt_range[joint].tolist()
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        low = low if low > -_UNLIMITED_TRAVEL_M else -math.inf
        high = high if high < _UNLIMITED_TRAVEL_M else math.inf
    return low, high


def is_free(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a free joint: its body floats."""
    return bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE)


def is_loose(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body floats, by itself or rigidly connected to one that does."""
    return any(is_free(model, joint) for joint in joints_of(model, int(model.body_weldid[body])))


def joints_of(model: mujoco.MjModel, body: int) -> Joints:
    first = int(model.body_jntadr[body])
    return tuple(range(first, first + int(model.body_jntnum[body])))


def joints_above(model: mujoco.MjModel, body: int, base: int = 0) -> Joints:
    """The joints between a body and another one above it, from that base on; the base's own joints are left out."""
    joints: Joints = ()
    while body > 0 and body != base:
        joints = joints_of(model, body) + joints
        body = int(model.body_parentid[body])
    return joints


def last_joint_above(model: mujoco.MjModel, joints: Joints) -> list[int]:
    """(nbody,) the position in `joints` of the last joint above each body, -1 if there is none."""
    last_on_body = {int(model.jnt_bodyid[j]): i for i, j in enumerate(joints)}
    owner = [-1] * model.nbody
    for body in range(1, model.nbody):
        owner[body] = last_on_body.get(body, owner[model.body_parentid[body]])
    return owner


def is_below(model: mujoco.MjModel, body: int, base: int) -> bool:
    """Whether a body is the base or a descendant of it; every body is below the world."""
    while body > base:
        body = int(model.body_parentid[body])
    return body == base


def stands_alone(model: mujoco.MjModel, body: int, link: int) -> bool:
    """Whether a body is fixed, and not a part of the robot that carries a link."""
    return bool(model.body_weldid[body] == 0 and (body == 0 or not is_below(model, link, body)))


def colliding_geoms(model: mujoco.MjModel) -> BoolArray:
    """(ngeom,) which geoms are a shape against obstacles: those whose bits let them collide, if the model has contacts."""
    if model.opt.disableflags & DISABLES_CONTACTS:
        return np.zeros(model.ngeom, bool)
    return (model.geom_contype != 0) | (model.geom_conaffinity != 0)


def robot_roots(model: mujoco.MjModel, joints: Joints) -> set[int]:
    """The bodies in the world on which the robot of some joints stands: all below them is the robot."""
    return {int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in joints}


def has_obstacles(model: mujoco.MjModel, joints: Joints) -> bool:
    """Whether anything that is not the robot of some joints could be touched."""
    owners = model.body_rootid[model.geom_bodyid[colliding_geoms(model)]]
    return bool(set(owners.tolist()) - robot_roots(model, joints))


def welded_behind(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and its descendants without a joint between, in the model's order."""
    rigid = [body]
    for b in range(body + 1, model.nbody):
        if model.body_parentid[b] in rigid and not model.body_jntnum[b]:
            rigid.append(b)
    return rigid


def branch_counts(model: mujoco.MjModel) -> list[int]:
    """(nbody,) the length of `branches` for every body that has joints of its own, in one pass."""
    root = [0] * model.nbody  # of the welded piece that each body belongs to
    counts = [0] * model.nbody
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        if model.body_jntnum[body]:
            root[body] = body
            counts[root[parent]] += 1
        else:
            root[body] = root[parent]
    return counts


def branches(model: mujoco.MjModel, body: int) -> list[int]:
    """The jointed bodies that are attached to a body, or to a body welded to it."""
    rigid = welded_behind(model, body)
    return [b for b in range(1, model.nbody) if model.body_parentid[b] in rigid and model.body_jntnum[b] and b not in rigid]


def acts(contact: mujoco.MjContact) -> bool:
    """Whether a contact acts: its geoms are within their margins, which are often zero; others are only detected."""
    return bool(contact.dist < contact.includemargin)


def contact_forces(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """(k, 2, 3) where two geoms press on each other, m, and the force on the second, N, in world axes: the first 64."""
    count = min(data.ncon, _MAX_CONTACTS)
    forces = np.zeros((count, 2, 3))
    wrench = np.zeros(6)
    for i in range(count):
        mujoco.mj_contactForce(model, data, i, wrench)
        contact = data.contact[i]
        forces[i, 0] = contact.pos
        forces[i, 1] = contact.frame.reshape(3, 3).T @ wrench[:3]
    return forces[np.linalg.norm(forces[:, 1], axis=1) > 0.0]
