"""Dynamics in free space of a plant that differs from the model."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array
from armctl.robot import dynamics_kernel as kernel
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Integrator
from armctl.sim.free_space import FreeSpace
from armctl.sim.plant import Plant


def free_motion(arm: Arm) -> FreeSpace:
    """The motion of an arm that touches nothing.

    Raises:
        InputError: The arm does not move freely, with the reason.
    """
    model = Plant(free_space=True).model(arm)
    return FreeSpace(arm, model, mujoco.MjData(model))


def moves_freely(arm: Arm) -> bool:
    """Whether an arm can be simulated in free space; one with dry friction or coupled joints cannot."""
    try:
        free_motion(arm)
    except InputError:
        return False
    return True


def plant_vector(arm: Arm, nominal: Array, plant: Plant) -> Array:
    """The dynamics of a plant in free space, from those of the model.

    Args:
        arm: The arm.
        nominal: The vector of `FreeSpace`.
        plant: What differs: payload, masses, viscous friction.

    Returns:
        A new vector.
    """
    vector = nominal.copy()
    joints = int(vector[kernel.JOINTS])
    end = kernel.HEADER + joints * kernel.JOINT_COLUMNS
    rows = vector[kernel.HEADER : end].reshape(joints, kernel.JOINT_COLUMNS)
    for first, last in ((kernel.MASS, kernel.MASS + 1), (kernel.INERTIA, kernel.INERTIA + 6)):
        rows[:, first:last] *= plant.mass_scale
    if plant.payload > 0.0:
        rotation = vector[kernel.TIP : kernel.TIP + 9].reshape(3, 3)
        place = vector[kernel.TIP + 9 : kernel.TIP + 12] + rotation @ np.asarray(plant.payload_center)
        _add_mass(rows[int(vector[kernel.CHAIN_LENGTH]) - 1], plant.payload, place)
    drives = vector[end : end + arm.n * kernel.DRIVE_COLUMNS].reshape(arm.n, kernel.DRIVE_COLUMNS)
    friction = np.asarray(plant.viscous_friction)
    drives[:, kernel.DAMPING] += friction
    if Integrator.of(arm.model).implicit_damping:
        drives[:, kernel.IMPLICIT_DAMPING] += friction
    return vector


def _add_mass(row: Array, mass: float, place: Array) -> None:
    """Adds a point mass (kg) at a place (3,) m to the row of a link: mass, center, inertia about the center."""
    before = float(row[kernel.MASS])
    center = row[kernel.CENTER : kernel.CENTER + 3]
    offset = place - center
    reduced = before * mass / (before + mass)
    x, y, z = offset
    inertia = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    row[kernel.INERTIA : kernel.INERTIA + 6] += reduced * np.array(inertia)
    center += offset * (mass / (before + mass))
    row[kernel.MASS] = before + mass
