"""WebScene: a MuJoCo model on a web page, drawn at its own rate in its own thread."""

from __future__ import annotations

import atexit
import importlib.util
import logging
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import InputError, NotInstalledError
from armctl.core.open_browser import open_browser
from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.target_marker import find_target, is_movable
from armctl.report.render.camera import axes, fitted_camera
from armctl.report.render.stick_figure import StickFigure, drawn_geoms, has_shapes
from armctl.view.access_control import AccessControl, check_token
from armctl.view.drawings import Sticks
from armctl.view.mesh_decimation import COARSE_CELL, FINE_CELL, PLAIN_CELL, decimated

if TYPE_CHECKING:
    import viser

PORT = 8080
DRAW_INTERVAL_S = 1 / 30
_REFINE_DELAY_S = 8.0  # after the first client: it gets coarse meshes first, so that it answers clicks soon
_STICKS_S = 60.0  # for which a stick figure stands in for meshes that a browser has not drawn yet
_MIN_DRAWN_SHARE = 0.5  # of the bodies with meshes; equal bodies are drawn as one
_MIN_MOTION = 1e-6  # rad, m: smaller changes are not drawn
_SAME_VIEW_M = 1e-3
_FIELD_OF_VIEW_DEG = 45.0  # vertical
_DISTANCE_FACTOR = 1.15
_NARROW_ASPECT = 0.8  # width over height: in a narrower picture the arm is drawn smaller
_PHONE_ASPECT = 0.6  # in a still narrower one it is drawn above the panel
_PANEL_SHARE = 0.45  # of the height of a phone
_HANDLES_M = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.2]])  # from the target: handles, and the label above
_SKY_TOP_RGB = (128.0, 145.0, 162.0)
_SKY_BOTTOM_RGB = (176.0, 188.0, 200.0)
_SKY_HEIGHT_PX = 256
_SKY_WIDTH_PX = 16
_MAX_PORT = 65535
_DRAWING_JOIN_TIMEOUT_S = 1.0

# The position and the intensity of each lamp.
_LAMPS = (((2.0, -1.5, 4.0), 3.0), ((-3.0, 2.0, 1.5), 1.5), ((-1.0, -2.0, -3.0), 0.8))

_log = logging.getLogger("armctl.view")


class _View(NamedTuple):
    """A view of the whole arm: directions (3,), distance from the eye in m, vertical field of view in rad."""

    look_at: Array
    forward: Array
    up: Array
    distance: float
    fov: float


class _ShownState(NamedTuple):
    qpos: Array
    mocap_pos: Array
    mocap_quat: Array

    def is_close(self, other: _ShownState) -> bool:
        return all(np.abs(a - b).max(initial=0.0) < _MIN_MOTION for a, b in zip(self, other, strict=True))


@dataclass
class _Drawing:
    """The arm on the page."""

    model: mujoco.MjModel  # with meshes that are coarse at first
    data: mujoco.MjData
    hidden_body: int  # which the page does not show; -1: none
    not_refined: mujoco.MjModel | None  # from which finer meshes are made; None: they are fine
    figure: StickFigure
    sticks: Sticks
    bodies: int  # that move and have meshes; 0: the stick figure is all that there is to see


class WebScene:
    """The scene of an arm on a web page. The thread that moves the arm calls `show` and never waits for the drawing."""

    def __init__(
        self,
        port: int = PORT,
        host: str | None = None,
        token: str | None = None,
        allowed_hosts: Sequence[str] = (),
        *,
        title: str = "armctl",
        in_notebook: bool = False,
    ):
        """Serves an empty page at once: the browser opens while an arm is loaded. The arguments are those of `view`."""
        if not 0 <= port <= _MAX_PORT:
            raise InputError(f"port: expected a number in [0, {_MAX_PORT}], got {port}")
        if token is not None:
            check_token(token)
        if importlib.util.find_spec("mjviser") is None:
            raise _missing("mjviser")
        try:
            from armctl.view import page_server
        except ImportError as error:
            raise _missing(error.name) from None
        listener = page_server.listen(port, host)
        self.port = int(listener.getsockname()[1])
        self._access = AccessControl(self.port, host, token, allowed_hosts, in_notebook=in_notebook)
        self._root = f"http://{_shown_host(host)}:{self.port}"
        self.url = self._root + self._access.query()
        self._page_server = page_server.start_server(listener, self._access, title)
        self.server = self._page_server.viser  # viser's server, for more controls on the page
        self.devices = self._page_server.devices  # what the visitors' keyboards, gamepads and SpaceMice ask for
        atexit.register(self.close)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.gui.main_panel.dock_right()
        self.text = self.server.gui.add_markdown("loading")
        _add_background(self.server.scene)
        self._lamps = _added_lamps(self.server.scene)
        self._view: _View | None = None
        self._drawing_lock = threading.Lock()  # `set` replaces what the drawing thread uses
        self._latest: _ShownState | None = None
        self._shown = threading.Event()
        self._drawn: _ShownState | None = None
        self._sticks_until = 0.0  # s, of the monotonic clock
        self._client_connected = threading.Event()
        self._closing = threading.Event()
        self.server.on_client_connect(self._note_client)
        self._thread = threading.Thread(target=self._run, name="armctl drawing", daemon=True)

    async def _note_client(self, client: viser.ClientHandle) -> None:
        self._await_meshes()
        self._client_connected.set()

    def open_browser(self) -> bool:
        """Opens a browser at the page, where there is a screen. Returns whether a browser starts."""
        return open_browser(self._root + self._access.one_time_query())

    def set(self, arm: Arm, *, with_marker: bool = True) -> None:
        """Puts an arm at home on the page in place of the one there."""
        target = find_target(arm.model)
        hidden_body = -1 if with_marker or target is None else target
        figure = StickFigure(arm)
        at_home = mujoco.MjData(arm.model)
        at_home.qpos[:] = arm.home_qpos
        mujoco.mj_kinematics(arm.model, at_home)
        sticks = Sticks(self.server.scene, "/sticks", figure.segments(at_home))  # they replace those of the arm before
        self._set_camera(arm, at_home)
        self.server.gui.set_panel_label(arm.name)
        self._await_meshes()
        self.server.flush()  # the stick figure is there at once; the meshes take longer
        import mjviser

        coarse = decimated(arm.model, COARSE_CELL, hidden_body)
        with self._drawing_lock:
            self._drawing = _Drawing(
                model=coarse,
                data=mujoco.MjData(coarse),
                hidden_body=hidden_body,
                not_refined=arm.model,
                figure=figure,
                sticks=sticks,
                bodies=_drawn_bodies(coarse) if has_shapes(arm) else 0,
            )
            self._drawn = None
            self.show(arm.home_qpos)
            if self._thread.is_alive():
                self._scene.mj_model = coarse
                self._scene.mj_data = mujoco.MjData(coarse)
                self._scene.rebuild_visual_handles()
                return
            self._scene = mjviser.ViserMujocoScene(self.server, coarse, 1)
            self._scene.camera_tracking_enabled = False
            self.server.scene.configure_environment_map(None)
        self._thread.start()

    def show(self, qpos: Array, mocap_pos: Array | None = None, mocap_quat: Array | None = None) -> None:
        """Sets what is drawn next: qpos (nq,), and positions (nmocap, 3) m and wxyz of mocap bodies, unchanged if None."""
        data = self._drawing.data
        position = data.mocap_pos if mocap_pos is None else mocap_pos
        quat = data.mocap_quat if mocap_quat is None else mocap_quat
        self._latest = _ShownState(np.array(qpos), np.array(position), np.array(quat))
        self._shown.set()

    def show_target(self, qpos: Array, target: Pose) -> None:
        """Sets what is drawn next, with the target marker at a pose. A model without a movable marker shows none."""
        model = self._drawing.model
        position = np.array(self._drawing.data.mocap_pos)
        quat = np.array(self._drawing.data.mocap_quat)
        if is_movable(model):
            marker = model.body_mocapid[find_target(model)]
            position[marker] = target.position
            quat[marker] = target.quat
        self.show(qpos, position, quat)

    def wait_for_client(self, timeout: float) -> bool:
        """Waits up to `timeout` s for the first client. Returns whether one has connected."""
        return self._client_connected.wait(timeout)

    @property
    def is_closed(self) -> bool:
        return self._closing.is_set()

    def close(self) -> None:
        if self._closing.is_set():
            return
        atexit.unregister(self.close)
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout=_DRAWING_JOIN_TIMEOUT_S)
        self._page_server.stop()

    def _run(self) -> None:
        refine_at: float | None = None
        next_at = 0.0
        while not self._closing.wait(max(0.0, next_at - time.monotonic())):
            self._shown.wait(DRAW_INTERVAL_S)  # what is shown is drawn at once, unless something was drawn just before
            self._shown.clear()
            next_at = time.monotonic() + DRAW_INTERVAL_S
            if refine_at is None and self._client_connected.is_set():
                refine_at = time.monotonic() + _REFINE_DELAY_S
            try:
                with self._drawing_lock:
                    self._lamps[0].cast_shadow = self.devices.draw_fast
                    self._show_sticks()
                    self._fit_narrow_pages()
                    if refine_at is not None and time.monotonic() > refine_at:
                        self._refine()
                    self.draw()
            except Exception:  # the drawing continues with the next state
                _log.exception("the page could not draw the scene")

    def _await_meshes(self) -> None:
        self._sticks_until = time.monotonic() + _STICKS_S

    def _show_sticks(self) -> None:
        """Shows the stick figure until a browser has drawn the meshes, and always if there are none."""
        drawing = self._drawing
        are_drawn = self.devices.meshes_drawn >= _MIN_DRAWN_SHARE * drawing.bodies or time.monotonic() > self._sticks_until
        was_visible = drawing.sticks.visible
        drawing.sticks.visible = not are_drawn or not drawing.bodies
        if drawing.sticks.visible and not was_visible:
            drawing.sticks.move(drawing.figure.segments(drawing.data))

    def _refine(self) -> None:
        """Replaces the coarse meshes of an arm by finer ones, once."""
        drawing = self._drawing
        if drawing.not_refined is not None:
            cell = FINE_CELL if self.devices.draw_fast else PLAIN_CELL
            drawing.model = decimated(drawing.not_refined, cell, drawing.hidden_body)
            drawing.not_refined = None
            self._await_meshes()
            self._scene.mj_model = drawing.model
            self._scene.rebuild_visual_handles()
            if self._latest is None:
                self._latest = self._drawn
            self._drawn = None

    def draw(self) -> None:
        latest = self._latest
        self._latest = None
        if latest is None or (self._drawn is not None and latest.is_close(self._drawn)):
            return
        self._drawn = latest
        data = self._drawing.data
        data.qpos[:] = latest.qpos
        data.mocap_pos[:] = latest.mocap_pos
        data.mocap_quat[:] = latest.mocap_quat
        mujoco.mj_kinematics(self._drawing.model, data)
        with self.server.atomic():
            self._scene.update_from_mjdata(data)
            if self._drawing.sticks.visible:
                self._drawing.sticks.move(self._drawing.figure.segments(data))
        self.server.flush()

    def _set_camera(self, arm: Arm, data: mujoco.MjData) -> None:
        """Points the page's first view at the arm and the target, which are where a state of the model has them."""
        model = arm.model
        roots = {arm.joints_to(tip)[0] for tip in arm.tips}
        points = [data.xpos[model.dof_bodyid[arm.dof_adr[joint]]] for joint in sorted(roots)] if arm.further_tips else []
        points += [arm.fk(arm.home, tip).position for tip in arm.tips]
        target = find_target(model)
        handles = np.empty((0, 3))
        if target is not None:
            points.append(data.xpos[target])
            handles = data.xpos[target] + _HANDLES_M
        view = fitted_camera(arm, [data], np.array(points), _NARROW_ASPECT, handles)
        forward, _, up = axes(*np.radians([view.azimuth, view.elevation]))
        model_fov = np.radians(model.vis.global_.fovy)
        fov = np.radians(_FIELD_OF_VIEW_DEG)
        distance = _DISTANCE_FACTOR * view.distance * np.tan(model_fov / 2) / np.tan(fov / 2)
        camera = self.server.initial_camera
        camera.look_at = view.lookat
        camera.position = view.lookat - distance * forward
        camera.fov = fov
        self._view = _View(np.array(view.lookat), forward, up, distance, fov)

    def _fit_narrow_pages(self) -> None:
        """Gives clients with a narrow page a view that shows the whole arm, above the panel of a phone.

        A browser goes to the first view of all pages when it has read that, at some time, and when a visitor resets the view.
        """
        for client in self.server.get_clients().values():
            if np.allclose(client.camera.position, self.server.initial_camera.position, atol=_SAME_VIEW_M):
                self._fit_narrow_page(client)

    def _fit_narrow_page(self, client: viser.ClientHandle) -> None:
        view = self._view
        aspect = client.camera.image_width / client.camera.image_height
        if view is None or aspect >= _NARROW_ASPECT:
            return
        distance = view.distance * _NARROW_ASPECT / aspect
        below = _PANEL_SHARE * distance * np.tan(0.5 * view.fov) if aspect < _PHONE_ASPECT else 0.0
        look_at = view.look_at - below * view.up
        client.camera.position = look_at - distance * view.forward  # this moves the point that the camera looks at
        client.camera.look_at = look_at


def _drawn_bodies(model: mujoco.MjModel) -> int:
    """How many bodies move and have a geom that is drawn."""
    bodies = np.unique(model.geom_bodyid[drawn_geoms(model)])
    return int(((model.body_weldid[bodies] > 0) & (model.body_mocapid[model.body_rootid[bodies]] < 0)).sum())


def _missing(module: str | None) -> NotInstalledError:
    return NotInstalledError.from_extra(f"the page in the browser needs {module}", "view")


def _shown_host(host: str | None) -> str:
    if host is None:
        return "127.0.0.1"
    if host in ("", "0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _add_background(scene: viser.SceneApi) -> None:
    """A sky that contrasts with all arms."""
    top = np.array(_SKY_TOP_RGB)
    bottom = np.array(_SKY_BOTTOM_RGB)
    share = np.linspace(0.0, 1.0, _SKY_HEIGHT_PX)[:, None, None]
    sky = np.broadcast_to(top + share * (bottom - top), (_SKY_HEIGHT_PX, _SKY_WIDTH_PX, 3))
    scene.set_background_image(sky.astype(np.uint8))


def _added_lamps(scene: viser.SceneApi) -> list[viser.DirectionalLightHandle]:
    """Lamps without shadows, which are too slow for a browser without graphics card."""
    scene.configure_default_lights(False, cast_shadow=False)
    return [
        scene.add_light_directional(f"/lamps/{k}", intensity=intensity, position=position)
        for k, (position, intensity) in enumerate(_LAMPS)
    ]
