"""SceneControls: everything on a page that belongs to the arms of one scene, each with a target of its own to drag."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.validation import Array
from armctl.view.drawings import TipTrail
from armctl.view.panel import Panel
from armctl.view.plan_preview import PlanPreview
from armctl.view.realtime.session import UPDATE_INTERVAL_S, RealTimeSession
from armctl.view.realtime.status import Activity
from armctl.view.status_text import describe
from armctl.view.target_controls import TargetControls
from armctl.view.web_scene import WebScene

if TYPE_CHECKING:
    import viser


_LABEL_OFFSET_M = np.array([0.0, 0.0, 0.18])  # above the handle of the z axis


class ArmControls:
    """A session with its target, trail, planned path and panel."""

    def __init__(
        self, session: RealTimeSession, scene: WebScene, root: str, choose: Callable[[], Awaitable[None]] | None = None
    ):
        """Adds the controls of a session; `choose` makes it the one that is commanded, when somebody drags its target."""
        server = scene.server
        arm = session.arm
        self.session = session
        self.session.stand_by(True)
        self.session.hand = lambda: scene.devices.velocity
        self._scene = scene
        server.scene.add_frame(root, show_axes=False)  # everything of it in the scene
        details = f"{root}/details"
        self._details = server.scene.add_frame(details, show_axes=False)  # what only the arm that is commanded shows
        status = self.session.status
        self._drawn_target = status.target
        self._drawn_q: Array = status.q
        self.target = TargetControls(server, self.session, root, choose)
        self._label = server.scene.add_label(
            f"{details}/status", describe(status), position=status.target.position + _LABEL_OFFSET_M, anchor="bottom-center"
        )
        self._trail = TipTrail(server.scene, arm.fk(status.q).position, details)
        self._preview = PlanPreview(server, arm, details)
        self.panel = Panel(server, scene.text, self.session, self.target, details)

    def show_details(self, shown: bool) -> None:
        """Shows or hides what belongs to an arm that is commanded: all but the handles of its target."""
        self._details.visible = shown

    def draw(self) -> None:
        status = self.session.status
        target = status.target
        self._scene.show_target(status.qpos, target)
        self.target.draw(target)
        self.panel.pictures.add(status)
        self._trail.add(self.session.arm.fk(status.q).position)
        if target is not self._drawn_target:
            self._drawn_target = target
            self._label.position = target.position + _LABEL_OFFSET_M

    def draw_standing(self, qpos: Array) -> None:
        """Puts the handles at the tip, where another session has moved the model to positions (nq,)."""
        arm = self.session.arm
        q = qpos[arm.qpos_adr]
        if not np.array_equal(q, self._drawn_q):
            self._drawn_q = q
            self.target.draw(arm.fk(arm.limits.clamp(q)))

    def write(self, notice: str = "") -> None:
        """Writes what the session does, below a notice of the page, and updates the panel."""
        status = self.session.status
        text = describe(status, is_held=self.target.is_held)
        if self._label.text != text:
            self._label.text = text
        self._trail.draw()
        self._preview.show(status.path, with_ghost=status.activity is not Activity.AT_TARGET)
        self.panel.update(status, notice)

    def close(self) -> None:
        self.panel.close()
        self.session.stop()


class SceneControls:
    """The controls of all arms, of which one at a time is commanded: that whose target was dragged last, or which was chosen.

    The brakes hold the others where they are.
    """

    def __init__(self, sessions: Sequence[RealTimeSession], scene: WebScene, root: str, folder: str = ""):
        """Adds the controls of sessions, which stand by; without a folder of the panel, they cannot be removed from it."""
        gui = scene.server.gui
        self._event_loop = scene.server.get_event_loop()
        self._closed = False
        self._node = scene.server.scene.add_frame(root, show_axes=False)
        self._folder: viser.GuiFolderHandle | None = gui.add_folder(folder) if folder else None
        with contextlib.nullcontext() if self._folder is None else self._folder:
            if len(sessions) == 1:
                self.arms = {sessions[0].arm.tip: ArmControls(sessions[0], scene, f"{root}/arm0")}
            else:
                self.arms = self._add_several(sessions, scene, root)
        self.shown = self.arms[sessions[0].arm.tip]

    def draw(self) -> None:
        shown = self.shown
        shown.draw()
        for controls in self.arms.values():
            if controls is not shown:
                controls.draw_standing(shown.session.status.qpos)

    @property
    def is_target_held(self) -> bool:
        return any(controls.target.is_held for controls in self.arms.values())

    def start(self) -> None:
        for controls in self.arms.values():
            controls.session.start()

    def close(self) -> None:
        self._closed = True
        for controls in self.arms.values():
            controls.close()

    def remove(self) -> None:
        self.close()
        # On viser's event loop, after the values that were sent there before: a removed control takes none.
        self._event_loop.call_soon_threadsafe(self._remove)

    def _remove(self) -> None:
        self._node.remove()
        if self._folder is not None:
            self._folder.remove()

    def _add_several(self, sessions: Sequence[RealTimeSession], scene: WebScene, root: str) -> dict[str, ArmControls]:
        """The controls of several arms, each in a folder, and a list to choose from; the first is shown."""
        gui = scene.server.gui
        tips = tuple(session.arm.tip for session in sessions)
        chosen = gui.add_dropdown("arm", tips, hint="or drag its target; the brakes hold the other arms")
        added: dict[str, ArmControls] = {}
        folders: dict[str, viser.GuiFolderHandle] = {}
        switching = asyncio.Lock()

        async def choose(tip: str) -> None:
            async with switching:
                before = self.shown
                after = self.arms[tip]
                if after is before:
                    return
                before.session.stand_by(True)
                while not before.session.is_standing_by:
                    await asyncio.sleep(UPDATE_INTERVAL_S)
                    if self._closed:
                        return
                after.session.continue_from(before.session.status.qpos)
                after.session.stand_by(False)
                self.shown = after
                chosen.value = tip
                for name, controls in self.arms.items():
                    folders[name].visible = controls is after
                    controls.show_details(controls is after)

        for k, (tip, session) in enumerate(zip(tips, sessions, strict=True)):
            folders[tip] = gui.add_folder(tip, visible=k == 0)
            with folders[tip]:
                added[tip] = ArmControls(session, scene, f"{root}/arm{k}", functools.partial(choose, tip))
            added[tip].show_details(k == 0)

        async def choose_listed(event: viser.GuiEvent) -> None:
            await choose(chosen.value)

        chosen.on_update(choose_listed)
        return added
