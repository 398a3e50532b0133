"""TargetControls: the handles of a tip's target in the scene, and the fields and buttons that move it."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.core.pose import Pose, computed_pose
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Status

if TYPE_CHECKING:
    import viser

GIZMO_SIZE_M = 0.15
_MIN_GIZMO_SIZE_M = 0.03
_BALL_SIZE = 0.1  # radius, of that of the handles
_BALL_RGB = (0, 200, 0)
_DECIMALS = 4  # of the fields; the browser shows three
_ROUNDING = 5e-5
_MAX_UNDO = 50
_TOOL_AXES = "tool"
_WORLD_AXES = "world"
_IDENTITY_QUAT = np.array([1.0, 0.0, 0.0, 0.0])
_STEP_MM = 10.0
_MAX_STEP_MM = 100.0
_STEP_RAD = 0.1
_MAX_STEP_RAD = 0.8
_SHIFT_BUTTONS = ("-x", "+x", "-y", "+y", "-z", "+z")


class TargetControls:
    """Everything on the page that moves a tip's target, and back; as for `Panel`, callbacks are coroutines."""

    def __init__(self, server: viser.ViserServer, session: RealTimeSession, root: str, tip: str, choose: Callable[[str], None]):
        """Adds the handles below the scene node `root`; `add_fields` adds the fields to the panel. A drag chooses the tip."""
        self._server = server
        self._choose = choose
        self._session = session
        self._tip = tip
        self._drawn_target = self._target
        self._held_by: int | None = None
        self._undo: deque[Pose] = deque(maxlen=_MAX_UNDO)
        self._has_world_axes = True
        self._grip = self._drawn_target  # the target's pose where the handles were put last
        size = gizmo_size(session.arm)
        self._gizmo = server.scene.add_transform_controls(f"{root}/goal", scale=size, depth_test=False)
        server.scene.add_icosphere(f"{root}/goal/ball", _BALL_SIZE * size, _BALL_RGB, opacity=0.5, cast_shadow=False)
        self._place_gizmo(self._drawn_target)
        self._gizmo.on_update(self._dragged)

    @property
    def is_held(self) -> bool:
        return self._held_by is not None

    @property
    def _target(self) -> Pose:
        return self._session.status.targets[self._tip]

    def draw(self, target: Pose) -> None:
        """Puts the handles at a target, unless a client drags them."""
        if self._held_by is not None and self._held_by not in self._server.get_clients():
            self._held_by = None  # that client left without releasing the target
            self._session.aim(target, tip=self._tip)
        if target is not self._drawn_target and self._held_by is None:
            self._drawn_target = target
            self._place_gizmo(target)

    def add_fields(self) -> None:
        gui = self._server.gui
        target = self._target
        with gui.add_folder("Target"):
            self._position = gui.add_vector3("position, m", _rounded(target.position), step=0.001)
            self._rpy = gui.add_vector3("roll, pitch, yaw, rad", _rounded(target.rpy), step=0.001)
            oriented = gui.add_checkbox("orientation counts", self._tip in self._session.status.oriented)
            undo = gui.add_button_group("last move", ("undo",), hint="the target where it was before it")
            axes = gui.add_dropdown("axes", (_WORLD_AXES, _TOOL_AXES), initial_value=_WORLD_AXES, hint="of handles and jog")
        with gui.add_folder("Jog", expand_by_default=False):
            step_mm = gui.add_slider("step, mm", 1.0, _MAX_STEP_MM, 1.0, _STEP_MM)
            shift = gui.add_button_group("move", _SHIFT_BUTTONS)
            step_rad = gui.add_slider("step, rad", 0.01, _MAX_STEP_RAD, 0.01, _STEP_RAD)
            turn = gui.add_button_group("turn", _SHIFT_BUTTONS)
        self._shown_target = target

        async def aim(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._aim(Pose(self._position.value, rpy=np.remainder(self._rpy.value, 2 * np.pi)))

        async def undo_move(event: viser.GuiEvent) -> None:
            if self._undo:
                self._session.aim(self._undo.pop(), tip=self._tip)

        async def set_axes(event: viser.GuiEvent) -> None:
            self._has_world_axes = axes.value == _WORLD_AXES
            if self._held_by is None:
                self._place_gizmo(self._target)

        async def jog_position(event: viser.GuiEvent) -> None:
            self._aim(self._jogged(1e-3 * step_mm.value * _direction(shift.value), np.zeros(3)))

        async def jog_orientation(event: viser.GuiEvent) -> None:
            self._aim(self._jogged(np.zeros(3), step_rad.value * _direction(turn.value)))

        self._position.on_update(aim)
        self._rpy.on_update(aim)
        on_value(oriented, lambda counts: self._session.set_oriented(counts, self._tip))
        undo.on_click(undo_move)
        axes.on_update(set_axes)
        shift.on_click(jog_position)
        turn.on_click(jog_orientation)

    def show_values(self, status: Status) -> None:
        target = status.targets[self._tip]
        if target is not self._shown_target:  # otherwise a number that is being typed would be overwritten
            self._shown_target = target
            _show(self._position, target.position)
            _show(self._rpy, target.rpy)

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        turned = Pose(event.target.position, quat=event.target.wxyz)  # now: later the handle may be elsewhere
        if self._has_world_axes:
            turned = computed_pose(turned.position, turned.rotation @ self._grip.rotation)
        if self._held_by is None:
            self._undo.append(self._target)
            self._choose(self._tip)
        self._held_by = event.client_id
        self._session.aim(turned, tip=self._tip, held=event.phase != "end")
        if event.phase == "end":
            self._held_by = None

    def _aim(self, target: Pose) -> None:
        self._undo.append(self._target)
        self._session.aim(target, tip=self._tip)

    def _jogged(self, shift: Array, rpy: Array) -> Pose:
        """The target, moved by a step along or about one axis."""
        target = self._target
        if self._has_world_axes:
            turned = Pose(np.zeros(3), rpy=rpy) @ Pose(np.zeros(3), quat=target.quat)
            return Pose(target.position + shift, quat=turned.quat)
        return target @ Pose(shift, rpy=rpy)

    def _place_gizmo(self, target: Pose) -> None:
        self._grip = target
        self._gizmo.position = target.position
        self._gizmo.wxyz = _IDENTITY_QUAT if self._has_world_axes else target.quat


def gizmo_size(arm: Arm) -> float:
    """The size of handles, m: those of neighboring tips at home do not overlap, as far as they can still be dragged."""
    places = [arm.fk(arm.home, tip).position for tip in arm.tips]
    gaps = [float(np.linalg.norm(one - other)) for one, other in itertools.combinations(places, 2)]
    return min(max(0.5 * min(gaps, default=np.inf), _MIN_GIZMO_SIZE_M), GIZMO_SIZE_M)


def on_value(control: Any, take: Callable[[Any], object]) -> None:
    """Passes each new value of a control on, on viser's event loop."""

    async def changed(event: object) -> None:
        take(control.value)

    control.on_update(changed)


def _direction(button: str) -> Array:
    """The unit vector of a button such as "-y"."""
    direction = np.zeros(3)
    direction["xyz".index(button[1])] = -1.0 if button[0] == "-" else 1.0
    return direction


def _show(field: viser.GuiVector3Handle, value: Array) -> None:
    if np.abs(np.array(field.value) - value).max() > _ROUNDING:
        field.value = _rounded(value)


def _rounded(value: Array) -> tuple[float, float, float]:
    x, y, z = np.round(value, _DECIMALS).tolist()
    return x, y, z
