"""SceneControls: everything on a page that belongs to the arm of one scene, with a target to drag for each tip."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.view.drawings import TipTrail
from armctl.view.panel import Panel
from armctl.view.plan_preview import PlanPreview
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Activity
from armctl.view.status_text import describe
from armctl.view.target_controls import TargetControls, gizmo_size
from armctl.view.web_scene import WebScene

if TYPE_CHECKING:
    import viser


_LABEL_OFFSET = np.array([0.0, 0.0, 1.2])  # of the size of the handles: above that of the z axis


class SceneControls:
    """A session with its targets, trails, planned path and panel. One tip is chosen: that whose target was dragged last."""

    def __init__(self, session: RealTimeSession, scene: WebScene, root: str, folder: str = ""):
        """Adds the controls of a session, which stands by; without a folder of the panel, they cannot be removed from it."""
        server = scene.server
        self.session = session
        self.session.stand_by(True)
        self.session.hand = lambda: scene.devices.velocity
        self._scene = scene
        self._event_loop = server.get_event_loop()
        self._node = server.scene.add_frame(root, show_axes=False)  # everything of it in the scene
        self._folder: viser.GuiFolderHandle | None = server.gui.add_folder(folder) if folder else None
        arm = session.arm
        status = session.status
        self.targets = {
            tip: TargetControls(server, session, f"{root}/tip{k}", tip, self.choose) for k, tip in enumerate(arm.tips)
        }
        self._trails = [TipTrail(server.scene, position, f"{root}/tip{k}") for k, position in enumerate(self._tips(status.q))]
        self._label_offset = gizmo_size(arm) * _LABEL_OFFSET
        self._label = server.scene.add_label(
            f"{root}/status", describe(status), position=status.target.position + self._label_offset, anchor="bottom-center"
        )
        self._labelled: Pose | None = None
        self._preview = PlanPreview(server, arm, root)
        with contextlib.nullcontext() if self._folder is None else self._folder:
            self.panel = Panel(server, scene.text, session, self.targets, root, self.choose)
        self.panel.show_tip(session.hand_tip)

    @property
    def is_target_held(self) -> bool:
        return any(target.is_held for target in self.targets.values())

    def choose(self, tip: str) -> None:
        """Chooses the tip whose fields the panel shows, and that keyboards and other devices move."""
        self.session.hand_tip = tip
        self.panel.show_tip(tip)

    def start(self) -> None:
        self.session.start()

    def draw(self) -> None:
        status = self.session.status
        self._scene.show_target(status.qpos, status.target)
        for tip, target in self.targets.items():
            target.draw(status.targets[tip])
        self.panel.pictures.add(status)
        for trail, position in zip(self._trails, self._tips(status.q), strict=True):
            trail.add(position)
        labelled = status.targets[self.session.hand_tip]
        if labelled is not self._labelled:
            self._labelled = labelled
            self._label.position = labelled.position + self._label_offset

    def write(self, notice: str = "") -> None:
        """Writes what the session does, below a notice of the page, and updates the panel."""
        status = self.session.status
        is_held = self.is_target_held
        text = describe(status, is_held=is_held)
        if self._label.text != text:
            self._label.text = text
        for trail in self._trails:
            trail.draw()
        self._preview.show(status.path, with_ghost=status.activity is not Activity.AT_TARGET)
        self.panel.update(status, notice, is_held=is_held)

    def close(self) -> None:
        self.panel.close()
        self.session.stop()

    def remove(self) -> None:
        self.close()
        # On viser's event loop, after the values that were sent there before: a removed control takes none.
        self._event_loop.call_soon_threadsafe(self._remove)

    def _remove(self) -> None:
        self._node.remove()
        if self._folder is not None:
            self._folder.remove()

    def _tips(self, q: Array) -> list[Array]:
        arm = self.session.arm
        return [arm.fk(q, tip).position for tip in arm.tips]
