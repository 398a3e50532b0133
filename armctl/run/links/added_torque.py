"""AddedTorque: what a maker adds to the torques that a robot is sent."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.arm.passive_forces import DryFriction, PassiveForces
from armctl.run.links.torque_interface import TorqueInterface

_COMPENSATION_SPEED = 0.05  # rad/s (m/s), over which a compensation of dry friction turns: it must not push an arm at rest


class AddedTorque:
    """The torques of weight and friction that a robot adds by itself, by the model of an arm."""

    def __init__(self, arm: Arm, interface: TorqueInterface):
        self._arm = arm
        self._interface = interface
        self._passive = PassiveForces(arm.model, arm.joint_map)
        self._loss = np.array(DryFriction.from_model(arm.model, arm.joint_map).loss)

    def at(self, q: Array, v: Array) -> Array:
        """(n,) N m at q and v, (n,) rad and rad/s."""
        added = self._arm.gravity(q) if self._interface.adds_gravity else np.zeros(self._arm.n)
        if self._interface.adds_friction:
            added = added + self._passive.damping_torque(v) + self._loss * np.clip(v / _COMPENSATION_SPEED, -1.0, 1.0)
        return added
