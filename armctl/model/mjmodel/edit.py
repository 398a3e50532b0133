"""Edits of models: a payload on a body, a body that can carry a payload, the options of another specification."""

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.model.mjmodel.queries import welded_behind


def copy_options(source: mujoco.MjSpec, target: mujoco.MjSpec) -> None:
    """Gives a specification the options of another one, to which it will be attached; MuJoCo keeps one set for both."""
    for name in (name for name in dir(source.option) if not name.startswith("_")):
        setattr(target.option, name, getattr(source.option, name))


def add_payload_bodies(spec: mujoco.MjSpec, model: mujoco.MjModel, bodies: dict[int, mujoco.MjsBody]) -> None:
    """Welds a body without mass to each of some bodies that MuJoCo lifts by `gravcomp`, in place.

    `gravcomp` would lift a payload in the same body as well.
    """
    for number, body in bodies.items():
        if payload_body(model, number) is None:
            name = f"payload of body {number}"
            body.add_body(name=name)
            spec.add_exclude(bodyname1=name, bodyname2="world")  # the compiler does not fuse a body that an exclude names


def payload_body(model: mujoco.MjModel, body: int) -> int | None:
    """The first of a body and those welded behind it that `gravcomp` does not lift; None if it lifts all."""
    return next((b for b in welded_behind(model, body) if not model.body_gravcomp[b]), None)


def add_payload(model: mujoco.MjModel, body: int, T_body_tip: Pose, mass: float, center: Array, inertia: Array) -> None:
    """Adds a rigid payload to a body, in place. The caller must call `mj_setConst` afterwards.

    `center` (3,) m and `inertia` (3, 3) kg m^2, about the center of mass, are in the axes of the tip. If MuJoCo lifts the
    body by `gravcomp`, a body welded to it carries the payload, which is not lifted.
    """
    T_carrier_tip = T_body_tip
    carrier = payload_body(model, body)
    if carrier is not None and carrier != body:
        T_carrier_tip = _pose_in(model, body, carrier) @ T_body_tip
        body = carrier
    turn = T_carrier_tip.rotation
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    rotation = rotation.reshape(3, 3)
    own_inertia = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
    own = pin.Inertia(float(model.body_mass[body]), model.body_ipos[body].copy(), own_inertia)
    total = own + pin.Inertia(mass, np.asarray(T_carrier_tip.transform(center), dtype=np.float64), turn @ inertia @ turn.T)
    set_body_inertia(model, body, total)


def set_body_inertia(model: mujoco.MjModel, body: int, inertia: pin.Inertia) -> None:
    """Sets the inertia of a body, given in the body's frame, in place. The caller must call `mj_setConst` afterwards."""
    moments, axes = np.linalg.eigh(inertia.inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    model.body_mass[body] = inertia.mass
    model.body_ipos[body] = inertia.lever
    model.body_inertia[body] = np.maximum(moments, 0.0)  # rounding can leave -1e-20 of a point mass
    model.body_iquat[body] = quat
    _clear_shortcuts(model, body)


def _pose_in(model: mujoco.MjModel, body: int, welded: int) -> Pose:
    """T_welded_body, of a body and one that is welded behind it."""
    pose = Pose([0.0, 0.0, 0.0])
    while welded != body:
        pose = Pose(model.body_pos[welded], model.body_quat[welded]) @ pose
        welded = int(model.body_parentid[welded])
    return pose.inverse()


def _clear_shortcuts(model: mujoco.MjModel, body: int) -> None:
    """Clears the compiler's flags for simple inertial frames, which are wrong after the frame has changed."""
    model.body_simple[body] = 0
    model.body_sameframe[body] = 0
    model.geom_sameframe[model.geom_bodyid == body] = 0
    model.site_sameframe[model.site_bodyid == body] = 0
    model.dof_simplenum[:] = 0
