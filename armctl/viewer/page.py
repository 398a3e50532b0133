"""Page: a real-time session in the browser, with a target to drag and a panel of controls."""

from __future__ import annotations

import contextlib
import importlib
import logging
import signal
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.errors import InputError, UnknownNameError
from armctl.robot.arm import Arm
from armctl.sim.realtime import RealTimeSession
from armctl.sim.status import Activity
from armctl.viewer.panel import Panel
from armctl.viewer.plan_preview import PlanPreview
from armctl.viewer.status_text import describe
from armctl.viewer.target_controls import TargetControls
from armctl.viewer.tip_trail import TipTrail
from armctl.viewer.web_scene import DRAW_INTERVAL_S, PORT, WebScene

_LABEL_OFFSET_M = np.array([0.0, 0.0, 0.1])
_TEXT_INTERVAL_S = 0.15
_START_DELAY_S = 1.0  # the first page is drawn before the arm moves
_JOIN_TIMEOUT_S = 0.5
_PRELOADED_MODULES = ("mjviser", "armctl.ik.kernel")  # slow to import: loaded while MuJoCo compiles the model

_log = logging.getLogger("armctl.viewer")


class Page:
    """A session on a web page.

    Attributes:
        session: The session.
        scene: The page's 3D scene.
        panel: The page's controls.
        url: Address of the page.
        port: Port of the page.
    """

    def __init__(self, arm: Arm, scene: WebScene, controller: str = "computed-torque"):
        """Puts an arm and its controls on a page; `serve` then keeps it up to date.

        Args:
            arm: The arm.
            scene: An empty scene.
            controller: Name of the first controller.

        Raises:
            UnknownNameError: There is no such controller.
        """
        self.scene = scene
        self.url = scene.url
        self.port = scene.port
        scene.set(arm)
        self.session = RealTimeSession(arm, controller)
        status = self.session.status
        self._drawn_target = status.target
        self._target = TargetControls(scene.server, self.session)
        self._label = scene.server.scene.add_label(
            "/status", describe(status), position=status.target.position + _LABEL_OFFSET_M, anchor="bottom-center"
        )
        self._trail = TipTrail(scene.server.scene, arm.fk(status.q).position)
        self._preview = PlanPreview(scene.server, arm)
        self.panel = Panel(scene.server, scene.text, self.session, self._target)
        self._closing = threading.Event()
        self._starter = threading.Thread(target=self._start_session, name="armctl start", daemon=True)
        self._failed = False

    @property
    def is_target_held(self) -> bool:
        """Whether a client drags the target."""
        return self._target.is_held

    def serve(self) -> None:
        """Keeps the page up to date until `close`. The session starts shortly after the first client has connected."""
        self._starter.start()
        text_written_at = -np.inf
        while not self._closing.wait(DRAW_INTERVAL_S):
            try:
                self._draw()
                if time.monotonic() - text_written_at > _TEXT_INTERVAL_S:
                    text_written_at = time.monotonic()
                    self._write()
            except Exception:  # the page must not end while somebody uses it
                if not self._failed and not self._closing.is_set():
                    _log.exception("the page could not show the session's status")
                self._failed = True

    def close(self) -> None:
        """Ends the session and closes the page. It may be called twice."""
        self._closing.set()
        self.panel.close()
        if self._starter.is_alive():
            self._starter.join(timeout=_JOIN_TIMEOUT_S)
        self.session.stop()
        self.scene.close()

    def _start_session(self) -> None:
        while not self.scene.wait_for_client(DRAW_INTERVAL_S):
            if self._closing.is_set():
                return
        if not self._closing.wait(_START_DELAY_S):
            self.session.start()

    def _draw(self) -> None:
        status = self.session.status
        target = status.target
        self.scene.show_target(status.qpos, target)
        self._target.draw(target)
        self.panel.pictures.add(status)
        self._trail.add(self.session.arm.fk(status.q).position)
        if target is not self._drawn_target:
            self._drawn_target = target
            self._label.position = target.position + _LABEL_OFFSET_M

    def _write(self) -> None:
        status = self.session.status
        text = describe(status)
        if self._label.text != text:
            self._label.text = text
        self._trail.draw()
        self._preview.show(status.path, with_ghost=status.activity is not Activity.AT_TARGET)
        self.panel.update()


def view(
    load: Callable[[], Arm],
    controller: str = "computed-torque",
    *,
    port: int = PORT,
    host: str | None = None,
    token: str | None = None,
    allowed_hosts: Sequence[str] = (),
    title: str = "armctl",
) -> None:
    """Serves a page with an arm that follows a target, until Ctrl-C.

    Args:
        load: Returns the arm; it is called while the browser opens.
        controller: Name of the first controller.
        port: Port of the page. Without a host, the next free one if it is taken; any free one if 0.
        host: Address of this machine at which other machines reach the page; None for this machine alone.
        token: The token that visitors need. Required with a host.
        allowed_hosts: More names of this machine under which the page is reached, such as that of a gateway.
        title: What the browser's tab shows.

    Raises:
        InputError: The token is missing or too short, or the page cannot listen there.
        NotInstalledError: viser or mjviser is missing.
        UnknownNameError: There is no such controller.
    """
    if controller not in CONTROLLERS:  # before a browser opens
        raise UnknownNameError.of("controller", controller, CONTROLLERS)
    if host is not None and not token:
        raise InputError("host: everybody who can reach the page can control the arm; give a token of at least 8 characters")
    with contextlib.ExitStack() as stack:
        stack.callback(signal.signal, signal.SIGINT, signal.getsignal(signal.SIGINT))
        scene = WebScene(port, host, token, allowed_hosts, title=title)
        stack.callback(scene.close)
        # some browsers block their caller until they are open
        threading.Thread(target=scene.open_browser, daemon=True).start()
        for module in _PRELOADED_MODULES:
            threading.Thread(target=importlib.import_module, args=(module,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            arm = load()
            print(f"{arm.name} is at {scene.url}; Ctrl-C ends it", flush=True)
            page = Page(arm, scene, controller)
            stack.callback(page.close)
            page.serve()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the closing
