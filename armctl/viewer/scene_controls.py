"""SceneControls: everything on a page that belongs to the arms of one scene."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

from armctl.sim.realtime.session import UPDATE_INTERVAL_S, RealTimeSession
from armctl.viewer.arm_controls import ArmControls
from armctl.viewer.web_scene import WebScene

if TYPE_CHECKING:
    import viser


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
        """Ends the threads."""
        self._closed = True
        for controls in self.arms.values():
            controls.close()

    def remove(self) -> None:
        """Ends the threads, and removes everything from the page."""
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
            added[tip].set_visible(k == 0)

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
                controls.set_visible(controls is after)

        chosen.on_update(choose)
        return added
