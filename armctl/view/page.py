"""Page: a real-time session in the browser, with targets to drag and a panel of controls."""

from __future__ import annotations

import contextlib
import gc
import importlib
import logging
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.errors import ArmctlError, InputError, UnknownNameError
from armctl.core.latest_worker import LatestWorker
from armctl.core.pose import Pose
from armctl.model.arm.arm import Arm
from armctl.view.panel import Panel
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Activity
from armctl.view.scene_controls import SceneControls
from armctl.view.web_scene import DRAW_INTERVAL_S, PORT, WebScene

if TYPE_CHECKING:
    import viser

_TEXT_INTERVAL_S = 0.15
_START_DELAY_S = 1.0  # the first page, with a stick figure, is drawn before the arm moves, unless a visitor drags the target
_JOIN_TIMEOUT_S = 0.5
_PRELOADED_MODULES = ("mjviser", "armctl._core")  # slow to import: loaded while MuJoCo compiles the model
_MAX_NOTICE_LENGTH = 400
# The target goes around by itself until somebody touches it: what the first visitor sees.
_REST_S = 1.0
_ROUND_S = 6.0
_ROUNDS = 2
_SIZE = 0.05  # radius of a round, of the model's extent
_MAX_RADIUS_M = 0.1
_REMEMBERED = 8  # poses that were sent and that the session may not have taken yet

Scenes = Mapping[str, Callable[[], Arm]]

_log = logging.getLogger("armctl.view")


class Demonstration:
    """Circles of a session's target through where it is at first. Any other target, pause or reset ends it."""

    def __init__(self, session: RealTimeSession):
        """It begins a second after the arm has come to its first target."""
        self._session = session
        self._tip = session.hand_tip
        self._start = session.status.targets[self._tip]
        self._sent = deque([self._start], maxlen=_REMEMBERED)
        self._begins_at: float | None = None
        self._radius = min(_SIZE * session.arm.model.stat.extent, _MAX_RADIUS_M)
        self.is_over = False

    def advance(self, now: float) -> None:
        """Moves the target to where it is at the time `now`, s; does nothing after the end."""
        status = self._session.status
        if self.is_over or (self._begins_at is None and status.activity is not Activity.AT_TARGET):
            return
        is_own = set(status.aimed) <= {self._tip} and any(status.targets[self._tip] is pose for pose in self._sent)
        if status.paused or not is_own:
            self.is_over = True
            return
        if status.activity is Activity.BLOCKED:  # no room to go around: the target goes back to where the arm reached it
            self.is_over = True
            self._session.aim(self._start, tip=self._tip)
            return
        if self._begins_at is None:
            self._begins_at = now + _REST_S
        rounds = max(0.0, now - self._begins_at) / _ROUND_S
        self.is_over = rounds >= _ROUNDS
        angle = 0.0 if self.is_over else 2 * np.pi * rounds
        shift = self._radius * np.array([0.0, np.sin(angle), np.cos(angle) - 1.0])
        self._sent.append(Pose(self._start.position + shift, quat=self._start.quat))
        self._session.aim(self._sent[-1], tip=self._tip, held=not self.is_over)


class Page:
    """An arm on a web page, in one of several scenes."""

    def __init__(self, arm: Arm, scene: WebScene, controller: str = "computed-torque", scenes: Scenes | None = None):
        """Puts an arm and its controls on a page; visitors choose among `scenes`."""
        self.scene = scene
        self.url = scene.url
        self.port = scene.port
        self._controller = controller
        self._scenes = dict(scenes or {})
        self._scene_name = next(iter(self._scenes), "")
        self._notice = ""
        self._loaded: queue.SimpleQueue[RealTimeSession] = queue.SimpleQueue()
        self._loader = LatestWorker("armctl scene")
        scene.set(arm, with_marker=False)  # the handles have a marker of their own
        if len(self._scenes) > 1:
            self._add_choice()
        self._scenes_shown = 0
        self._controls = self._add_controls(RealTimeSession(arm, controller))
        self._closing = threading.Event()
        self._starter = threading.Thread(target=self._start_arm, name="armctl start", daemon=True)
        self._failed = False

    @property
    def session(self) -> RealTimeSession:
        return self._controls.session

    @property
    def panel(self) -> Panel:
        return self._controls.panel

    @property
    def is_target_held(self) -> bool:
        return self._controls.is_target_held

    def serve(self, *, demonstrated: bool = False) -> None:
        """Keeps the page up to date until `close`. The target moves by itself if `demonstrated`, until somebody touches it."""
        demonstration = Demonstration(self.session) if demonstrated else None
        self._controls.start()
        self._starter.start()
        text_written_at = -np.inf
        while not self._closing.wait(DRAW_INTERVAL_S):
            try:
                if not self._loaded.empty():
                    self._replace(self._loaded.get())
                if demonstration is not None:
                    demonstration.advance(time.monotonic())
                self._controls.draw()
                if time.monotonic() - text_written_at > _TEXT_INTERVAL_S:
                    text_written_at = time.monotonic()
                    self._controls.write(self._notice)
            except Exception:  # the page must not end while somebody uses it
                if not self._failed and not self._closing.is_set():
                    _log.exception("the page could not show the session's status")
                self._failed = True

    def close(self) -> None:
        """Ends the sessions and closes the page. It may be called twice."""
        self._closing.set()
        if self._starter.is_alive():
            self._starter.join(timeout=_JOIN_TIMEOUT_S)
        self._loader.close()
        self._controls.close()
        self.scene.close()

    def _add_controls(self, session: RealTimeSession) -> SceneControls:
        root = f"/scene{self._scenes_shown}"  # its own for each: the controls of the one before are removed a moment later
        self._scenes_shown += 1
        folder = session.arm.name if len(self._scenes) > 1 else ""
        return SceneControls(session, self.scene, root, folder)

    def _add_choice(self) -> None:
        """A list of the scenes. The message filter drops names that are not in it."""
        chosen = self.scene.server.gui.add_dropdown("scene", tuple(self._scenes), hint="loads the arm in it, at home")

        def show_present(failed: str) -> None:
            if chosen.value == failed:  # otherwise another one has been chosen meanwhile
                chosen.value = self._scene_name

        def load(name: str) -> None:
            self._notice = f"loading the scene {name} ..."
            try:
                session = RealTimeSession(self._scenes[name](), self._controller)
                session.prepare()
                self._loaded.put(session)
                self._scene_name = name
                self._notice = ""
            except Exception as error:
                self._notice = f"the scene {name} was not loaded: {error}"[:_MAX_NOTICE_LENGTH]
                self.scene.server.get_event_loop().call_soon_threadsafe(show_present, name)
                if not isinstance(error, ArmctlError):
                    raise

        async def choose(event: viser.GuiEvent) -> None:
            name = chosen.value
            if event.client is not None:
                self._loader.submit(lambda: load(name))

        chosen.on_update(choose)

    def _replace(self, session: RealTimeSession) -> None:
        before = self._controls
        self._controls = self._add_controls(session)
        before.remove()
        self.scene.set(session.arm, with_marker=False)
        self._controls.start()
        session.stand_by(False)

    def _start_arm(self) -> None:
        """Lets the arm move; until then its session executes commands, so that the first click is answered at once."""
        self.session.prepare()
        begins_at = np.inf
        while not self.is_target_held and time.monotonic() < begins_at:
            if self._closing.wait(DRAW_INTERVAL_S):
                return
            if begins_at == np.inf and self.scene.wait_for_client(0.0):
                begins_at = time.monotonic() + _START_DELAY_S
        self.session.stand_by(False)


def view(
    scenes: Scenes,
    controller: str = "computed-torque",
    *,
    port: int = PORT,
    host: str | None = None,
    token: str | None = None,
    allowed_hosts: Sequence[str] = (),
    title: str = "armctl",
) -> None:
    """Serves a page with an arm whose tips follow targets, until Ctrl-C.

    Args:
        scenes: Functions that load the arm in a scene, by the scene's name. The first is called while the browser opens;
            visitors choose among several.
        port: Port of the page. Without a host, the next free one if it is taken; any free one if 0.
        host: Address of this machine at which other machines reach the page; None for this machine alone.
        token: The token that visitors need. Required with a host.
        allowed_hosts: More names of this machine under which the page is reached, such as that of a gateway.
        title: What the browser's tab shows.
    """
    if controller not in CONTROLLERS:  # before a browser opens
        raise UnknownNameError.from_known("controller", controller, CONTROLLERS)
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
            arm = next(iter(scenes.values()))()
            print(f"{arm.name} is at {scene.url}; Ctrl-C ends it", flush=True)
            page = Page(arm, scene, controller, scenes)
            stack.callback(page.close)
            gc.freeze()  # a collection that looks at everything that was loaded takes 0.1 s, in which the arm stands
            stack.callback(gc.unfreeze)
            page.serve(demonstrated=True)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the closing
