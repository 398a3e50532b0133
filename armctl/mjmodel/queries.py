"""The parts of a compiled model by name and by kinship: joints, bodies, what moves them and what hangs on them."""

from __future__ import annotations

import mujoco

# As numbers: `numpy.int32(3) in (mjtJoint.mjJNT_HINGE,)` is False, although the two compare equal with ==.
SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

Chain = tuple[int, ...]


def name_of(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """The name of an element, or its kind and number where it has none.

    Args:
        model: The compiled model.
        kind: Which kind of element.
        index: Its number.

    Returns:
        A name fit for an error message.
    """
    return mujoco.mj_id2name(model, kind, index) or f"{kind.name.removeprefix('mjOBJ_').lower()}{index}"


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """The name of a joint.

    Args:
        model: The compiled model.
        joint: Its number.

    Returns:
        Its name, or "joint3" for the nameless fourth.
    """
    return name_of(model, mujoco.mjtObj.mjOBJ_JOINT, joint)


def body_name(model: mujoco.MjModel, body: int) -> str:
    """The name of a body.

    Args:
        model: The compiled model.
        body: Its number.

    Returns:
        Its name, or "body3" for the nameless fourth.
    """
    return name_of(model, mujoco.mjtObj.mjOBJ_BODY, body)


def actuator_name(model: mujoco.MjModel, actuator: int) -> str:
    """The name of an actuator.

    Args:
        model: The compiled model.
        actuator: Its number.

    Returns:
        Its name, or "actuator3" for the nameless fourth.
    """
    return name_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)


def is_on_joint(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator acts on one joint directly, not through a tendon, a site or a crank.

    Args:
        model: The compiled model.
        actuator: Its number.

    Returns:
        True if it does; `actuator_trnid[actuator, 0]` is then the joint.
    """
    return model.actuator_trntype[actuator] in _ON_JOINT


def is_damper(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator only resists motion: its force is a control times a speed, and nothing else.

    Args:
        model: The compiled model.
        actuator: Its number.

    Returns:
        True if it does.
    """
    affine = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_AFFINE
    return affine and not model.actuator_gainprm[actuator, :2].any() and not model.actuator_biasprm[actuator].any()


def joint_actuators(model: mujoco.MjModel) -> dict[int, int]:
    """Which actuator moves which hinge or slide joint, directly.

    Args:
        model: The compiled model.

    Returns:
        Joint to actuator; the first one that can drive it, where several act on the same joint.
    """
    found: dict[int, int] = {}
    for actuator in range(model.nu):
        joint = int(model.actuator_trnid[actuator, 0])
        if is_on_joint(model, actuator) and model.jnt_type[joint] in SCALAR and not is_damper(model, actuator):
            found.setdefault(joint, actuator)
    return found


def joints_of(model: mujoco.MjModel, body: int) -> Chain:
    """The joints between a body and its parent.

    Args:
        model: The compiled model.
        body: Its number.

    Returns:
        The joints, in order.
    """
    first = int(model.body_jntadr[body])
    return tuple(range(first, first + int(model.body_jntnum[body])))


def joints_above(model: mujoco.MjModel, body: int, base: int = 0) -> Chain:
    """The joints between a body and another further up.

    Args:
        model: The compiled model.
        body: Its number.
        base: The body to stop at, whose own joints are left out; the world if left out.

    Returns:
        The joints, from the base on.
    """
    joints: Chain = ()
    while body > 0 and body != base:
        joints = joints_of(model, body) + joints
        body = int(model.body_parentid[body])
    return joints


def is_below(model: mujoco.MjModel, body: int, base: int) -> bool:
    """Whether a body is another or hangs on it.

    Args:
        model: The compiled model.
        body: The number of the one.
        base: The number of the other.

    Returns:
        True if it is; everything is below the world.
    """
    while body > base:
        body = int(model.body_parentid[body])
    return body == base


def welded_behind(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and its descendants without a joint between.

    Args:
        model: The compiled model.
        body: Its number.

    Returns:
        Their numbers, in the model's order.
    """
    rigid = [body]
    for b in range(body + 1, model.nbody):
        if model.body_parentid[b] in rigid and not model.body_jntnum[b]:
            rigid.append(b)
    return rigid


def branches(model: mujoco.MjModel, body: int) -> list[int]:
    """The jointed bodies that hang on a body, or on what is welded to it.

    Args:
        model: The compiled model.
        body: Its number.

    Returns:
        Their numbers.
    """
    rigid = welded_behind(model, body)
    return [b for b in range(1, model.nbody) if model.body_parentid[b] in rigid and model.body_jntnum[b] and b not in rigid]
