"""Disturbances: what a plant does to signals while it runs: noise on measurements, delay and ripple on commands."""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from armctl.core.validation import Array
from armctl.robot.arm import Arm
from armctl.sim.plant import Plant

_RIPPLES = 12.0  # per radian; 75 a turn, as of a motor's torque behind a gear


class Disturbances:
    """Noise, delay, ripple and pushes of one run; the same plant gives every run the same ones."""

    def __init__(self, plant: Plant, arm: Arm, data: mujoco.MjData):
        """The disturbances of a run that begins.

        Args:
            plant: What they are.
            arm: The arm.
            data: The simulation's state, in which pushes are applied.
        """
        self._plant, self._arm, self._data = plant, arm, data
        self._rng = np.random.default_rng(plant.rng)
        self._commands: deque[Array] = deque(maxlen=plant.delay + 1)

    def measured(self, q: Array, v: Array) -> tuple[Array, Array]:
        """What the sensors say.

        Args:
            q: (n,) rad, the truth.
            v: (n,) rad/s, the truth.

        Returns:
            Both with noise.
        """
        noise, n = self._rng.standard_normal(2 * len(q)), len(q)
        return q + self._plant.encoder_noise * noise[:n], v + self._plant.velocity_noise * noise[n:]

    def driven(self, tau: Array, q: Array) -> Array:
        """What the motors are asked for when a controller commands a torque; and the pushes of this moment.

        Args:
            tau: (n,) N m, the command.
            q: (n,) rad, the truth.

        Returns:
            (n,) N m: the command of some ticks ago (the first one until then), with ripple.
        """
        if self._plant.pushes:
            wrench = sum((p.wrench for p in self._plant.pushes if p.acts(self._data.time)), np.zeros(6))
            self._data.qfrc_applied[self._arm.dof_adr] = self._arm.pinocchio_model.jacobian(q).T @ wrench
        self._commands.append(tau.copy())
        return self._commands[0] * (1.0 + self._plant.torque_ripple * np.sin(_RIPPLES * q))
