"""Plant: how the real thing differs from the model that controllers use."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import IntArray, number, vector
from armctl.coupling import dofs_of_equality, dofs_of_tendon

_BRAKE = 1e8  # kg m^2 (kg): the armature of a joint that is held; it then moves less than rounding does


@dataclass(frozen=True, eq=False)
class Plant:
    """The simulated reality, as it departs from the model. The default departs in nothing.

    Attributes:
        payload: kg, a point mass held at the tip.
        payload_center: (3,) m, where it is, in the tip's frame.
        mass_scale: Factor on the masses and inertias of all moving links.
        timestep: s, the step and control period; None for the model's.
    """

    payload: float = 0.0
    payload_center: ArrayLike = (0.0, 0.0, 0.0)
    mass_scale: float = 1.0
    timestep: float | None = None

    def __post_init__(self) -> None:
        number("payload", self.payload, 0.0)
        number("mass_scale", self.mass_scale, 1e-3)
        object.__setattr__(self, "payload_center", vector("payload_center", self.payload_center, 3))
        if self.timestep is not None:
            number("timestep", self.timestep, 1e-6, 0.1)

    def model(self, arm: Arm) -> mujoco.MjModel:
        """The MuJoCo model of this plant.

        Args:
            arm: The arm as controllers know it.

        Returns:
            A model of one's own, with all joints outside the chain braked.
        """
        model = copy.copy(arm.model)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if self.timestep is not None:
            model.opt.timestep = self.timestep
        if self.mass_scale != 1.0:
            model.body_mass *= self.mass_scale
            model.body_inertia *= self.mass_scale
        if self.payload > 0.0:
            _add_point_mass(model, arm.tip_body, self.payload, arm.T_body_tip.transform(self.payload_center))
        mujoco.mj_setConst(model, mujoco.MjData(model))
        brake(model, held_dofs(arm))
        return model


def held_dofs(arm: Arm) -> IntArray:
    """The degrees of freedom of the robot that are not the arm's: fingers, other limbs, wheels.

    Args:
        arm: The arm.

    Returns:
        Their addresses in `MjData.qvel`. Free objects of the scene are not among them.
    """
    model = arm.model
    free = model.jnt_type[model.dof_jntid] == int(mujoco.mjtJoint.mjJNT_FREE)
    has_motor = np.zeros(model.nbody, bool)
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
            has_motor[model.body_rootid[model.jnt_bodyid[model.actuator_trnid[actuator, 0]]]] = True
    of_robot = has_motor[model.body_rootid[model.dof_bodyid]]
    return np.setdiff1d(np.flatnonzero(of_robot & ~free), arm.dof_adr)


def brake(model: mujoco.MjModel, dofs: IntArray) -> None:
    """Holds joints where they are, in place: so much armature that no force moves them, and no constraint among them.

    MuJoCo's solver takes its tolerance relative to the mean inertia of all joints, so that is scaled back to what it was.

    Args:
        model: The model to change.
        dofs: Addresses of the joints in `MjData.qvel`.
    """
    held = np.zeros(model.nv, bool)
    held[dofs] = True
    inertia = model.dof_M0 + model.dof_armature
    model.opt.tolerance *= inertia.mean() / (inertia + _BRAKE * held).mean()
    model.dof_armature[held] = _BRAKE
    model.dof_frictionloss[held] = 0.0
    model.jnt_limited[held[model.jnt_dofadr]] = 0
    for tendon in range(model.ntendon):
        if held[dofs_of_tendon(model, tendon)].all():
            model.tendon_limited[tendon] = 0
            model.tendon_frictionloss[tendon] = 0.0
    for equality in range(model.neq):
        if held[dofs_of_equality(model, equality)].all():
            model.eq_active0[equality] = 0


def _add_point_mass(model: mujoco.MjModel, body: int, mass: float, point: np.ndarray) -> None:
    """Adds a point mass to a body: parallel axes, then principal axes again."""
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
    model.body_inertia[body], model.body_iquat[body] = moments, quat
    _forget_shortcuts(model, body)


def _forget_shortcuts(model: mujoco.MjModel, body: int) -> None:
    """What the compiler noted about a body's old inertial frame, to save work, is true no longer."""
    model.body_simple[body] = model.body_sameframe[body] = 0
    model.geom_sameframe[model.geom_bodyid == body] = 0
    model.site_sameframe[model.site_bodyid == body] = 0
    model.dof_simplenum[:] = 0


def _steiner(mass: float, r: np.ndarray) -> np.ndarray:
    return mass * (r @ r * np.eye(3) - np.outer(r, r))
