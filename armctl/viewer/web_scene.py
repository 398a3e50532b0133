"""WebScene: a MuJoCo model on a page in the browser, drawn at its own rate in a thread of its own."""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import io
import os
import sys
import threading
import webbrowser
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from armctl.core.errors import InputError, NotInstalledError
from armctl.core.validation import Array
from armctl.mjmodel.target_marker import find_target
from armctl.render.camera import axes, fitted_camera
from armctl.robot.arm import Arm
from armctl.viewer.mesh_decimation import decimated

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
PORT = 8080
INTERVAL = 1 / 30  # s between drawings
_SAME = 1e-6  # rad, m: what moves less is not drawn again
_FIELD_OF_VIEW = 45.0  # degrees, vertical
_LAMPS = (((2.0, -1.5, 4.0), 3.0), ((-3.0, 2.0, 1.5), 1.5), ((-1.0, -2.0, -3.0), 0.8))  # where each shines from, and how bright


class WebScene:
    """The scene of an arm on a page. Whoever moves the arm calls `show`; the drawing never makes them wait.

    Attributes:
        server: viser's server, to put more on the page.
        words: What the page says first.
        port: Where it serves.
        url: Where the page is.
    """

    def __init__(self, port: int = PORT):
        """An empty page. It is served at once: a browser takes as long to get ready for it as an arm to load.

        Args:
            port: Where to serve; the next free one if it is taken, any if 0.

        Raises:
            NotInstalledError: viser or mjviser is missing.
            InputError: The port is no port.
        """
        if not 0 <= port <= 65535:
            raise InputError(f"port: {port} given, a number in [0, 65535] wanted")
        if importlib.util.find_spec("mjviser") is None:
            raise _missing("mjviser")
        try:
            import viser
        except ImportError as error:
            raise _missing(error.name) from None
        with contextlib.redirect_stdout(io.StringIO()):  # it announces itself with a table
            self.server = viser.ViserServer(host=LOCAL, port=port, verbose=False)
        atexit.register(self.close)
        self.port = self.server.get_port()
        self.url = f"http://{LOCAL}:{self.port}"
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.gui.main_panel.dock_right()
        self.words = self.server.gui.add_markdown("loading")
        _light(self.server.scene)
        self._latest: tuple[Array, Array, Array] | None = None
        self._drawn: tuple[Array, Array, Array] | None = None
        self._looking, self._closing = threading.Event(), threading.Event()
        self.server.on_client_connect(lambda client: self._looking.set())
        self._thread = threading.Thread(target=self._draw, name="armctl drawing", daemon=True)

    def open_browser(self) -> bool:
        """Opens a browser at the page, where there is a screen.

        Returns:
            Whether one is on its way.
        """
        screen = sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        return bool(screen) and webbrowser.open(self.url)

    def set(self, arm: Arm) -> None:
        """Puts an arm on the page, at home.

        Args:
            arm: The arm.

        Raises:
            NotInstalledError: mjviser is missing.
        """
        import mjviser

        self._model = decimated(arm.model)
        self._data = mujoco.MjData(self._model)
        self._look_at(arm)
        self._scene = mjviser.ViserMujocoScene(self.server, self._model, 1)
        self._scene.camera_tracking_enabled = False
        self.server.scene.configure_environment_map(None)
        self.show(arm.home_qpos)
        self._thread.start()

    def show(self, qpos: Array, mocap_pos: Array | None = None, mocap_quat: Array | None = None) -> None:
        """Says what is to be drawn next. What is not drawn in time is left out.

        Args:
            qpos: (nq,).
            mocap_pos: (nmocap, 3) m; where they were if left out.
            mocap_quat: (nmocap, 4) wxyz; likewise.
        """
        position = self._data.mocap_pos if mocap_pos is None else mocap_pos
        quat = self._data.mocap_quat if mocap_quat is None else mocap_quat
        self._latest = (np.array(qpos), np.array(position), np.array(quat))

    def wait_for_someone(self, seconds: float) -> bool:
        """Waits until a page looks on.

        Args:
            seconds: How long at most.

        Returns:
            Whether one does.
        """
        return self._looking.wait(seconds)

    def close(self) -> None:
        """Takes the page away. Once is enough, twice does no harm."""
        if self._closing.is_set():
            return
        atexit.unregister(self.close)
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _draw(self) -> None:
        while not self._closing.wait(INTERVAL):
            if self._latest is not None:
                self.draw()

    def draw(self) -> None:
        """Sends what was shown last to the pages."""
        latest, self._latest, data = self._latest, None, self._data
        if latest is None or (self._drawn is not None and _same(latest, self._drawn)):
            return
        self._drawn = data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = latest
        mujoco.mj_kinematics(self._model, data)
        with self.server.atomic():
            self._scene.update_from_mjdata(data)
        self.server.flush()

    def _look_at(self, arm: Arm) -> None:
        self._data.qpos[:] = arm.home_qpos
        mujoco.mj_kinematics(self._model, self._data)
        points = [arm.fk(arm.home).position]
        target = find_target(self._model)
        if target is not None:
            points.append(self._data.xpos[target])
        view = fitted_camera(arm, [self._data], np.array(points), 0.8)
        forward, _, _ = axes(*np.radians([view.azimuth, view.elevation]))
        ratio = np.tan(np.radians(self._model.vis.global_.fovy) / 2) / np.tan(np.radians(_FIELD_OF_VIEW) / 2)
        camera = self.server.initial_camera
        camera.look_at = view.lookat
        camera.position = view.lookat - 1.15 * ratio * view.distance * forward
        camera.fov = np.radians(_FIELD_OF_VIEW)


def _missing(module: str | None) -> NotInstalledError:
    return NotInstalledError.of_extra(f"the page in the browser needs {module}", "view")


def _light(scene: viser.SceneApi) -> None:
    """A sky that white arms and black ones stand out from, and lamps all round.

    No shadows and no mirrored surroundings: a browser without a graphics card would draw three pictures a second.
    """
    top, bottom = np.array([72.0, 93.0, 115.0]), np.array([172.0, 186.0, 199.0])
    share = np.linspace(0.0, 1.0, 256)[:, None, None]
    scene.set_background_image(np.broadcast_to(top + share * (bottom - top), (256, 16, 3)).astype(np.uint8))
    scene.configure_default_lights(False, cast_shadow=False)
    for k, (direction, intensity) in enumerate(_LAMPS):
        scene.add_light_directional(f"/lamps/{k}", intensity=intensity, position=direction)


def _same(one: tuple[Array, ...], other: tuple[Array, ...]) -> bool:
    return all(np.abs(a - b).max(initial=0.0) < _SAME for a, b in zip(one, other, strict=True))
