"""PicturePanel: screenshots and films of what a session does, which the browser that asks for them downloads."""

from __future__ import annotations

import io
import logging
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from armctl.core.errors import ArmctlError
from armctl.core.latest_worker import LatestWorker
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.report.render.renderer import Renderer
from armctl.report.render.stick_figure import needed_stick_figure
from armctl.report.render.video import pose, write_mp4
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Status

if TYPE_CHECKING:
    import viser

MAX_FILM_S = 20.0
_FRAMES_PER_SECOND = 25
_FRAME_INTERVAL_S = 1 / _FRAMES_PER_SECOND
_SCREENSHOT_PX = (1280, 800)
_FILM_PX = (640, 400)
_RECORD = "record a film"
_STOP = "stop and download"

_log = logging.getLogger("armctl.view")


class PicturePanel:
    """Two buttons. The server draws in one thread, from the view of the requesting browser, and writes no file."""

    def __init__(self, server: viser.ViserServer, session: RealTimeSession):
        self._server = server
        self._session = session
        self._stick_figure = needed_stick_figure(session.arm)
        self._worker = LatestWorker("armctl pictures")
        self._film: deque[Status] | None = None
        with server.gui.add_folder("Pictures", expand_by_default=False):
            screenshot = server.gui.add_button("screenshot", hint="of your view, as .png")
            self._record = server.gui.add_button(_RECORD, hint=f"of your view, as .mp4; its last {MAX_FILM_S:g} s")
        screenshot.on_click(self._take_screenshot)
        self._record.on_click(self._start_or_stop)

    def close(self) -> None:
        self._worker.close()

    def add(self, status: Status) -> None:
        film = self._film
        if film is not None and (not film or status.elapsed - film[-1].elapsed > 0.99 * _FRAME_INTERVAL_S):
            film.append(status)

    async def _take_screenshot(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            status = self._session.status
            self._submit(event.client, "png", lambda camera: self._screenshot(status, camera))

    async def _start_or_stop(self, event: viser.GuiEvent) -> None:
        film = self._film
        if film is None:
            self._film = deque([self._session.status], maxlen=round(MAX_FILM_S * _FRAMES_PER_SECOND))
            self._record.label = _STOP
            return
        self._film = None
        self._record.label = _RECORD
        if event.client is not None:
            self._submit(event.client, "mp4", lambda camera: self._filmed(list(film), camera))

    def _submit(self, client: viser.ClientHandle, ending: str, draw: Callable[[mujoco.MjvCamera], bytes]) -> None:
        camera = _camera(client, self._session.arm.model)
        name = f"{self._session.arm.name}.{ending}"

        def make() -> None:
            notice = client.add_notification("drawing", name, loading=True, with_close_button=False)
            try:
                content = draw(camera)
                client.send_file_download(name, content, save_immediately=True)
                notice.remove()
            except (ArmctlError, OSError) as error:
                notice.title = "not drawn"
                notice.body = str(error)[:300]
                notice.loading = False
                notice.with_close_button = True
                _log.warning("a picture for the page was not drawn: %s", error)

        self._worker.submit(make)

    def _screenshot(self, status: Status, camera: mujoco.MjvCamera) -> bytes:
        from PIL import Image

        arm = self._session.arm
        data = mujoco.MjData(arm.model)
        _pose(arm, data, status)
        with Renderer(arm.model, _SCREENSHOT_PX, "full") as renderer:
            image = renderer.image(data, camera, sticks=self._sticks(data))
        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(image)).save(file, "png")
        return file.getvalue()

    def _filmed(self, film: list[Status], camera: mujoco.MjvCamera) -> bytes:
        arm = self._session.arm
        data = mujoco.MjData(arm.model)
        file = io.BytesIO()
        with Renderer(arm.model, _FILM_PX) as renderer:

            def images():
                for status in film:
                    _pose(arm, data, status)
                    yield renderer.image(data, camera, sticks=self._sticks(data))

            write_mp4(file, images(), _FRAMES_PER_SECOND, _FILM_PX)
        return file.getvalue()

    def _sticks(self, data: mujoco.MjData) -> Array | None:
        return None if self._stick_figure is None else self._stick_figure.segments(data)


def _pose(arm: Arm, data: mujoco.MjData, status: Status) -> None:
    pose(arm, data, status.qpos, np.concatenate([status.target.position, status.target.quat]))


def _camera(client: viser.ClientHandle, model: mujoco.MjModel) -> mujoco.MjvCamera:
    """MuJoCo's camera with the view of a client. Its field of view is the model's, so the distance differs."""
    view = client.camera
    look_at = np.array(view.look_at)
    offset = look_at - np.array(view.position)
    distance = max(float(np.linalg.norm(offset)), 1e-3)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = look_at
    camera.distance = distance * np.tan(0.5 * view.fov) / np.tan(0.5 * np.radians(model.vis.global_.fovy))
    camera.azimuth = float(np.degrees(np.arctan2(offset[1], offset[0])))
    camera.elevation = float(np.degrees(np.arcsin(np.clip(offset[2] / distance, -1.0, 1.0))))
    return camera
