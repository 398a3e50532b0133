"""Where a model is at home: positions and controls from its keyframe `home`, or else from its ranges."""

import math

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, frozen
from armctl.model.arm.joint_map import JointMap
from armctl.model.mjmodel.queries import (
    Joints,
    actuator_name,
    body_name,
    is_on_joint,
    joint_range,
)

_HOME = "home"
_POSITIONS = (7, 4, 1, 1)  # of a free, ball, slide and hinge joint: mjtJoint counts in this order


def keyframe_qpos(model: mujoco.MjModel) -> Array:
    """(nq,) the whole model in its keyframe `home`, or in its first keyframe, or as it is drawn.

    A part of the model that was attached under a prefix is in its own keyframe, such as `left/home`, where `home` does not
    say otherwise.
    """
    if not model.nkey:
        return model.qpos0.copy()
    qpos = model.key_qpos[max(_key(model, _HOME), 0)].copy()
    for joint, key in _own_keys(model).items():
        start = int(model.jnt_qposadr[joint])
        end = start + _POSITIONS[int(model.jnt_type[joint])]
        qpos[start:end] = model.key_qpos[key, start:end]
    return qpos


def home_qpos(model: mujoco.MjModel, joints: Joints) -> Array:
    """(nq,) the whole model with some joints at home: in the keyframe `home`, or else in the middle of their ranges.

    The joints are within their limits. The array is read-only.
    """
    qpos = keyframe_qpos(model)
    has_home = _key(model, _HOME) >= 0
    own_keys = _own_keys(model)
    for joint in joints:
        address = model.jnt_qposadr[joint]
        low, high = joint_range(model, joint)
        is_given = has_home or joint in own_keys
        if is_given or math.isinf(high - low):
            drawn = qpos[address] if is_given else model.qpos0[address]
            qpos[address] = min(max(drawn, low), high)
        else:
            qpos[address] = 0.5 * (low + high)
    return frozen(qpos)


def closed_home(model: mujoco.MjModel, joint_map: JointMap, limits: tuple[Array, Array], qpos: Array) -> Array:
    """(nq,) qpos with the joints of closed loops where they close: near qpos if possible, else near the loops' reference.

    `limits` (n,) each are those of the arm's joints. ModelError if the loops close at neither with all joints in their limits.
    """
    closure = joint_map.closure
    assert closure is not None
    reasons = []
    for q in (qpos[joint_map.qpos_adr[joint_map.leaders]], closure.arguments["reference_q"]):
        q = np.clip(q, *limits)
        _, reason = closure.first_refusal(q[None])
        if not reason:
            found = qpos.copy()
            joint_map.set_positions(found, q)
            return frozen(found)
        reasons.append(reason)
    raise ModelError(f"{reasons[0]}; write a keyframe 'home' in which the loop is closed")


def home_controls(model: mujoco.MjModel) -> Array:
    """(nctrl,) the controls of the whole model at home, read-only."""
    if not model.nkey:
        return frozen(mujoco.MjData(model).ctrl.copy())
    ctrl = model.key_ctrl[max(_key(model, _HOME), 0)].copy()
    moved_by_own_key = _own_keys(model)
    for actuator in range(model.nactuator):
        joint = int(model.actuator_trnid[actuator, 0]) if is_on_joint(model, actuator) else -1
        key = moved_by_own_key.get(joint, _own_key(model, actuator_name(model, actuator)) if joint < 0 else -1)
        if key >= 0:
            start = int(model.actuator_ctrladr[actuator])
            end = start + int(model.actuator_ctrlnum[actuator])
            ctrl[start:end] = model.key_ctrl[key, start:end]
    return frozen(ctrl)


def _own_keys(model: mujoco.MjModel) -> dict[int, int]:
    """The keyframe of each joint whose name has the prefix and suffix of one: `left/home` is that of `left/elbow`.

    Left out are joints that the keyframe `home` itself moves.
    """
    home = _key(model, _HOME)
    found: dict[int, int] = {}
    for joint in range(model.njnt):
        start = int(model.jnt_qposadr[joint])
        end = start + _POSITIONS[int(model.jnt_type[joint])]
        if home >= 0 and not np.array_equal(model.key_qpos[home, start:end], model.qpos0[start:end]):
            continue
        named = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        key = _own_key(model, named or body_name(model, int(model.jnt_bodyid[joint])))
        if key >= 0:
            found[joint] = key
    return found


def _own_key(model: mujoco.MjModel, name: str) -> int:
    """The keyframe with the longest prefix and suffix around "home" that a name has; -1 if there is none."""
    best = -1
    longest = 0
    for key in range(model.nkey):
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, key) or ""
        prefix, found, suffix = label.rpartition(_HOME)
        length = len(prefix) + len(suffix)
        if found and length > longest and name.startswith(prefix) and name.endswith(suffix):
            best = key
            longest = length
    return best


def _key(model: mujoco.MjModel, name: str) -> int:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name)
