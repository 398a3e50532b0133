"""Parity: an arm's Pinocchio model compared with MuJoCo."""

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.errors import ModelError
from armctl.core.pose import computed_pose
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.arm.dynamics import make_dynamics

PARITY_TOLERANCE = 1e-9


def check_parity(arm: Arm, samples: int = 3, seed: int = 0) -> float:
    """Compares tip pose, mass matrix and bias of an arm's Pinocchio model with MuJoCo's, at home and at random states.

    Returns the largest difference, relative to the magnitude of what is compared (at least 1). ModelError if it is above 1e-9.
    """
    rng = np.random.default_rng(seed)
    scratch = arm.pinocchio_model.scratch
    worst = 0.0
    closure = arm.joint_map.closure
    for q in (arm.home, *arm.limits.random(arm.home, samples, rng)):
        if closure is not None:
            q = closure.near_reference(q - arm.home)
        v = rng.uniform(-1, 1, arm.n)
        for what, error in _differences(arm, scratch, q, v).items():
            if not error <= PARITY_TOLERANCE:
                raise ModelError(
                    f"{arm.name:.80}: the {what} of the Pinocchio model differs by {error:.2g} from MuJoCo's "
                    f"(at most {PARITY_TOLERANCE:g})"
                )
            worst = max(worst, error)
    return worst


def _differences(arm: Arm, scratch: pin.Data, q: Array, v: Array) -> dict[str, float]:
    """The relative difference of each quantity in one state."""
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(q)
    data.qvel[:] = arm.qvel(v, q)
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    T_world_body = computed_pose(data.xpos[arm.tip_body], data.xmat[arm.tip_body].reshape(3, 3))
    T_world_tip = T_world_body @ arm.T_body_tip

    pin_model = arm.pinocchio_model.pin_model
    position, rotation = arm.pinocchio_model.tip(q)
    closure = arm.joint_map.closure
    moving = data.qfrc_bias
    if closure is None:
        M = pin.crba(pin_model, scratch, q, pin.Convention.WORLD)  # LOCAL adds mimic joints to what the last call left
        bias = pin.nonLinearEffects(pin_model, scratch, q, v)
    else:
        dynamics = make_dynamics(model, arm.pinocchio_model)
        M = dynamics.mass_matrix(q)
        bias = dynamics.bias(q, v)
        moving = moving + full[:, arm.joint_map.dof_adr] @ closure.acceleration(q, v)
    return {
        "tip position": _relative(position, T_world_tip.position),
        "tip orientation": _relative(rotation, T_world_tip.rotation),
        "mass matrix": _relative(np.triu(M), np.triu(arm.joint_map.reduced_matrix(full, q))),
        "bias": _relative(bias, arm.joint_map.reduced(moving, q)),
    }


def _relative(value: Array, reference: Array) -> float:
    return float(np.abs(value - reference).max() / max(1.0, np.abs(reference).max()))
