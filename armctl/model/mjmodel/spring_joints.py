"""Spring joints: rotor, spring and link in series, an elastic joint."""

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.model.mjmodel.queries import SCALAR, joint_actuators, joints_above

_PARALLEL = 1e-6  # of the sine of the angle between two axes
_SETTLING_STEPS = 50
_SETTLED = 1e-9  # of the torque on the springs


def spring_joints(model: mujoco.MjModel) -> dict[int, int]:
    """The joints that are the spring of an elastic joint, and the joint of the motor before each.

    Such a joint has a spring and no actuator, and the joint before it has the same axis and an actuator.
    """
    driven = joint_actuators(model)
    tied = set(model.eq_obj1id[model.eq_type == mujoco.mjtEq.mjEQ_JOINT].tolist())
    candidates = [
        joint
        for joint in np.flatnonzero(model.jnt_stiffness > 0.0).tolist()
        if joint not in driven and joint not in tied and model.jnt_type[joint] in SCALAR
    ]
    if not candidates:
        return {}
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found: dict[int, int] = {}
    for joint in candidates:
        before = [j for j in joints_above(model, int(model.jnt_bodyid[joint])) if j < joint]
        if not before or before[-1] not in driven or model.jnt_type[before[-1]] != model.jnt_type[joint]:
            continue
        axes = data.xaxis[[before[-1], joint]]
        offset = np.cross(data.xanchor[joint] - data.xanchor[before[-1]], axes[0])
        is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        if np.linalg.norm(np.cross(*axes)) < _PARALLEL and (is_slide or np.linalg.norm(offset) < _PARALLEL):
            found[joint] = before[-1]
    return found


def settle_springs(model: mujoco.MjModel, data: mujoco.MjData, joints: list[int], motors: IntArray) -> None:
    """Moves spring joints to where gravity and their springs balance, and motors, by addresses in qpos, so that links stay."""
    positions = model.jnt_qposadr[joints]
    dofs = model.jnt_dofadr[joints]
    stiffness = model.jnt_stiffness[joints]
    for _ in range(_SETTLING_STEPS):
        mujoco.mj_forward(model, data)
        load: Array = data.qfrc_passive[dofs] - data.qfrc_bias[dofs]
        data.qpos[positions] += load / stiffness
        data.qpos[motors] -= load / stiffness
        if np.abs(load).max() <= _SETTLED * max(1.0, float(np.abs(data.qfrc_bias[dofs]).max())):
            return
