"""Dynamics in free space of plants that differ from the model."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array
from armctl.envs import difference_kernel as columns
from armctl.robot import dynamics_kernel as kernel
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Integrator
from armctl.sim.free_space import FreeSpace
from armctl.sim.plant import Plant


def moves_freely(arm: Arm) -> bool:
    """Whether an arm can be simulated in free space; one with dry friction or coupled joints cannot."""
    try:
        FreePlants(arm)
    except InputError:
        return False
    return True


class FreePlant(NamedTuple):
    """A plant in free space.

    Attributes:
        vector: Its dynamics, for `dynamics_kernel`.
        difference: (n, columns) how they differ from those of the model, for `difference_kernel`.
    """

    vector: Array
    difference: Array


class FreePlants:
    """Dynamics of an arm that touches nothing, and of plants that differ from its model.

    Attributes:
        nominal: The dynamics of the model, for `dynamics_kernel`.
        bounds: (2, n) N m, the least and the largest torque of the motors.
    """

    def __init__(self, arm: Arm):
        """The plants of an arm.

        Args:
            arm: The arm.

        Raises:
            InputError: The arm does not move freely, with the reason.
        """
        model = Plant(free_space=True).model(arm)
        free = FreeSpace(arm, model, mujoco.MjData(model))
        self.nominal = free.vector
        self.bounds = free.bounds
        self._n = arm.n
        self._drives = kernel.HEADER + arm.n * kernel.JOINT_COLUMNS
        self._last = int(self.nominal[kernel.CHAIN_LENGTH]) - 1
        self._tip_rotation = self.nominal[kernel.TIP : kernel.TIP + 9].reshape(3, 3)
        self._tip_position = self.nominal[kernel.TIP + 9 : kernel.TIP + 12]
        self._has_implicit_damping = Integrator.of(arm.model).implicit_damping
        # Mass, first moment and inertia about the joint's origin, in which the equations of motion are linear.
        self._linear = np.array([_about_joint(link) for link in self._links(self.nominal)])

    def of(self, plant: Plant) -> FreePlant:
        """A plant whose payload, masses and viscous friction differ from the model."""
        vector = self.nominal.copy()
        difference = np.zeros((self._n, columns.COLUMNS))
        linear = difference[:, columns.MASS : columns.DAMPING]
        if plant.mass_scale != 1.0:
            links = self._links(vector)
            for first, size in ((kernel.MASS, 1), (kernel.INERTIA, 6), (kernel.LIFTED_MASS, 1), (kernel.LIFTED_MOMENT, 3)):
                links[:, first : first + size] *= plant.mass_scale
            linear[:] = (plant.mass_scale - 1.0) * self._linear
        if plant.payload > 0.0:
            place = self._tip_position + self._tip_rotation @ np.asarray(plant.payload_center)
            _add_mass(self._links(vector)[self._last], plant.payload, place)
            linear[self._last] += [plant.payload, *(plant.payload * place), *_point_inertia(plant.payload, place)]
        difference[:, columns.DIFFERS] = linear.any(axis=1)
        friction = np.asarray(plant.viscous_friction)
        difference[:, columns.DAMPING] = friction
        drives = vector[self._drives : self._drives + self._n * kernel.DRIVE_COLUMNS].reshape(self._n, kernel.DRIVE_COLUMNS)
        drives[:, kernel.DAMPING] += friction
        if self._has_implicit_damping:
            difference[:, columns.IMPLICIT_DAMPING] = friction
            drives[:, kernel.IMPLICIT_DAMPING] += friction
        return FreePlant(vector, difference)

    def _links(self, vector: Array) -> Array:
        """(n, columns) the rows of the joints, a part of a vector."""
        return vector[kernel.HEADER : self._drives].reshape(self._n, kernel.JOINT_COLUMNS)


def _point_inertia(mass: float, place: Array) -> Array:
    """(6,) xx yy zz xy xz yz of a point mass (kg) at a place (3,) m, about the origin."""
    x, y, z = place.tolist()
    return mass * np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])


def _about_joint(link: Array) -> list[float]:
    """Mass, first moment and inertia of a link about its joint's origin."""
    mass = float(link[kernel.MASS])
    center = link[kernel.CENTER : kernel.CENTER + 3]
    inertia = link[kernel.INERTIA : kernel.INERTIA + 6] + _point_inertia(mass, center)
    return [mass, *(mass * center), *inertia]


def _add_mass(link: Array, mass: float, place: Array) -> None:
    """Adds a point mass (kg) at a place (3,) m to the row of a link: mass, center, inertia about the center."""
    before = float(link[kernel.MASS])
    center = link[kernel.CENTER : kernel.CENTER + 3]
    offset = place - center
    link[kernel.INERTIA : kernel.INERTIA + 6] += _point_inertia(before * mass / (before + mass), offset)
    center += offset * (mass / (before + mass))
    link[kernel.MASS] = before + mass
