"""Stage: a MuJoCo model on a page in the browser, drawn at its own rate in a thread of its own."""

from __future__ import annotations

import atexit
import contextlib
import copy
import io
import threading
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.arm import Arm
from armctl.arrays import Array
from armctl.errors import InputError, NotInstalledError
from armctl.staging import TARGET
from armctl.view.camera import axes, frame

if TYPE_CHECKING:
    pass

LOCAL = "127.0.0.1"
PORT = 8080
INTERVAL = 1 / 30  # s between drawings
_SAME = 1e-6  # rad, m: what moves less is not drawn again
_FIELD_OF_VIEW = 45.0  # degrees, vertical


class Stage:
    """The scene of an arm on a page. Whoever moves the arm calls `show`; the drawing never makes them wait.

    Attributes:
        server: viser's server, to put more on the page.
        port: Where it serves.
        url: Where the page is.
    """

    def __init__(self, arm: Arm, port: int = PORT):
        """A page with an arm at home.

        Args:
            arm: The arm.
            port: Where to serve; the next free one if it is taken, any if 0.

        Raises:
            NotInstalledError: viser or mjviser is missing.
            InputError: The port is no port.
        """
        if not 0 <= port <= 65535:
            raise InputError(f"port: {port} given, a number in [0, 65535] wanted")
        try:
            import mjviser
            import viser
        except ImportError as error:
            raise NotInstalledError(f"the page in the browser needs {error.name}: pip install 'armctl[view]'") from None
        self._arm, self._model, self._data = arm, _drawn(arm.model), mujoco.MjData(arm.model)
        with contextlib.redirect_stdout(io.StringIO()):  # it announces itself with a table
            self.server = viser.ViserServer(host=LOCAL, port=port, verbose=False)
        self.port = self.server.get_port()
        self.url = f"http://{LOCAL}:{self.port}"
        atexit.register(self.close)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.scene.set_background_image(_sky())
        self._scene = mjviser.ViserMujocoScene(self.server, self._model, 1)
        self._scene.camera_tracking_enabled = False
        self._latest: tuple[Array, Array, Array] | None = None
        self._drawn: tuple[Array, Array, Array] | None = None
        self._looking = threading.Event()
        self._closing = threading.Event()
        self._look_at_arm()
        self.show(arm.home_qpos)
        self.server.on_client_connect(lambda client: self._looking.set())
        self._thread = threading.Thread(target=self._draw, name="armctl drawing", daemon=True)
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
        """Takes the page away."""
        atexit.unregister(self.close)
        self._closing.set()
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

    def _look_at_arm(self) -> None:
        self._data.qpos[:] = self._arm.home_qpos
        mujoco.mj_kinematics(self._model, self._data)
        target = self._data.xpos[self._model.body(TARGET).id]
        tip = self._arm.fk(self._arm.home).position
        view = frame(self._arm, [self._data], np.array([tip, target]), 0.8)
        forward, _, _ = axes(*np.radians([view.azimuth, view.elevation]))
        ratio = np.tan(np.radians(self._model.vis.global_.fovy) / 2) / np.tan(np.radians(_FIELD_OF_VIEW) / 2)
        camera = self.server.initial_camera
        camera.look_at = view.lookat
        camera.position = view.lookat - 1.15 * ratio * view.distance * forward
        camera.fov = np.radians(_FIELD_OF_VIEW)


def _drawn(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy without what MuJoCo does not draw by default: collision shapes and sites would only make the page heavy."""
    model = copy.copy(model)
    model.geom_rgba[model.geom_group > 2, 3] = 0.0
    model.site_group[:] = 5
    return model


def _same(one: tuple[Array, ...], other: tuple[Array, ...]) -> bool:
    return all(np.abs(a - b).max(initial=0.0) < _SAME for a, b in zip(one, other, strict=True))


def _sky() -> NDArray[np.uint8]:
    """A background that white arms and black ones stand out from."""
    top, bottom = np.array([72.0, 93.0, 115.0]), np.array([172.0, 186.0, 199.0])
    share = np.linspace(0.0, 1.0, 256)[:, None, None]
    return np.broadcast_to(top + share * (bottom - top), (256, 16, 3)).astype(np.uint8)
