"""Plants of episodes: differences from the model that are drawn from ranges, and the dynamics in free space that they give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.validation import Array, instance, shown
from armctl.robot import dynamics_kernel as kernel
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Integrator
from armctl.sim.plant import Plant
from armctl.study.factors import Range

# What acts within a step of the environment; disturbances of signals are not simulated.
VARIABLE = ("payload", "mass_scale", "viscous_friction", "coulomb_friction")
FREE = VARIABLE[:3]


def read_ranges(randomize: Mapping[str, Range] | None, free_space: bool) -> dict[str, Range]:
    """Ranges of the attributes of a plant.

    Raises:
        InputError: It is no mapping, a value is no Range, or an attribute cannot vary.
        UnknownNameError: A plant has no such attribute.
    """
    instance("randomize", {} if randomize is None else randomize, Mapping, "{'payload': armctl.Range(0.0, 0.5)} is one")
    ranges = dict(randomize or {})
    allowed = FREE if free_space else VARIABLE
    for name, each in ranges.items():
        if name not in {field.name for field in fields(Plant)}:
            raise UnknownNameError.of("attribute of a Plant", f"{name!s:.80}", VARIABLE)
        if name not in allowed:
            raise InputError(f"randomize: {name} cannot vary{' in free space' if name in VARIABLE else ''}; {allowed} can")
        if not isinstance(each, Range):
            raise InputError(f"randomize: {name}: {shown(each)} is no Range; armctl.Range(0.0, 0.5) is one")
        plant_of({name: each.low})
    return ranges


def plant_of(values: dict[str, Any]) -> Plant:
    """A plant with these attributes."""
    return Plant(**values)


def draw_plant(ranges: Mapping[str, Range], rng: np.random.Generator) -> Plant | None:
    """A plant within ranges; None if there are none."""
    if not ranges:
        return None
    return plant_of({name: each.at(rng.random()) for name, each in ranges.items()})


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
