"""The model of an arm for the compiled core."""

from typing import Any

import mujoco
import numpy as np

from armctl import _core
from armctl.core.errors import ModelError
from armctl.core.validation import Array
from armctl.robot.dynamics import Dynamics, Integrator
from armctl.robot.passive_forces import DryFriction, PassiveForces
from armctl.robot.pinocchio_model import PinocchioModel

# Of a (3, 3) inertia: xx yy zz xy xz yz.
_INERTIA_ROWS = [0, 1, 2, 0, 0, 1]
_INERTIA_COLUMNS = [0, 1, 2, 1, 2, 2]

_TOLERANCE = 1e-9  # relative, as between Pinocchio and MuJoCo
_CHECKED_STATES = 3


def model_arrays(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> dict[str, Any]:
    """The model of an arm as named arrays, the arguments of `_core.ArmModel`; arm_model.hpp explains them."""
    joint_map = pinocchio_model.joint_map
    pin_model = pinocchio_model.pin_model
    passive = PassiveForces(model, joint_map)
    friction = DryFriction.of(model, joint_map)
    integrator = Integrator.of(model)
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
        "ratio": joint_map.ratio,
        "armature": np.array(pin_model.armature),
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


def core_model(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> _core.ArmModel:
    """The model of an arm for the compiled core, in continuous time; `for_period` makes that of a control period.

    ModelError if the core's dynamics differ from Pinocchio's.
    """
    core = _core.ArmModel(**model_arrays(model, pinocchio_model))
    _check(core, Dynamics(model, pinocchio_model), pinocchio_model)
    return core


def tips(core: _core.ArmModel, q: Array) -> tuple[Array, Array]:
    """Positions (T, 3) m and rotation matrices (T, 3, 3) of the tip in the world at each row of q (T, n)."""
    positions = np.empty((len(q), 3))
    rotations = np.empty((len(q), 3, 3))
    _core.tips(core, np.ascontiguousarray(q), positions, rotations.reshape(-1, 9))
    return positions, rotations


def quaternions(rotations: Array) -> Array:
    """The unit quaternions (T, 4), wxyz with w >= 0, of rotation matrices (T, 3, 3)."""
    quats = np.empty((len(rotations), 4))
    _core.quaternions(rotations, quats)
    return quats


def _check(core: _core.ArmModel, dynamics: Dynamics, pinocchio_model: PinocchioModel) -> None:
    n = core.n
    tau = np.zeros(n)
    M = np.zeros((n, n))
    J = np.zeros((6, n))
    rng = np.random.default_rng(0)
    for _ in range(_CHECKED_STATES):
        q, v, a = rng.uniform(-1.0, 1.0, (3, n))
        _core.inverse_dynamics(core, q[None], v[None], a[None], tau[None])
        _core.mass_matrices(core, q[None], M.reshape(1, -1))
        _core.tip_jacobians(core, q[None], J.reshape(1, -1))
        pairs = {
            "inverse dynamics": (tau, dynamics.inverse_dynamics(q, v, a)),
            "mass matrix": (M, dynamics.mass_matrix(q)),
            "tip Jacobian": (J, pinocchio_model.jacobian(q)),
            "tip position": (tips(core, q[None])[0][0], pinocchio_model.tip(q)[0]),
        }
        for what, (result, reference) in pairs.items():
            error = float(np.abs(result - reference).max() / max(1.0, np.abs(reference).max()))
            if not error <= _TOLERANCE:
                raise ModelError(f"the core's {what} differs by {error:.2g} from Pinocchio's (at most {_TOLERANCE:g})")
