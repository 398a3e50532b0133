"""Payload: a point mass that a body carries."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.arrays import Array


def add_point_mass(model: mujoco.MjModel, body: int, mass: float, point: Array) -> None:
    """Adds a point mass to a body, in place: parallel axes, then principal axes again. `mj_setConst` is the caller's.

    Args:
        model: The model to change.
        body: The body that carries it.
        mass: kg.
        point: (3,) m, where it is in the body's frame.
    """
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


def _forget_shortcuts(model: mujoco.MjModel, body: int) -> None:
    """What the compiler noted about a body's old inertial frame, to save work, is true no longer."""
    model.body_simple[body] = model.body_sameframe[body] = 0
    model.geom_sameframe[model.geom_bodyid == body] = 0
    model.site_sameframe[model.site_bodyid == body] = 0
    model.dof_simplenum[:] = 0


def _steiner(mass: float, r: Array) -> Array:
    return mass * (r @ r * np.eye(3) - np.outer(r, r))
