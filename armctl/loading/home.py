"""Where a model is at home: positions and controls from its keyframe `home`, or else from its ranges."""

import math

import mujoco

from armctl.core.validation import Array, frozen
from armctl.mjmodel.queries import Joints, is_below, is_free, joint_actuators, joint_range


def keyframe_qpos(model: mujoco.MjModel) -> Array:
    """(nq,) the whole model in its keyframe `home`, or in its first keyframe, or as it is drawn."""
    return model.key_qpos[_home_key(model)].copy() if model.nkey else model.qpos0.copy()


def home_qpos(model: mujoco.MjModel, joints: Joints) -> Array:
    """(nq,) the whole model with some joints at home: in the keyframe `home`, or else in the middle of their ranges.

    The joints are within their limits. The array is read-only.
    """
    qpos = keyframe_qpos(model)
    has_home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home") >= 0
    for joint in joints:
        address = model.jnt_qposadr[joint]
        low, high = joint_range(model, joint)
        if has_home or math.isinf(high - low):
            drawn = qpos[address] if has_home else model.qpos0[address]
            qpos[address] = min(max(drawn, low), high)
        else:
            qpos[address] = 0.5 * (low + high)
    return frozen(qpos)


def home_controls(model: mujoco.MjModel) -> Array:
    """(nctrl,) the controls of the whole model at home, read-only."""
    if model.nkey:
        return frozen(model.key_ctrl[_home_key(model)].copy())
    return frozen(mujoco.MjData(model).ctrl.copy())


def _home_key(model: mujoco.MjModel) -> int:
    return max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)


def remove_free_joints(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Removes the free joint of every body that carries actuated joints, in place; its keyframe says where it stays."""
    qpos = keyframe_qpos(model)
    actuated = [int(model.jnt_bodyid[joint]) for joint in joint_actuators(model)]
    joints = {j.id: j for j in spec.joints}
    bodies = {b.id: b for b in spec.bodies}
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
