"""History: errors and torques of a session's last seconds, for its charts."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array

DURATION_S = 10.0


class History:
    """A ring buffer of samples. One thread writes, others read."""

    def __init__(self, n: int, interval: float):
        """An empty history of `n` joints with a sample every `interval` s."""
        size = int(DURATION_S / interval)
        self._t: Array = interval * np.arange(-size, 0, dtype=np.float64)
        self._values = np.full((size, 2 + n), np.nan)
        self._next = 0
        self._interval = interval
        self._lock = threading.Lock()

    def add(self, to_target: float, to_reference: float, torque_share: Array) -> None:
        """Adds a sample: distances of the tip from target and reference in m, and (n,) torques as shares of their limits."""
        with self._lock:
            row = self._next
            self._t[row] = self._t[row - 1] + self._interval
            self._values[row] = (to_target, to_reference, *torque_share)
            self._next = (row + 1) % len(self._t)

    def read(self) -> HistorySamples:
        """All samples, oldest first; NaN for times before the session began."""
        with self._lock:
            order = np.roll(np.arange(len(self._t)), -self._next)
            values = self._values[order]
            return HistorySamples(self._t[order], values[:, 0], values[:, 1], values[:, 2:])


class HistorySamples(NamedTuple):
    """Columns of a history."""

    t: Array  # (T,) s
    to_target: Array  # (T,) m from the tip to the target
    to_reference: Array  # (T,) m from the tip to its reference
    torque_share: Array  # (T, n) torques as shares of their limits
