"""Panel: the controls of a session and its status in words and charts."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.latest_worker import LatestWorker
from armctl.sim.realtime import RealTimeSession, Status
from armctl.viewer.charts import Charts
from armctl.viewer.comparison_panel import ComparisonPanel
from armctl.viewer.status_text import describe, describe_load
from armctl.viewer.target_controls import TargetControls

if TYPE_CHECKING:
    import viser

MAX_PAYLOAD_KG = 5.0
_HINT = "Drag an arrow, a plane or an arc of the green target; the arm follows."
_MIN_OVERRIDE_PERCENT = 5.0
_MIN_SPEED = 0.05
_MAX_SPEED = 2.0
_JOINT_SLIDERS_IDLE_S = 0.5  # joint sliders that were not moved for this long show the simulated joints


class Panel:
    """The controls of a session. All pages show the same values, whichever page changed them.

    The callbacks are coroutines: viser runs them at once and in order, and runs plain functions in a pool of 32 threads. The
    values that they read have passed the message filter.
    """

    def __init__(
        self, server: viser.ViserServer, text: viser.GuiMarkdownHandle, session: RealTimeSession, target: TargetControls
    ):
        """Adds the controls of a session to a server's page, with the status in `text`."""
        self._gui = server.gui
        self._event_loop = server.get_event_loop()
        self._session = session
        self._text = text
        self._target = target
        self._joints_moved_at = -np.inf
        self._charts = Charts(server, session.arm.joint_names, session.history.read())
        self._payload_worker = LatestWorker("armctl payload")  # a new payload compiles a model
        self._add_plant()
        self._add_clock()
        target.add_fields()
        self._add_joints()
        self._add_gripper()
        self._comparison = ComparisonPanel(server, session)

    def update(self) -> None:
        """Shows the session's status."""
        status = self._session.status
        samples = self._session.history.read()
        lines = (f"**{describe(status)}**", describe_load(samples, self._session.arm.joint_names), _HINT)
        factor = status.real_time_factor * status.speed
        self._text.content = "\n\n".join(lines) + f"\n\nreal time x {factor:.2f}"
        self._charts.update(samples)
        # On viser's event loop: written by this thread, a value could replace one that a client has just sent, before the
        # callback reads it.
        self._event_loop.call_soon_threadsafe(self._show_values, status)

    def _show_values(self, status: Status) -> None:
        """Shows target and joints in the fields and sliders."""
        self._target.show_values(status)
        if not status.joint_control and time.monotonic() - self._joints_moved_at > _JOINT_SLIDERS_IDLE_S:
            for slider, angle in zip(self._joints, status.q, strict=True):
                slider.value = round(float(angle), 3)

    def close(self) -> None:
        """Ends the panel's threads."""
        self._payload_worker.close()
        self._comparison.close()

    @property
    def charts(self) -> Charts:
        """The charts of errors and torques."""
        return self._charts

    def _add_plant(self) -> None:
        session = self._session
        status = session.status
        controller = self._gui.add_dropdown("controller", tuple(CONTROLLERS), initial_value=status.controller)
        payload = self._gui.add_slider(
            "payload, kg", 0.0, MAX_PAYLOAD_KG, 0.1, status.payload, hint="mass at the tip; the controller does not know it"
        )

        async def set_controller(event: viser.GuiEvent) -> None:
            session.set_controller(controller.value)

        async def set_payload(event: viser.GuiEvent) -> None:
            self._payload_worker.submit(lambda: session.set_payload(payload.value))

        controller.on_update(set_controller)
        payload.on_update(set_payload)

    def _add_clock(self) -> None:
        session = self._session
        avoid = self._gui.add_checkbox("avoid contacts", session.status.avoiding, hint="off for pressing and grasping")
        override = self._gui.add_slider(
            "arm speed, %", _MIN_OVERRIDE_PERCENT, 100.0, 1.0, 100.0, hint="speed override of the arm's motions"
        )
        speed = self._gui.add_slider(
            "simulation speed", _MIN_SPEED, _MAX_SPEED, 0.05, 1.0, hint="simulated seconds per second; 0.1 is slow motion"
        )
        pause = self._gui.add_checkbox("pause", False)
        reset = self._gui.add_button("reset")

        async def set_avoiding(event: viser.GuiEvent) -> None:
            session.set_avoiding(avoid.value)

        async def set_override(event: viser.GuiEvent) -> None:
            session.set_speed_override(0.01 * override.value)

        async def set_speed(event: viser.GuiEvent) -> None:
            session.set_speed(speed.value)

        async def set_pause(event: viser.GuiEvent) -> None:
            session.pause(pause.value)

        async def do_reset(event: viser.GuiEvent) -> None:
            session.reset()

        avoid.on_update(set_avoiding)
        override.on_update(set_override)
        speed.on_update(set_speed)
        pause.on_update(set_pause)
        reset.on_click(do_reset)

    def _add_joints(self) -> None:
        session = self._session
        limits = session.arm.limits
        low = np.maximum(limits.q_min, -2 * np.pi)
        high = np.minimum(limits.q_max, 2 * np.pi)
        with self._gui.add_folder("Joints, rad (m for a slide)", expand_by_default=False):
            self._joints = [
                self._gui.add_slider(name, float(low[i]), float(high[i]), 0.001, float(session.status.q[i]))
                for i, name in enumerate(session.arm.joint_names)
            ]

        async def move_joints(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._joints_moved_at = time.monotonic()
                session.move_joints(np.array([slider.value for slider in self._joints]))

        for slider in self._joints:
            slider.on_update(move_joints)

    def _add_gripper(self) -> None:
        session = self._session
        width = session.status.gripper_width
        if width is None or session.gripper_width_max is None:
            return
        max_mm = float(np.floor(1e3 * session.gripper_width_max))
        slider = self._gui.add_slider("gripper, mm", 0.0, max_mm, 1.0, min(max_mm, float(round(1e3 * width))))

        async def grip(event: viser.GuiEvent) -> None:
            session.grip(1e-3 * slider.value)

        slider.on_update(grip)
