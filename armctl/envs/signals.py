"""Signals: noise of measured positions of each copy of an arm."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array
from armctl.sim.plant import Plant


class Signals:
    """Noise of what is measured on several copies of an arm in the next step.

    The velocity is differenced from the measured positions, as that of `Plant` without a velocity sensor.
    """

    def __init__(self, count: int, ticks: int, n: int, dt: float, *, is_noisy: bool):
        """Signals without noise, for steps of so many ticks of dt s."""
        # (count, ticks, 2, n) rad and rad/s, on measured positions and velocities; empty if there is none
        self.noise = np.zeros((count if is_noisy else 0, ticks, 2, n))
        self._dt = dt
        self._deviation = np.zeros(count)
        self._rngs: list[np.random.Generator | None] = [None] * count

    def reset(self, row: int, plant: Plant, rng: np.random.Generator) -> None:
        """Starts an episode of a copy with the noise of a plant."""
        if len(self.noise):
            self._deviation[row] = plant.encoder_noise
            self._rngs[row] = np.random.default_rng(int(rng.integers(2**63)))
            self.noise[row] = 0.0

    def draw(self) -> None:
        """Draws the noise of the next step."""
        if not len(self.noise):
            return
        last = self.noise[:, -1, 0].copy()
        positions = self.noise[:, :, 0]
        for row, rng in enumerate(self._rngs):
            if rng is not None:
                positions[row] = self._deviation[row] * rng.standard_normal(positions.shape[1:])
        self.noise[:, :, 1] = np.diff(positions, axis=1, prepend=last[:, None]) / self._dt

    def measured(self, q: Array) -> Array:
        """(count, n) rad, positions (count, n) as they are measured now."""
        return q + self.noise[:, -1, 0] if len(self.noise) else q
