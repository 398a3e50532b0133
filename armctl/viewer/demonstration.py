"""Demonstration: the target goes around by itself until somebody touches it: what the first visitor sees."""

from __future__ import annotations

from collections import deque

import numpy as np

from armctl.core.pose import Pose
from armctl.sim.realtime.session import RealTimeSession
from armctl.sim.realtime.status import Activity

_REST_S = 1.0
_ROUND_S = 6.0
_ROUNDS = 2
_SIZE = 0.05  # radius of a round, of the model's extent
_MAX_RADIUS_M = 0.1
_REMEMBERED = 8  # poses that were sent and that the session may not have taken yet


class Demonstration:
    """Circles of a session's target through where it is at first. Any other target, pause or reset ends it."""

    def __init__(self, session: RealTimeSession):
        """It begins a second after the arm has come to its first target."""
        self._session = session
        self._start = session.status.target
        self._sent = deque([self._start], maxlen=_REMEMBERED)
        self._begins_at: float | None = None
        self._radius = min(_SIZE * session.arm.model.stat.extent, _MAX_RADIUS_M)
        self.is_over = False

    def advance(self, now: float) -> None:
        """Moves the target to where it is at the time `now`, s; does nothing after the end."""
        status = self._session.status
        if self.is_over or (self._begins_at is None and status.activity is not Activity.AT_TARGET):
            return
        if status.paused or not any(status.target is pose for pose in self._sent):
            self.is_over = True
            return
        if self._begins_at is None:
            self._begins_at = now + _REST_S
        rounds = max(0.0, now - self._begins_at) / _ROUND_S
        self.is_over = rounds >= _ROUNDS
        angle = 0.0 if self.is_over else 2 * np.pi * rounds
        shift = self._radius * np.array([0.0, np.sin(angle), np.cos(angle) - 1.0])
        self._sent.append(Pose(self._start.position + shift, quat=self._start.quat))
        self._session.aim(self._sent[-1], held=not self.is_over)
