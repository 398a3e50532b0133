"""The model of an arm for the compiled core."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from armctl import _core
from armctl.core.validation import Array
from armctl.model.arm.joint_map import JointMap
from armctl.model.arm.passive_forces import DryFriction, PassiveForces, PassiveJoints, is_enabled
from armctl.model.arm.pinocchio_model import PinocchioModel

# Of a (3, 3) inertia: xx yy zz xy xz yz.
_INERTIA_ROWS = [0, 1, 2, 0, 0, 1]
_INERTIA_COLUMNS = [0, 1, 2, 1, 2, 2]


@dataclass(frozen=True, slots=True, eq=False)
class Integrator:
    """Which forces MuJoCo's integrator evaluates at the velocity at the end of a step.

    Source: MuJoCo documentation, Computation, "Numerical integration".
    """

    implicit_damping: bool  # joint damping: Euler (unless `eulerdamp` is disabled), implicitfast and implicit
    implicit_coriolis: bool  # coriolis and centrifugal forces: implicit

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> Integrator:
        kind = mujoco.mjtIntegrator(model.opt.integrator)
        euler_damp = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        explicit_euler = kind == mujoco.mjtIntegrator.mjINT_EULER and not euler_damp
        return cls(
            implicit_damping=kind != mujoco.mjtIntegrator.mjINT_RK4 and not explicit_euler,
            implicit_coriolis=kind == mujoco.mjtIntegrator.mjINT_IMPLICIT,
        )


def model_arrays(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> dict[str, Any]:
    """The model of an arm as named arrays, the arguments of `_core.ArmModel`; arm_model.hpp explains them."""
    joint_map = pinocchio_model.joint_map
    pin_model = pinocchio_model.pin_model
    passive = PassiveForces(model, joint_map)
    friction = DryFriction.from_model(model, joint_map)
    integrator = Integrator.from_model(model)
    # Joint 0 of Pinocchio is the world.
    placements = pin_model.jointPlacements[1:]
    bodies = pin_model.inertias[1:]
    m = len(joint_map.joints)
    lifted_masses = np.zeros(m)
    lifted_moments = np.zeros((m, 3))
    if pinocchio_model.gravity_support is not None:
        lifted = pinocchio_model.gravity_support.inertias[1:]
        lifted_masses = np.array([body.mass for body in lifted])
        lifted_moments = np.array([body.mass * body.lever for body in lifted])
    slides = model.jnt_type[list(joint_map.joints)] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return {
        "rotations": np.array([placement.rotation for placement in placements]),
        "translations": np.array([placement.translation for placement in placements]),
        "slides": slides.astype(np.int64),
        "parents": np.array(pin_model.parents[1:], dtype=np.int64) - 1,
        "masses": np.array([body.mass for body in bodies]),
        "centers": np.array([body.lever for body in bodies]),
        "inertias": np.array([body.inertia[_INERTIA_ROWS, _INERTIA_COLUMNS] for body in bodies]),
        "lifted_masses": lifted_masses,
        "lifted_moments": lifted_moments,
        "stiffness": np.ascontiguousarray(passive.stiffness),
        "spring_rest": passive.rest,
        "offsets": joint_map.offset,
        "ratio": joint_map.fixed_ratio,
        "armature": np.array(pin_model.armature) if joint_map.closure is None else _driven_armature(model, joint_map),
        "damping": np.column_stack([passive.damping, passive.quadratic_damping, passive.cubic_damping]),
        "friction_loss": friction.loss,
        "friction_gain": friction.gain,
        "friction_rate": friction.rate,
        "chain_length": pinocchio_model.chain_length,
        "gravity": np.array(pin_model.gravity.linear),
        "tip_rotation": np.ascontiguousarray(pinocchio_model.T_last_tip[:3, :3]),
        "tip_translation": np.ascontiguousarray(pinocchio_model.T_last_tip[:3, 3]),
        "implicit_damping": integrator.implicit_damping,
        "implicit_coriolis": integrator.implicit_coriolis,
    }


def _driven_armature(model: mujoco.MjModel, joint_map: JointMap) -> Array:
    """(n,) kg m^2, of the driven joints of an arm with closed loops and of those that follow them at fixed ratios."""
    return joint_map.fixed_ratio.T**2 @ model.dof_armature[joint_map.dof_adr]


def make_core_model(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> _core.ArmModel:
    """The model of an arm for the compiled core, in continuous time."""
    core = _core.ArmModel(**model_arrays(model, pinocchio_model))
    closure = pinocchio_model.joint_map.closure
    if closure is None:
        return core
    passive = PassiveJoints(model, pinocchio_model.joint_map)
    friction = np.column_stack([passive.friction.loss, passive.friction.gain, passive.friction.rate])
    return core.with_loops(closure.core, np.ascontiguousarray(passive.damping), friction, passive.armature)


def tips(core: _core.ArmModel, q: Array) -> tuple[Array, Array]:
    """Positions (T, 3) m and rotation matrices (T, 3, 3) of the tip in the world at each row of q (T, n)."""
    positions = np.empty((len(q), 3))
    rotations = np.empty((len(q), 3, 3))
    _core.tips(core, np.ascontiguousarray(q), positions, rotations.reshape(-1, 9))
    return positions, rotations


def frames(core: _core.ArmModel, q: Array, joint: int, placement: Array) -> tuple[Array, Array]:
    """As `tips`, of a frame that a joint carries (-1: the world) at a placement (12,) in it."""
    positions = np.empty((len(q), 3))
    rotations = np.empty((len(q), 3, 3))
    _core.frames(core, np.ascontiguousarray(q), joint, placement, positions, rotations.reshape(-1, 9))
    return positions, rotations


def inverse_dynamics(core: _core.ArmModel, q: Array, v: Array, a: Array) -> Array:
    """The torques at many states, each (T, n), without dry friction."""
    tau = np.empty(q.shape)
    _core.inverse_dynamics(core, np.ascontiguousarray(q), np.ascontiguousarray(v), np.ascontiguousarray(a), tau)
    return tau


def quaternions(rotations: Array) -> Array:
    """The unit quaternions (T, 4), wxyz with w >= 0, of rotation matrices (T, 3, 3)."""
    quats = np.empty((len(rotations), 4))
    _core.quaternions(rotations, quats)
    return quats
