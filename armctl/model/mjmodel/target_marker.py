"""The target marker: the body named "target", a green ball that shows where the tip should go and can be moved.

A model may have a body of this name itself; otherwise `armctl.load` adds one. An arm that was loaded from a compiled MjModel
can lack it, because a body cannot be added to a compiled model.
"""

import copy

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.pose import Pose
from armctl.core.validation import Array

TARGET = "target"
_COLOR = (0.0, 1.0, 0.0, 0.5)  # rgba
_RADIUS = 0.015  # m


def find_target(model: mujoco.MjModel) -> int | None:
    """The number of the target's body, or None if the model has none."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TARGET)
    return body if body >= 0 else None


def is_movable(model: mujoco.MjModel) -> bool:
    """Whether the model has a target that can be placed: a mocap body, which no joint moves."""
    return _mocap(model) is not None


def target_pose(model: mujoco.MjModel, data: mujoco.MjData) -> Pose:
    """T_world_target, as of the last forward kinematics of `data`; ModelError if the model has no target."""
    body = find_target(model)
    if body is None:
        raise ModelError(f"the model has no body named {TARGET!r}; load it from a file or an MjSpec, and armctl adds one")
    return Pose(data.xpos[body], quat=data.xquat[body])


def set_target(model: mujoco.MjModel, data: mujoco.MjData, position: Array, quat: Array | None = None) -> None:
    """Moves a target that can be placed, in a simulation's state: (3,) m in the world, and wxyz unless left out."""
    mocap = _mocap(model)
    if mocap is None:
        return
    data.mocap_pos[mocap] = position
    if quat is not None:
        data.mocap_quat[mocap] = quat


def read_target(model: mujoco.MjModel, data: mujoco.MjData) -> Pose:
    """T_world_target as a user has moved it, also before the next forward kinematics."""
    mocap = _mocap(model)
    if mocap is None:
        return target_pose(model, data)
    return Pose(data.mocap_pos[mocap], quat=data.mocap_quat[mocap])


def add_target(spec: mujoco.MjSpec) -> bool:
    """Adds a target to a specification that has none; returns whether it did."""
    if any(body.name == TARGET for body in spec.bodies):
        return False
    body = spec.worldbody.add_body(name=TARGET, mocap=True)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_RADIUS, 0, 0], rgba=_COLOR, contype=0, conaffinity=0, group=1)
    return True


def set_target_start(model: mujoco.MjModel, position: Array, before: Array | None = None) -> None:
    """Sets where a target at the world's origin, or at `before`, starts, (3,) m, in the model and in its keyframes."""
    body = find_target(model)
    mocap = _mocap(model)
    if body is None or mocap is None:
        return
    is_before = before is not None and np.array_equal(model.body_pos[body], before)
    if model.body_pos[body].any() and not is_before:
        return
    model.body_pos[body] = position
    if model.nkey:
        model.key_mpos[:, 3 * mocap : 3 * mocap + 3] = position


def _mocap(model: mujoco.MjModel) -> int | None:
    """The target's number among the mocap bodies, or None if it cannot be placed."""
    body = find_target(model)
    if body is None:
        return None
    mocap = int(model.body_mocapid[body])
    return mocap if mocap >= 0 else None


def without_marker(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a model in which the marker of the target is not drawn; a body of that name that is no marker stays."""
    hidden = copy.copy(model)
    if is_movable(model):
        body = find_target(model)
        hidden.geom_rgba[model.geom_bodyid == body, 3] = 0.0
        hidden.site_rgba[model.site_bodyid == body, 3] = 0.0
    return hidden
