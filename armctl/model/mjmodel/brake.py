"""brake: holds joints where they are, by a large armature."""

import mujoco
import numpy as np

from armctl.core.validation import IntArray
from armctl.model.mjmodel.couplings import dofs_of_equality, dofs_of_tendon

# Armature of a braked joint: forces of the arm then move it by less than the rounding error.
_BRAKE_INERTIA = 1e8  # kg m^2 (kg for a slide joint)
BRAKED_ARRAYS = ("dof_armature", "dof_frictionloss", "jnt_limited", "tendon_limited", "tendon_frictionloss", "eq_active0")


def brake(model: mujoco.MjModel, dofs: IntArray) -> None:
    """Brakes joints in place: a large armature, and no constraint that acts on braked joints alone.

    MuJoCo's solver takes its tolerance relative to the mean inertia of all joints, so the tolerance is scaled back.
    """
    held = np.zeros(model.nv, bool)
    if len(dofs):
        held[dofs] = True
        inertia = model.dof_M0 + model.dof_armature
        model.opt.tolerance *= inertia.mean() / (inertia + _BRAKE_INERTIA * held).mean()
        model.dof_armature[held] = _BRAKE_INERTIA
        model.dof_frictionloss[held] = 0.0
        model.jnt_limited[held[model.jnt_dofadr]] = 0
    for tendon in range(model.ntendon):
        if held[dofs_of_tendon(model, tendon)].all():
            model.tendon_limited[tendon] = 0
            model.tendon_frictionloss[tendon] = 0.0
    for equality in range(model.neq):
        if held[dofs_of_equality(model, equality)].all():
            model.eq_active0[equality] = 0
