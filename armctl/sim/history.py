"""History: the last seconds of a session, for its plots."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array

SECONDS = 10.0


class History:
    """A ring of rows: when, how far off, how hard the motors work. Written by one thread, read by others."""

    def __init__(self, n: int, interval: float):
        """An empty history.

        Args:
            n: How many joints.
            interval: s between rows.
        """
        self._rows = np.full((int(SECONDS / interval), n + 3), np.nan)
        self._rows[:, 0] = interval * np.arange(-len(self._rows), 0)
        self._next, self._interval, self._lock = 0, interval, threading.Lock()

    def add(self, to_target: float, to_reference: float, torque_share: Array) -> None:
        """Writes a row.

        Args:
            to_target: m from the tip to the target.
            to_reference: m from the tip to where it should be by now.
            torque_share: (n,) of each motor's limit.
        """
        with self._lock:
            row = self._rows[self._next]
            row[0] = self._rows[self._next - 1, 0] + self._interval
            row[1], row[2], row[3:] = to_target, to_reference, torque_share
            self._next = (self._next + 1) % len(self._rows)

    def read(self) -> Past:
        """What happened, oldest first; NaN where nothing has yet."""
        with self._lock:
            rows = np.roll(self._rows, -self._next, axis=0)
        return Past(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:])


class Past(NamedTuple):
    """The rows of a history.

    Attributes:
        t: (T,) s.
        to_target: (T,) m.
        to_reference: (T,) m.
        torque_share: (T, n).
    """

    t: Array
    to_target: Array
    to_reference: Array
    torque_share: Array
