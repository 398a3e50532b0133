"""HandGuiding: the arm floats, and a hand moves it."""

from __future__ import annotations

import numpy as np

from armctl.control.interface import State
from armctl.core.faces import face
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.passive_forces import DryFriction, PassiveForces

_FRICTION_SPEED = 0.05  # rad/s (m/s), over which the compensation of dry friction turns: it must not push an arm at rest
_BRAKED_SPEED_SHARE = 0.5  # of the limit: above it the arm brakes
_RANGE_SHARE = 0.1  # of a joint's range, at both ends, with springs
_MAX_RANGE_MARGIN = 0.2  # rad (m)
_TORQUE_SHARE = 0.3  # of the limit, that springs and brakes reach


class HandGuiding:
    """Gravity and most of the friction are compensated, so a hand can move the arm; near limits it resists."""

    name = "hand-guiding"
    yields = True

    def __init__(self, arm: Arm, friction_share: float = 0.7):
        """A floating arm.

        Args:
            arm: The model; that of `ArmEstimate.applied_to` if the arm was identified.
            friction_share: The share of friction that is compensated, in [0, 0.95]; below 1, so that the arm comes to rest.
        """
        check_arm(arm)
        self.friction_share = number("friction_share", friction_share, 0.0, 0.95)
        self._arm = arm
        self._passive = PassiveForces(arm.model, arm.joint_map)
        self._loss = np.array(DryFriction.from_model(arm.model, arm.joint_map).loss)
        span = arm.limits.q_max - arm.limits.q_min
        self._margin = np.minimum(_RANGE_SHARE * span, _MAX_RANGE_MARGIN)

    def __repr__(self) -> str:
        return face(self, friction_share=self.friction_share)

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque that holds the arm's weight and friction; the setpoint has no effect.

        Returns:
            (n,) N m.
        """
        limits = self._arm.limits
        q = state.q
        v = state.v
        friction = self._passive.damping_torque(v) + self._loss * np.clip(v / _FRICTION_SPEED, -1.0, 1.0)
        inside = np.clip(limits.q_min + self._margin - q, 0.0, self._margin)
        inside = inside - np.clip(q - limits.q_max + self._margin, 0.0, self._margin)
        free = _BRAKED_SPEED_SHARE * limits.v_max
        too_fast = np.clip(v, -limits.v_max, limits.v_max) - np.clip(v, -free, free)
        most = _TORQUE_SHARE * np.where(np.isfinite(limits.tau_max), limits.tau_max, 0.0)
        resistance = most * (inside / np.maximum(self._margin, 1e-9) - too_fast / np.maximum(limits.v_max - free, 1e-9))
        resistance = np.where(np.isfinite(resistance), resistance, 0.0)
        return self._arm.gravity(q) + self.friction_share * friction + resistance
