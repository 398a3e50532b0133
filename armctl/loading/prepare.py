"""What armctl does to a model before it is an arm: bases held, a target, no contact between neighbours that overlap."""

from __future__ import annotations

import mujoco

from armctl.core.validation import Array, IntArray, frozen
from armctl.mjmodel.queries import Chain, is_below, joint_actuators
from armctl.robot.pinocchio_model import joint_above

TARGET = "target"
_GREEN = (0.0, 1.0, 0.0, 0.5)
_TARGET_RADIUS = 0.03


def hold_bases(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Takes the free joints off everything that has actuated joints, where its keyframe puts it, in place.

    Args:
        spec: The specification that `model` was compiled from.
        model: The compiled model.
    """
    qpos = home_qpos(model)
    moved = [int(model.jnt_bodyid[joint]) for joint in joint_actuators(model)]
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    joints, bodies = {j.id: j for j in spec.joints}, {b.id: b for b in spec.bodies}
    for joint in free:
        body = int(model.jnt_bodyid[joint])
        if not any(is_below(model, other, body) for other in moved):
            continue
        start = int(model.jnt_qposadr[joint])
        bodies[body].set_frame(spec.worldbody.add_frame())  # whatever frame the file put it in, its keyframe is in the world's
        bodies[body].pos, bodies[body].quat = qpos[start : start + 3], qpos[start + 3 : start + 7]
        bodies[body].alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        spec.delete(joints[joint])


def home_qpos(model: mujoco.MjModel) -> Array:
    """The whole model in its keyframe `home`, or in its first one, or as it is drawn.

    Args:
        model: The model.

    Returns:
        (nq,), the caller's own.
    """
    key = max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
    return model.key_qpos[key].copy() if model.nkey else model.qpos0.copy()


def rest_qpos(model: mujoco.MjModel, joints: Chain) -> Array:
    """The whole model with an arm at rest: the keyframe `home`, or without one the middle of the arm's ranges.

    Args:
        model: The model.
        joints: The chain.

    Returns:
        (nq,), read-only; the arm within its limits.
    """
    qpos, has_home = home_qpos(model), mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home") >= 0
    for joint in joints:
        address = model.jnt_qposadr[joint]
        if not model.jnt_limited[joint]:
            qpos[address] = qpos[address] if has_home else model.qpos0[address]
            continue
        low, high = model.jnt_range[joint]
        qpos[address] = min(max(qpos[address], low), high) if has_home else 0.5 * (low + high)
    return frozen(qpos)


def rest_ctrl(model: mujoco.MjModel, ctrl_adr: IntArray) -> Array:
    """The controls of the whole model at home, those of the arm's motors zero; zeroes these in the keyframes too.

    Keyframes hold joint angles where the motors now take torques.

    Args:
        model: The model.
        ctrl_adr: (n,) where the arm's motors are in `MjData.ctrl`.

    Returns:
        (nctrl,), read-only.
    """
    key = max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
    if model.nkey:
        model.key_ctrl[:, ctrl_adr] = 0.0
        return frozen(model.key_ctrl[key].copy())
    return frozen(mujoco.MjData(model).ctrl.copy())


def exclude_overlaps(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Chain) -> list[str]:
    """Takes off the contact of links that overlap their neighbour at home: it would brake the joint between them.

    MuJoCo leaves out contacts of a body with its parent, but not where the parent stands still in the world.

    Args:
        spec: The specification that `model` was compiled from, changed in place.
        model: The compiled model.
        joints: The chain.

    Returns:
        What was left out, one sentence each.
    """
    data, above = mujoco.MjData(model), joint_above(model, joints)
    data.qpos[:] = rest_qpos(model, joints)
    mujoco.mj_forward(model, data)
    pairs = {tuple(sorted(int(model.geom_bodyid[g]) for g in contact.geom)) for contact in data.contact if contact.dist < 0}
    notes = []
    for first, second in sorted(pairs):
        names = model.body(first).name, model.body(second).name
        if first > 0 and all(names) and abs(above[first] - above[second]) == 1:
            spec.add_exclude(bodyname1=names[0], bodyname2=names[1])
            notes.append(f"contact of {names[0]} with {names[1]} left out: neighbours that overlap at home")
    return notes


def backward(spec: mujoco.MjSpec) -> list[str]:
    """What to say of joints whose range MuJoCo takes for none.

    Args:
        spec: The specification.

    Returns:
        One sentence, or none.
    """
    names = ", ".join(joint.name for joint in spec.joints if joint.range[0] > joint.range[1])
    return [f"the range of {names} ends below its start, so it counts as unlimited"] if names else []


def drag(spec: mujoco.MjSpec) -> list[str]:
    """What to say where a model simulates the drag of air or water, which an arm's dynamics leave out.

    Args:
        spec: The specification.

    Returns:
        One sentence, or none.
    """
    option = spec.option
    if not (option.density or option.viscosity):
        return []
    wind = ", ".join(f"{x:g}" for x in option.wind)
    medium = f"density {option.density:g} kg/m^3, viscosity {option.viscosity:g} Pa s, wind [{wind}] m/s"
    return [f"drag ({medium}) acts in simulation, but no controller's model has it; density=0 viscosity=0 takes it off"]


def add_target(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Adds a green target that can be moved about, where the model has none of its own.

    Args:
        spec: The specification that `model` was compiled from, changed in place.
        model: The compiled model.
    """
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TARGET) >= 0:
        return
    body = spec.worldbody.add_body(name=TARGET, mocap=True)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_TARGET_RADIUS, 0, 0], rgba=_GREEN, contype=0, conaffinity=0, group=1
    )


def place_target(model: mujoco.MjModel, position: Array) -> None:
    """Puts a target that armctl added where it starts: within reach, and not where the tip is at home.

    Args:
        model: The model, changed in place.
        position: (3,) m.
    """
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TARGET)
    if model.body_mocapid[body] >= 0 and not model.body_pos[body].any():
        model.body_pos[body] = position
        if model.nkey:
            model.key_mpos[:, 3 * model.body_mocapid[body] : 3 * model.body_mocapid[body] + 3] = position
