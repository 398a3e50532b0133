"""Panel: all that can be changed about a session, and what it says."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.sim.gripper import Gripper
from armctl.sim.realtime import RealTimeSession
from armctl.viewer.charts import Charts
from armctl.viewer.comparison_panel import ComparisonPanel

if TYPE_CHECKING:
    import viser

PAYLOAD_MAX = 5.0  # kg
_HANDS_OFF = 0.5  # s after which sliders that nobody moves show where the joints are


class Panel:
    """The controls of a session. What one page changes, all pages show."""

    def __init__(self, server: viser.ViserServer, words: viser.GuiMarkdownHandle, session: RealTimeSession):
        """Adds the controls to the page.

        Args:
            server: The page's server.
            words: Where it says how things stand.
            session: What they control.
        """
        self._gui, self._session, self._told, self._touched = server.gui, session, session.target, 0.0
        self._words = words
        self._charts = Charts(server, session.arm.joint_names, session.history.read())
        self._add_plant()
        self._add_clock()
        self._add_target()
        self._add_joints()
        if session.gripper is not None:
            self._add_gripper(session.gripper)
        ComparisonPanel(server, session)

    def update(self) -> None:
        """Says how things stand."""
        session = self._session
        self._words.content = f"**{session.status}**\n\nreal time x {session.real_time_factor * session.pace.speed:.2f}"
        self._charts.update(session.history.read())
        if session.target is not self._told:  # else what somebody is just typing would be overwritten
            self._told = session.target
            _tell(self._position, self._told.position)
            _tell(self._rpy, np.degrees(self._told.rpy))
        if not session.steered and time.monotonic() - self._touched > _HANDS_OFF:
            for slider, angle in zip(self._joints, session.q, strict=True):
                slider.value = round(float(angle), 3)

    def _add_target(self) -> None:
        session, gui = self._session, self._gui
        with gui.add_folder("Target"):
            self._position = gui.add_vector3("position, m", _rounded(session.target.position), step=0.001)
            self._rpy = gui.add_vector3("roll, pitch, yaw, deg", _rounded(np.degrees(session.target.rpy)), step=1.0)
            oriented = gui.add_checkbox("orientation counts", session.oriented)

        async def aim(event) -> None:
            if event.client is not None:
                session.aim(Pose(self._position.value, rpy=np.radians(self._rpy.value)))

        self._position.on_update(aim)
        self._rpy.on_update(aim)
        oriented.on_update(lambda event: session.orient(oriented.value))

    def _add_plant(self) -> None:
        session, gui = self._session, self._gui
        controller = gui.add_dropdown("controller", tuple(CONTROLLERS), initial_value=session.controller)
        payload = gui.add_slider(
            "payload, kg", 0.0, PAYLOAD_MAX, 0.1, session.payload, hint="held at the tip; no controller is told of it"
        )
        controller.on_update(lambda event: session.control_by(controller.value))
        payload.on_update(lambda event: session.carry(payload.value))

    def _add_clock(self) -> None:
        session, gui = self._session, self._gui
        speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 1.0, hint="simulated seconds a second")
        pause = gui.add_checkbox("pause", False)
        reset = gui.add_button("reset")

        def change(event) -> None:
            session.pace.speed = speed.value

        speed.on_update(change)
        pause.on_update(lambda event: session.pause(pause.value))
        reset.on_click(lambda event: session.reset())

    def _add_joints(self) -> None:
        session, gui, limits = self._session, self._gui, self._session.arm.limits
        low, high = np.maximum(limits.q_min, -2 * np.pi), np.minimum(limits.q_max, 2 * np.pi)
        with gui.add_folder("Joints, rad (m for a slide)", expand_by_default=False):
            self._joints = [
                gui.add_slider(name, float(low[i]), float(high[i]), 0.001, float(session.q[i]))
                for i, name in enumerate(session.arm.joint_names)
            ]

        async def steer(event) -> None:
            if event.client is not None:
                self._touched = time.monotonic()
                session.steer(_values(self._joints))

        for slider in self._joints:
            slider.on_update(steer)

    def _add_gripper(self, gripper: Gripper) -> None:
        most = float(np.floor(1e3 * gripper.width_max))
        width = self._gui.add_slider("gripper, mm", 0.0, most, 1.0, min(most, float(round(1e3 * gripper.width))))
        width.on_update(lambda event: self._session.grip(1e-3 * width.value))


def _values(sliders: Sequence[viser.GuiSliderHandle[float]]) -> Array:
    return np.array([slider.value for slider in sliders])


def _tell(field: viser.GuiVector3Handle, value: Array) -> None:
    """Writes a value that is not the field's own already."""
    if np.abs(np.array(field.value) - value).max() > 5e-4:
        field.value = _rounded(value)


def _rounded(value: Array) -> tuple[float, float, float]:
    x, y, z = np.round(value, 3).tolist()
    return x, y, z
