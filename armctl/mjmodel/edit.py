"""Payload: a point mass that a body carries."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.mjmodel.queries import welded_behind


def add_bearers(spec: mujoco.MjSpec, model: mujoco.MjModel, bodies: dict[int, mujoco.MjsBody]) -> None:
    """Welds a body without mass to each one that MuJoCo lifts by `gravcomp`, which would lift a payload with it, in place.

    Args:
        spec: The specification that `model` was compiled from.
        model: The compiled model.
        bodies: The bodies that may carry a payload, by their numbers in `model`.
    """
    for number, body in bodies.items():
        if _bearer(model, number) is None:
            name = f"payload of body {number}"
            body.add_body(name=name)
            spec.add_exclude(bodyname1=name, bodyname2="world")  # what is referred to is not fused with what it is welded to


def add_point_mass(model: mujoco.MjModel, body: int, mass: float, point: Array) -> None:
    """Adds a point mass to a body, in place: parallel axes, then principal axes again. `mj_setConst` is the caller's.

    Where MuJoCo lifts the body by `gravcomp`, a body welded to it carries the mass, which is not lifted.

    Args:
        model: The model to change.
        body: The body that carries it.
        mass: kg.
        point: (3,) m, where it is in the body's frame.
    """
    bearer = _bearer(model, body)
    if bearer is not None:
        point, body = _from(model, body, bearer).transform(point), bearer
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[body])
    R = R.reshape(3, 3)
    m, c = float(model.body_mass[body]), model.body_ipos[body].copy()
    total = m + mass
    center = (m * c + mass * point) / total
    inertia = R @ np.diag(model.body_inertia[body]) @ R.T + _steiner(m, c - center) + _steiner(mass, point - center)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    model.body_mass[body], model.body_ipos[body] = total, center
    model.body_inertia[body], model.body_iquat[body] = np.maximum(moments, 0.0), quat  # rounding can leave -1e-20 of a point
    _forget_shortcuts(model, body)


def _bearer(model: mujoco.MjModel, body: int) -> int | None:
    """The first of a body and those welded behind it that nothing lifts."""
    return next((b for b in welded_behind(model, body) if not model.body_gravcomp[b]), None)


def _from(model: mujoco.MjModel, body: int, welded: int) -> Pose:
    """T_welded_body."""
    pose = Pose([0.0, 0.0, 0.0])
    while welded != body:
        pose = Pose(model.body_pos[welded], model.body_quat[welded]) @ pose
        welded = int(model.body_parentid[welded])
    return pose.inverse()


def _forget_shortcuts(model: mujoco.MjModel, body: int) -> None:
    """What the compiler noted about a body's old inertial frame, to save work, is true no longer."""
    model.body_simple[body] = model.body_sameframe[body] = 0
    model.geom_sameframe[model.geom_bodyid == body] = 0
    model.site_sameframe[model.site_bodyid == body] = 0
    model.dof_simplenum[:] = 0


def _steiner(mass: float, r: Array) -> Array:
    return mass * (r @ r * np.eye(3) - np.outer(r, r))
