"""Checks of a model before it becomes an arm: what armctl refuses, and what it notes."""

import math
from collections.abc import Collection

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.note import Note
from armctl.core.validation import Array, shown
from armctl.model.arm.arm import Arm
from armctl.model.loading.catalog import arena_bytes
from armctl.model.mjmodel.couplings import LOOP_EQUALITIES, bodies_of_loop
from armctl.model.mjmodel.queries import body_name, joint_name, name_of

_CLOSED_M = 1e-6  # by which the two points of a closed loop may differ
_MAX_CONDITION = 1e15  # of the mass matrix; beyond it, no digit of an acceleration is right


def check_timestep(model: mujoco.MjModel) -> None:
    """Refuses a time step that is not a positive number."""
    timestep = float(model.opt.timestep)
    if not (math.isfinite(timestep) and timestep > 0.0):
        raise ModelError(f'the model\'s time step is {timestep:g} s; it must be above 0, as in <option timestep="0.002"/>')


def check_memory(model: mujoco.MjModel) -> None:
    """Refuses a compiled model in whose memory MuJoCo cannot search contacts among all bodies; it cannot get more."""
    needed = arena_bytes(model.nbody)
    if needed > model.narena and _overflows(model):
        raise ModelError(
            f"the model has {model.nbody} bodies and {model.narena / 1e6:.3g} MB of memory, too little to find their contacts; "
            f'write <size memory="{needed >> 20}M"/> into the file, or pass the MjSpec'
        )


def _overflows(model: mujoco.MjModel) -> bool:
    """Whether MuJoCo has too little memory for the contacts at the model's first state."""
    try:
        mujoco.mj_fwdPosition(model, mujoco.MjData(model))
    except mujoco.FatalError:
        return True
    return False


def check_joint_parameters(model: mujoco.MjModel) -> None:
    """Refuses a negative armature (the mass matrix could be indefinite) or dry friction (MuJoCo ignores it)."""
    for what, values, unit in (("armature", model.dof_armature, "kg m^2"), ("frictionloss", model.dof_frictionloss, "N m")):
        negative = np.flatnonzero(~(values >= 0.0))
        if len(negative):
            name = shown(joint_name(model, int(model.dof_jntid[negative[0]])))
            raise ModelError(
                f"the joint {name} has {what} {values[negative[0]]:g} {unit}; it must be at least 0; correct the model"
            )


def check_mass_matrix(arm: Arm) -> None:
    """Refuses an arm whose mass matrix at home is singular to working precision: its accelerations cannot be computed."""
    model = arm.model
    M = arm.mass_matrix(arm.home)
    condition = np.linalg.cond(M) if np.isfinite(M).all() else math.inf
    if not condition < _MAX_CONDITION:
        heaviest = int(np.argmax(model.body_mass))
        name = shown(body_name(model, heaviest))
        raise ModelError(
            f"{arm.name}: the mass matrix at home is singular (condition {condition:.2g}, at most {_MAX_CONDITION:g}); "
            f"check masses and inertias; the largest is {model.body_mass[heaviest]:.3g} kg of {name}"
        )


def open_loop_notes(model: mujoco.MjModel, qpos: Array, own: Collection[int]) -> list[str]:
    """A sentence for each connect or weld equality that is not closed at qpos (nq,).

    Left out are those that pull at a mocap body, and an arm's `own`, which are closed at its home.
    """
    active = [e for e in range(model.neq) if model.eq_active0[e] and e not in own]
    loops = [e for e in active if int(model.eq_type[e]) in LOOP_EQUALITIES]
    if not loops:
        return []
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    of_equality = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    notes = []
    for loop in loops:
        gap = float(np.abs(data.efc_pos[of_equality & (data.efc_id == loop)][:3]).max(initial=0.0))
        if gap > _CLOSED_M and not any(model.body_mocapid[body] >= 0 for body in bodies_of_loop(model, loop)):
            label = shown(name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, loop))
            notes.append(
                f"the loop of the equality {label} is open by {1e3 * gap:.3g} mm at home, and a simulation pulls it together"
            )
    return notes


def model_notes(model: mujoco.MjModel) -> list[str]:
    """A sentence each on the drag of air or water, and on joints whose range ends below its start, which is none to MuJoCo."""
    notes: list[str] = []
    option = model.opt
    if option.density or option.viscosity:
        wind = ", ".join(f"{x:g}" for x in option.wind)
        medium = f"density {option.density:g} kg/m^3, viscosity {option.viscosity:g} Pa s, wind [{wind}] m/s"
        text = f"drag ({medium}) acts in simulation, but controllers do not model it; density=0 viscosity=0 removes it"
        notes.append(Note(text, 'set density="0" viscosity="0" in <option>'))
    reversed_range = np.flatnonzero(model.jnt_range[:, 0] > model.jnt_range[:, 1])
    if len(reversed_range):
        names = ", ".join(joint_name(model, joint) for joint in reversed_range.tolist())
        text = f"the range of {names} ends below its start, so it counts as unlimited"
        notes.append(Note(text, "exchange the two ends of the range"))
    return notes
