"""ArmControls: everything on a page that belongs to one arm."""

from __future__ import annotations

import numpy as np

from armctl.sim.realtime.session import RealTimeSession
from armctl.sim.realtime.status import Activity
from armctl.viewer.panel import Panel
from armctl.viewer.plan_preview import PlanPreview
from armctl.viewer.status_text import describe
from armctl.viewer.target_controls import TargetControls
from armctl.viewer.tip_trail import TipTrail
from armctl.viewer.web_scene import WebScene

_LABEL_OFFSET_M = np.array([0.0, 0.0, 0.1])


class ArmControls:
    """A session with its target, trail, planned path and panel."""

    def __init__(self, session: RealTimeSession, scene: WebScene, root: str):
        """Adds the controls of a session to a page. The session stands by."""
        server = scene.server
        arm = session.arm
        self.session = session
        self.session.stand_by(True)
        self.session.hand = lambda: scene.devices.velocity
        self._scene = scene
        self._node = server.scene.add_frame(root, show_axes=False)
        status = self.session.status
        self._drawn_target = status.target
        self.target = TargetControls(server, self.session, root)
        self._label = server.scene.add_label(
            f"{root}/status", describe(status), position=status.target.position + _LABEL_OFFSET_M, anchor="bottom-center"
        )
        self._trail = TipTrail(server.scene, arm.fk(status.q).position, root)
        self._preview = PlanPreview(server, arm, root)
        self.panel = Panel(server, scene.text, self.session, self.target, root)

    def set_visible(self, visible: bool) -> None:
        """Shows or hides everything of this arm in the scene."""
        self._node.visible = visible

    def draw(self) -> None:
        """Draws the arm and its target where they are now."""
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
        text = describe(status)
        if self._label.text != text:
            self._label.text = text
        self._trail.draw()
        self._preview.show(status.path, with_ghost=status.activity is not Activity.AT_TARGET)
        self.panel.update(notice)

    def close(self) -> None:
        """Ends the threads of the panel and of the session."""
        self.panel.close()
        self.session.stop()
