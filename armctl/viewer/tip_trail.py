"""TipTrail: the path of the tip over the last seconds, as a line in the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armctl.core.validation import Array

if TYPE_CHECKING:
    import viser

_SEGMENTS = 300
_MIN_STEP_M = 2e-3
_MAX_STEP_M = 0.1  # a longer step is a reset, not a motion
_THICKNESS_PX = 3.0
_RGB = (255, 190, 0)


class TipTrail:
    """A line behind the tip. The number of segments is fixed: those without a way yet have no length."""

    def __init__(self, scene: viser.SceneApi, position: Array, root: str):
        """A trail of no length, at the tip's position (3,) m, below the scene node `root`."""
        self._segments = np.empty((_SEGMENTS, 2, 3), np.float32)
        self._start_at(position)
        self._has_changed = False
        self._line = scene.add_line_segments(
            f"{root}/trail", self._segments, _RGB, thickness=_THICKNESS_PX, thickness_units="screen"
        )

    def add(self, position: Array) -> None:
        """The tip is at `position`, (3,) m, now."""
        last = self._segments[-1, 1].copy()
        step = float(np.linalg.norm(position - last))
        if step < _MIN_STEP_M:
            return
        self._has_changed = True
        if step > _MAX_STEP_M:
            self._start_at(position)
            return
        self._segments = np.roll(self._segments, -1, axis=0)
        self._segments[-1] = last, position

    def draw(self) -> None:
        """Sends the trail to the clients, if it has changed."""
        if self._has_changed:
            self._has_changed = False
            self._line.points = self._segments.copy()

    def _start_at(self, position: Array) -> None:
        self._segments[:] = position
