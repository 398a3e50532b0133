"""Finding the serial chain in a compiled model: which joints make the arm, which actuator moves each, where the tip is."""

from __future__ import annotations

import re

import mujoco

from armctl.errors import ModelError, UnknownNameError
from armctl.pose import Pose

# As numbers: `numpy.int32(3) in (mjtJoint.mjJNT_HINGE,)` is False, although the two compare equal with ==.
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_CLOSES_LOOP = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_JAW = re.compile(r"jaw|grip|finger|claw|knuckle", re.IGNORECASE)
_JAW_BODY = re.compile(r"^(?!.*(fix|static|base)).*(jaw|finger|claw|moving)", re.IGNORECASE)
_TIP_NAMES = ("attachment", "tool", "tcp", "pinch", "grasp", "effector", "eef", "ee", "tip", "flange", "gripper")
_NO_TIP = re.compile(r"imu|cam|force|torque|sensor", re.IGNORECASE)

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


def joint_actuators(model: mujoco.MjModel) -> dict[int, int]:
    """Which actuator moves which hinge or slide joint, directly.

    Args:
        model: The compiled model.

    Returns:
        Joint to actuator; the first one, where several move the same joint.
    """
    found: dict[int, int] = {}
    for actuator in range(model.nu):
        joint = int(model.actuator_trnid[actuator, 0])
        if is_on_joint(model, actuator) and model.jnt_type[joint] in _SCALAR:
            found.setdefault(joint, actuator)
    return found


def is_on_joint(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator acts on one joint directly, not through a tendon, a site or a crank.

    Args:
        model: The compiled model.
        actuator: Its number.

    Returns:
        True if it does; `actuator_trnid[actuator, 0]` is then the joint.
    """
    return model.actuator_trntype[actuator] in _ON_JOINT


def find_chain(model: mujoco.MjModel) -> Chain:
    """The arm of a model that nobody described: its longest run of actuated joints from the base.

    The run ends before the fingers of a gripper part: at a body that carries several jointed branches with fewer joints behind
    it than before it, or at joints named like a jaw.

    Args:
        model: The compiled model.

    Returns:
        The joints from the base to the tip.

    Raises:
        ModelError: There is none, or several are equally long.
    """
    runs = {_without_jaw(model, _cut_at_fingers(model, run)) for run in _runs(model)}
    longest = max((len(run) for run in runs), default=0)
    if longest == 0:
        raise ModelError(_why_no_arm(model))
    best = sorted(run for run in runs if len(run) == longest)
    if len(best) > 1:
        tips = ", ".join(repr(find_tip(model, run)[0]) for run in best)
        raise ModelError(f"{len(best)} chains of {longest} joints start at the base; choose one with tip=: {tips}")
    check_chain(model, best[0])
    return best[0]


def chain_to(model: mujoco.MjModel, body: int) -> Chain:
    """All joints between the world and a body.

    Args:
        model: The compiled model.
        body: The body at the end.

    Returns:
        The joints from the base to the body.

    Raises:
        ModelError: One of them is no hinge or slide joint, has no actuator of its own, or is part of a loop.
    """
    actuated, joints = joint_actuators(model), _joints_above(model, body)
    for joint in joints:
        name = joint_name(model, joint)
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            raise ModelError(f"the base of {body_name(model, body)!r} is free (joint {name!r}), an arm needs a fixed one")
        if model.jnt_type[joint] not in _SCALAR:
            raise ModelError(f"joint {name!r} on the way to {body_name(model, body)!r} is a ball joint, not a hinge or slide")
        if joint not in actuated:
            raise ModelError(f"joint {name!r} on the way to {body_name(model, body)!r} has no actuator of its own")
    if not joints:
        raise ModelError(f"no joint moves {body_name(model, body)!r}, so it is the tip of no arm")
    check_chain(model, joints)
    return joints


def check_chain(model: mujoco.MjModel, joints: Chain) -> None:
    """Makes sure that each joint of a chain moves freely of all others.

    Args:
        model: The compiled model.
        joints: The chain.

    Raises:
        ModelError: An equality closes a loop over the chain or couples one of its joints, or a tendon spans one.
    """
    for equality in range(model.neq):
        if not model.eq_active0[equality]:
            continue
        kind, ends = model.eq_type[equality], (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
        name = name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality)
        if kind == mujoco.mjtEq.mjEQ_JOINT and set(ends) & set(joints):
            coupled = next(j for j in ends if j in joints)
            raise ModelError(f"joint {joint_name(model, coupled)!r} is coupled to another by the equality {name!r}")
        if kind in _CLOSES_LOOP:
            of_site = model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE
            bodies = [int(model.site_bodyid[i]) if of_site else i for i in ends]
            above = [set(_joints_above(model, body)) & set(joints) for body in bodies]
            if above[0] != above[1]:
                raise ModelError(
                    f"the equality {name!r} closes a loop over joint {joint_name(model, min(above[0] ^ above[1]))!r}"
                )
    for tendon in range(model.ntendon):
        for wrap in range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon]):
            joint = int(model.wrap_objid[wrap])
            if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT and joint in joints:
                name = name_of(model, mujoco.mjtObj.mjOBJ_TENDON, tendon)
                raise ModelError(f"joint {joint_name(model, joint)!r} is coupled to others by the tendon {name!r}")


def find_tip(model: mujoco.MjModel, joints: Chain) -> tuple[str, int, Pose]:
    """The tip of a chain: a site fixed behind its last joint that is named like one, or else the last body.

    Args:
        model: The compiled model.
        joints: The chain.

    Returns:
        The tip's name, the body that carries it, and its pose in that body.
    """
    bodies = _welded_behind(model, int(model.jnt_bodyid[joints[-1]]))
    sites = [s for s in range(model.nsite) if int(model.site_bodyid[s]) in bodies]
    names = {s: name_of(model, mujoco.mjtObj.mjOBJ_SITE, s) for s in sites}
    named = [s for wanted in _TIP_NAMES for s in sites if wanted in names[s].lower() and not _NO_TIP.search(names[s])]
    if named:
        return named_tip(model, names[named[0]])
    return body_name(model, bodies[-1]), bodies[-1], Pose([0.0, 0.0, 0.0])


def named_tip(model: mujoco.MjModel, name: str) -> tuple[str, int, Pose]:
    """The site, body or geom of a name, as a tip.

    Args:
        model: The compiled model.
        name: The name; a site is looked for first, then a body, then a geom.

    Returns:
        The tip's name, the body that carries it, and its pose in that body.

    Raises:
        UnknownNameError: There is none of that name.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        return name, int(model.site_bodyid[site]), Pose(model.site_pos[site], model.site_quat[site])
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return name, body, Pose([0.0, 0.0, 0.0])
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    if geom >= 0:
        return name, int(model.geom_bodyid[geom]), Pose(model.geom_pos[geom], model.geom_quat[geom])
    known = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
    raise UnknownNameError.of("site, body or geom", name, filter(None, known))


def _runs(model: mujoco.MjModel) -> set[Chain]:
    """The runs of actuated joints from the base to every body, as far as nothing interrupts them."""
    actuated = joint_actuators(model)
    run: list[Chain] = [()] * model.nbody
    blocked = [False] * model.nbody
    for body in range(1, model.nbody):
        parent, own = int(model.body_parentid[body]), _joints_of(model, body)
        blocked[body] = blocked[parent] or any(joint not in actuated for joint in own)
        run[body] = run[parent] if blocked[body] else run[parent] + own
    return {r for r in run if r}


def _cut_at_fingers(model: mujoco.MjModel, run: Chain) -> Chain:
    for before in range(1, len(run)):
        last, following = int(model.jnt_bodyid[run[before - 1]]), int(model.jnt_bodyid[run[before]])
        if last != following and len(run) - before < before and _branches(model, last) > 1:
            return run[:before]
    return run


def _without_jaw(model: mujoco.MjModel, run: Chain) -> Chain:
    actuated, end = joint_actuators(model), len(run)
    while end > 1 and _is_jaw(model, run[end - 1], actuated[run[end - 1]]):
        end -= 1
    return run[:end] if end > 1 else run


def _is_jaw(model: mujoco.MjModel, joint: int, actuator: int) -> bool:
    names = joint_name(model, joint), name_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)
    return any(map(_JAW.search, names)) or bool(_JAW_BODY.search(body_name(model, int(model.jnt_bodyid[joint]))))


def _branches(model: mujoco.MjModel, body: int) -> int:
    """How many jointed bodies hang on a body or on what is welded to it."""
    rigid = _welded_behind(model, body)
    return sum(1 for b in range(1, model.nbody) if model.body_parentid[b] in rigid and model.body_jntnum[b] and b not in rigid)


def _welded_behind(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and its descendants without a joint between, in the model's order."""
    rigid = [body]
    for b in range(body + 1, model.nbody):
        if model.body_parentid[b] in rigid and not model.body_jntnum[b]:
            rigid.append(b)
    return rigid


def _joints_of(model: mujoco.MjModel, body: int) -> Chain:
    first = int(model.body_jntadr[body])
    return tuple(range(first, first + int(model.body_jntnum[body])))


def _joints_above(model: mujoco.MjModel, body: int) -> Chain:
    joints: Chain = ()
    while body > 0:
        joints = _joints_of(model, body) + joints
        body = int(model.body_parentid[body])
    return joints


def _why_no_arm(model: mujoco.MjModel) -> str:
    if model.njnt == 0:
        return "no arm: the model has no joints"
    if not joint_actuators(model):
        return "no arm: no hinge or slide joint has an actuator; add one, such as <motor joint=...>, for each joint"
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    if free:
        return f"no arm: the base is free (joint {joint_name(model, free[0])!r}), an arm needs a fixed one"
    blocking = next(j for j in range(model.njnt) if j not in joint_actuators(model))
    return f"no arm: joint {joint_name(model, blocking)!r}, the first one from the base, has no actuator of its own"
