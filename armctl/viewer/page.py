"""Page: the session in the browser: a scene with a target to drag, and a panel of all that can be changed and read."""

from __future__ import annotations

import contextlib
import importlib
import signal
import threading
import time
from collections.abc import Callable

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.errors import UnknownNameError
from armctl.core.pose import Pose
from armctl.robot.arm import Arm
from armctl.sim.realtime import RealTimeSession
from armctl.viewer.auth_proxy import AuthProxy
from armctl.viewer.panel import Panel
from armctl.viewer.web_scene import INTERVAL, PORT, WebScene

_GIZMO = 0.15  # m
_ABOVE = np.array([0.0, 0.0, 0.1])  # m, where the words are, from the target
_WORDS = 0.15  # s between words and charts
_MOMENT = 1.0  # s for a page to be drawn before the arm sets out
_NEEDED_SOON = ("mjviser", "armctl.ik.kernel")  # slow to import: read while MuJoCo compiles the model


class Page:
    """A session on a page of its own.

    Attributes:
        session: What it shows.
        url: Where it is.
        port: Its port.
    """

    def __init__(self, arm: Arm, stage: WebScene, controller: str = "computed-torque"):
        """Puts an arm and its controls on a page; `serve` then runs it.

        Args:
            arm: The arm.
            stage: The page, still empty.
            controller: The name of the controller to begin with.

        Raises:
            UnknownNameError: There is no such controller.
        """
        self._stage, self.url, self.port, scene = stage, stage.url, stage.port, stage.server.scene
        stage.set(arm)
        self.session = RealTimeSession(arm, controller)
        target = self._drawn = self.session.target
        self._gizmo = scene.add_transform_controls(
            "/goal", scale=_GIZMO, depth_test=False, position=target.position, wxyz=target.quat
        )
        self._label = scene.add_label("/status", self.session.status, position=target.position + _ABOVE, anchor="bottom-center")
        self._gizmo.on_update(self._dragged)
        self._panel = Panel(stage.server, stage.words, self.session)
        self._held, self._closing = threading.Event(), threading.Event()
        self._starter = threading.Thread(target=self._begin, name="armctl start", daemon=True)

    async def _dragged(self, event) -> None:
        """A target moved by hand. Asynchronous, so that it runs at once and in order."""
        if event.phase == "end":
            self._held.clear()
        else:
            self._held.set()
        self.session.aim(Pose(event.target.position, quat=event.target.wxyz))

    def serve(self) -> None:
        """Keeps the page up to date until `close`; the session runs from a moment after somebody looks on."""
        self._starter.start()
        written = 0.0
        while not self._closing.wait(INTERVAL):
            self._draw()
            if time.monotonic() - written > _WORDS:
                written = time.monotonic()
                self._write()

    def close(self) -> None:
        """Ends the session and takes the page away. Once is enough, twice does no harm."""
        self._closing.set()
        if self._starter.is_alive():
            self._starter.join(timeout=2.0)
        self.session.stop()
        self._stage.close()

    def _begin(self) -> None:
        while not self._stage.wait_for_someone(INTERVAL):
            if self._closing.is_set():
                return
        if not self._closing.wait(_MOMENT):
            self.session.start()

    def _draw(self) -> None:
        session, target = self.session, self.session.target
        self._stage.show(session.shown, target.position[None], target.quat[None])
        if target is self._drawn:
            return
        self._drawn, self._label.position = target, target.position + _ABOVE
        if not self._held.is_set():
            self._gizmo.position, self._gizmo.wxyz = target.position, target.quat

    def _write(self) -> None:
        if self._label.text != self.session.status:
            self._label.text = self.session.status
        self._panel.update()


def view(
    load: Callable[[], Arm],
    controller: str = "computed-torque",
    *,
    port: int = PORT,
    host: str | None = None,
    token: str | None = None,
) -> None:
    """Serves a page with an arm that follows a target, until Ctrl-C.

    Args:
        load: What gives the arm; the browser gets ready meanwhile.
        controller: The name of the controller to begin with.
        port: Where to serve; the next free one if it is taken, any if 0.
        host: An address of this machine, to serve other machines too; this machine alone if left out.
        token: What visitors from other machines must know; needed with a host.

    Raises:
        InputError: The token is missing or too short, or nobody can listen there.
        NotInstalledError: viser or mjviser is missing.
        UnknownNameError: There is no such controller.
    """
    if controller not in CONTROLLERS:  # a wrong name is said before anything opens
        raise UnknownNameError.of("controller", controller, CONTROLLERS)
    with contextlib.ExitStack() as stack:
        stack.callback(signal.signal, signal.SIGINT, signal.getsignal(signal.SIGINT))
        stage = WebScene(port if host is None else 0)
        stack.callback(stage.close)
        url = stage.url
        if host is not None:
            gate = AuthProxy(host, token or "", stage.port, port)
            stack.callback(gate.close)
            url = gate.url
        threading.Thread(target=stage.open_browser, daemon=True).start()  # some browsers let one wait until they are open
        for module in _NEEDED_SOON:
            threading.Thread(target=importlib.import_module, args=(module,), daemon=True).start()
        arm = load()
        with contextlib.suppress(KeyboardInterrupt):
            print(f"{arm.name} is at {url}; Ctrl-C ends it", flush=True)
            page = Page(arm, stage, controller)
            stack.callback(page.close)
            page.serve()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C would tear apart what is being closed
