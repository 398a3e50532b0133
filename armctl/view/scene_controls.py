"""SceneControls: everything on a page that belongs to the arms of one scene."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

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

    def __init__(self, session: RealTimeSession, scene: WebScene, root: str):
        server = scene.server
        arm = session.arm
        self.session = session
        self.session.stand_by(True)
        self.session.hand = lambda: scene.devices.velocity
        self._scene = scene
        self.node = server.scene.add_frame(root, show_axes=False)  # everything of it in the scene
        status = self.session.status
        self._drawn_target = status.target
        self.target = TargetControls(server, self.session, root)
        self._label = server.scene.add_label(
            f"{root}/status", describe(status), position=status.target.position + _LABEL_OFFSET_M, anchor="bottom-center"
        )
        self._trail = TipTrail(server.scene, arm.fk(status.q).position, root)
        self._preview = PlanPreview(server, arm, root)
        self.panel = Panel(server, scene.text, self.session, self.target, root)

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
    """The controls of all arms, of which one at a time is commanded; the brakes hold the others where they are."""

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
        chosen = gui.add_dropdown("arm", tips, hint="the brakes hold the other arms")
        added: dict[str, ArmControls] = {}
        folders: dict[str, viser.GuiFolderHandle] = {}
        for k, (tip, session) in enumerate(zip(tips, sessions, strict=True)):
            folders[tip] = gui.add_folder(tip, visible=k == 0)
            with folders[tip]:
                added[tip] = ArmControls(session, scene, f"{root}/arm{k}")
            added[tip].node.visible = k == 0

        async def choose(event: viser.GuiEvent) -> None:
            before = self.shown
            after = self.arms[chosen.value]
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
            for tip, controls in self.arms.items():
                folders[tip].visible = controls is after
                controls.node.visible = controls is after

        chosen.on_update(choose)
        return added
