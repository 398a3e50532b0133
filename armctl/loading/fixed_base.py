"""Holding the base of a robot that floats or walks: its free joints are removed."""

from __future__ import annotations

import mujoco

from armctl.loading.home import keyframe_qpos
from armctl.mjmodel.queries import is_below, is_free, joint_actuators


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
