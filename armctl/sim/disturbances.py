"""Disturbances: how a plant disturbs signals during a run: measurement noise, command delay, torque ripple, pushes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.sim.plant import Plant

_RIPPLES_PER_RADIAN = 12.0  # 75 a turn, typical of a motor behind a gear


class Disturbances:
    """Noise, delay, ripple and pushes of one run; every run of the same plant has the same ones.

    Attributes:
        push: (6,) N and N m, the wrench of the pushes in the last tick.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData, dof_adr: IntArray, tip_jacobian: Callable[[Array], Array], dt: float):
        """The disturbances of a run that starts now.

        Args:
            plant: The plant that describes them.
            data: The state of the simulation; pushes are applied to it.
            dof_adr: (n,) addresses of the joints in `MjData.qvel`.
            tip_jacobian: The (6, n) Jacobian of the tip at q, for pushes.
            dt: s, the tick, over which positions are differenced.
        """
        self._plant = plant
        self._data = data
        self._dof_adr = dof_adr
        self._tip_jacobian = tip_jacobian
        self._pushes = list(plant.pushes)  # type: ignore[arg-type]  # a tuple after Plant.__post_init__
        self._dt = dt
        self.push = np.zeros(6)
        self._rng = np.random.default_rng(plant.seed)
        self._last_noise = np.zeros(len(dof_adr))
        self._commands: deque[Array] = deque(maxlen=plant.delay + 1)

    def measured(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The true positions, rad, and velocities, rad/s, with measurement noise.

        Without a velocity sensor, the velocity has the noise of a difference of two measured positions.
        """
        n = len(q)
        noise = self._rng.standard_normal(2 * n)
        of_position = self._plant.encoder_noise * noise[:n]
        if self._plant.velocity_noise is None:
            of_velocity = (of_position - self._last_noise) / self._dt
        else:
            of_velocity = self._plant.velocity_noise * noise[n:]
        self._last_noise = of_position
        return q + of_position, v + of_velocity

    def driven(self, tau: Array, q: Array) -> Array:
        """Applies the pushes of this moment, and returns the torque that the motors receive for a commanded torque.

        That is the command `delay` ticks ago, or the first command until then, with ripple.
        """
        if self._pushes:
            self.push = sum((push.wrench for push in self._pushes if push.acts(self._data.time)), np.zeros(6))
            self._data.qfrc_applied[self._dof_adr] = self._tip_jacobian(q).T @ self.push
        self._commands.append(tau.copy())
        return self._commands[0] * (1.0 + self._plant.torque_ripple * np.sin(_RIPPLES_PER_RADIAN * q))
