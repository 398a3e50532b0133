"""What moves in the scene: the path of the tip over the last seconds, a stick figure, and forces at contacts as arrows."""

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
_TRAIL_RGB = (255, 190, 0)
_STICK_RGB = (52, 58, 64)
_STICK_THICKNESS_PX = 5.0
_STICK_DOT_M = 0.02
M_PER_N = 0.01
MAX_LENGTH_M = 0.3
_MIN_FORCE_N = 0.05
_ARROW_RGB = (200, 0, 0)
_SHAFT_RADIUS_M = 0.004
_HEAD_RADIUS_M = 0.01
_HEAD_LENGTH_M = 0.02


class TipTrail:
    """A line behind the tip. The number of segments is fixed: those without a way yet have no length."""

    def __init__(self, scene: viser.SceneApi, position: Array, root: str):
        """A trail of no length, at the tip's position (3,) m, below the scene node `root`."""
        self._segments = np.empty((_SEGMENTS, 2, 3), np.float32)
        self._segments[:] = position
        self._has_changed = False
        self._line = scene.add_line_segments(
            f"{root}/trail", self._segments, _TRAIL_RGB, thickness=_THICKNESS_PX, thickness_units="screen"
        )

    def add(self, position: Array) -> None:
        """The tip is at `position`, (3,) m, now."""
        last = self._segments[-1, 1].copy()
        step = float(np.linalg.norm(position - last))
        if step < _MIN_STEP_M:
            return
        self._has_changed = True
        if step > _MAX_STEP_M:
            self._segments[:] = position
            return
        self._segments = np.roll(self._segments, -1, axis=0)
        self._segments[-1] = last, position

    def draw(self) -> None:
        if self._has_changed:
            self._has_changed = False
            self._line.points = self._segments.copy()


class Sticks:
    """A robot as lines from joint to joint, with dots at its joints: browsers draw these at once."""

    def __init__(self, scene: viser.SceneApi, root: str, segments: Array):
        """A stick figure with lines between (k, 2, 3) m, below the scene node `root`."""
        ends = segments.astype(np.float32)
        self._lines = scene.add_line_segments(
            f"{root}/lines", ends, _STICK_RGB, thickness=_STICK_THICKNESS_PX, thickness_units="screen"
        )
        self._dots = scene.add_point_cloud(
            f"{root}/dots", ends[:, 1], _STICK_RGB, point_size=_STICK_DOT_M, point_shape="circle"
        )

    @property
    def visible(self) -> bool:
        return bool(self._lines.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        if visible != self._lines.visible:
            self._lines.visible = visible
            self._dots.visible = visible

    def move(self, segments: Array) -> None:
        """The lines are between (k, 2, 3) m now."""
        ends = segments.astype(np.float32)
        self._lines.points = ends
        self._dots.points = ends[:, 1]

    def remove(self) -> None:
        self._lines.remove()
        self._dots.remove()


class ContactArrows:
    """An arrow for each contact: 1 cm per N, at most 30 cm."""

    def __init__(self, scene: viser.SceneApi, root: str):
        """Adds no arrows yet, below the scene node `root`; they are switched on by `visible`."""
        self.visible = False
        self._scene = scene
        self._root = root
        self._arrows: viser.ArrowsHandle | None = None

    def show(self, contacts: Array) -> None:
        """Shows contacts: (k, 2, 3) points, m, and forces, N."""
        force = np.linalg.norm(contacts[:, 1], axis=1)
        pressing = contacts[force > _MIN_FORCE_N]
        if not self.visible or not len(pressing):
            self._remove()
            return
        force = np.linalg.norm(pressing[:, 1], axis=1, keepdims=True)
        length = np.minimum(M_PER_N * force, MAX_LENGTH_M)
        points = np.stack([pressing[:, 0], pressing[:, 0] + length * pressing[:, 1] / force], axis=1).astype(np.float32)
        if self._arrows is None or len(self._arrows.points) != len(points):
            self._remove()
            self._arrows = self._scene.add_arrows(
                f"{self._root}/contacts",
                points,
                _ARROW_RGB,
                shaft_radius=_SHAFT_RADIUS_M,
                head_radius=_HEAD_RADIUS_M,
                head_length=_HEAD_LENGTH_M,
            )
        elif not np.allclose(self._arrows.points, points, atol=1e-3):
            self._arrows.points = points

    def _remove(self) -> None:
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None
