"""Page: a real-time session in the browser, with a target to drag and a panel of controls."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import signal
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.errors import InputError, UnknownNameError
from armctl.robot.arm import Arm
from armctl.sim.realtime import UPDATE_INTERVAL_S, RealTimeSession
from armctl.viewer.arm_controls import ArmControls
from armctl.viewer.panel import Panel
from armctl.viewer.web_scene import DRAW_INTERVAL_S, PORT, WebScene

if TYPE_CHECKING:
    import viser

_TEXT_INTERVAL_S = 0.15
_START_DELAY_S = 2.0  # the first page is drawn before the arm moves
_JOIN_TIMEOUT_S = 0.5
_PRELOADED_MODULES = ("mjviser", "armctl.ik.kernel")  # slow to import: loaded while MuJoCo compiles the model

_log = logging.getLogger("armctl.viewer")


class Page:
    """Arms on a web page, of which one at a time is commanded; the brakes hold the others where they are.

    Attributes:
        scene: The page's 3D scene.
        url: Address of the page.
        port: Port of the page.
    """

    def __init__(self, arms: Sequence[Arm], scene: WebScene, controller: str = "computed-torque"):
        """Puts arms and their controls on a page; `serve` then keeps it up to date.

        Args:
            arms: Arms of one model; the first is commanded first.
            scene: An empty scene.
            controller: Name of the first controller.

        Raises:
            UnknownNameError: There is no such controller.
        """
        self.scene = scene
        self.url = scene.url
        self.port = scene.port
        scene.set(arms[0], arms[1:])
        if len(arms) == 1:
            self._controls = {arms[0].tip: ArmControls(arms[0], controller, scene, "")}
        else:
            self._controls = self._add_several(arms, controller)
        self._shown = self._controls[arms[0].tip]
        self._closing = threading.Event()
        self._starter = threading.Thread(target=self._start_arm, name="armctl start", daemon=True)
        self._failed = False

    @property
    def session(self) -> RealTimeSession:
        """The session of the commanded arm."""
        return self._shown.session

    @property
    def panel(self) -> Panel:
        """The panel of the commanded arm."""
        return self._shown.panel

    @property
    def is_target_held(self) -> bool:
        """Whether a client drags the target."""
        return self._shown.target.is_held

    def serve(self) -> None:
        """Keeps the page up to date until `close`. The arm moves shortly after the first client has connected."""
        for controls in self._controls.values():
            controls.session.start()
        self._starter.start()
        text_written_at = -np.inf
        while not self._closing.wait(DRAW_INTERVAL_S):
            try:
                self._shown.draw()
                if time.monotonic() - text_written_at > _TEXT_INTERVAL_S:
                    text_written_at = time.monotonic()
                    self._shown.write()
            except Exception:  # the page must not end while somebody uses it
                if not self._failed and not self._closing.is_set():
                    _log.exception("the page could not show the session's status")
                self._failed = True

    def close(self) -> None:
        """Ends the sessions and closes the page. It may be called twice."""
        self._closing.set()
        if self._starter.is_alive():
            self._starter.join(timeout=_JOIN_TIMEOUT_S)
        for controls in self._controls.values():
            controls.close()
        self.scene.close()

    def _add_several(self, arms: Sequence[Arm], controller: str) -> dict[str, ArmControls]:
        """The controls of several arms, each in a folder, and a list to choose from; the first is shown."""
        gui = self.scene.server.gui
        chosen = gui.add_dropdown("arm", tuple(arm.tip for arm in arms), hint="the brakes hold the other arms")
        added: dict[str, ArmControls] = {}
        folders: dict[str, viser.GuiFolderHandle] = {}
        for k, arm in enumerate(arms):
            folders[arm.tip] = gui.add_folder(arm.tip, visible=k == 0)
            with folders[arm.tip]:
                added[arm.tip] = ArmControls(arm, controller, self.scene, f"/arm{k}")
            added[arm.tip].set_visible(k == 0)

        async def choose(event: viser.GuiEvent) -> None:
            before = self._shown
            after = self._controls[chosen.value]
            if after is before:
                return
            before.session.stand_by(True)
            while not before.session.is_standing_by:
                await asyncio.sleep(UPDATE_INTERVAL_S)
            after.session.continue_from(before.session.status.qpos)
            after.session.stand_by(False)
            self._shown = after
            for tip, controls in self._controls.items():
                folders[tip].visible = controls is after
                controls.set_visible(controls is after)

        chosen.on_update(choose)
        return added

    def _start_arm(self) -> None:
        """Lets the arm move; until then its session executes commands, so that the first click is answered at once."""
        while not self.scene.wait_for_client(DRAW_INTERVAL_S):
            if self._closing.is_set():
                return
        if not self._closing.wait(_START_DELAY_S):
            self.session.prepare()
            self.session.stand_by(False)


def view(
    load: Callable[[], Sequence[Arm]],
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
        load: Returns the arms, one or several of one model; it is called while the browser opens.
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
            arms = load()
            print(f"{arms[0].name} is at {scene.url}; Ctrl-C ends it", flush=True)
            page = Page(arms, scene, controller)
            stack.callback(page.close)
            page.serve()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the closing
