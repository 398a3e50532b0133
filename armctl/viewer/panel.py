"""Panel: the controls of a session and its status in words and charts."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.sim.realtime import RealTimeSession, Status
from armctl.viewer.charts import Charts
from armctl.viewer.comparison_panel import ComparisonPanel
from armctl.viewer.latest_worker import LatestWorker
from armctl.viewer.status_text import describe

if TYPE_CHECKING:
    import viser

MAX_PAYLOAD_KG = 5.0
_MIN_SPEED = 0.05
_MAX_SPEED = 2.0
_JOINT_SLIDERS_IDLE_S = 0.5  # joint sliders that were not moved for this long show the simulated joints
_ROUNDING = 5e-4  # fields show three decimals


class Panel:
    """The controls of a session. All pages show the same values, whichever page changed them.

    The callbacks are coroutines: viser runs them at once and in order, and runs plain functions in a pool of 32 threads. The
    values that they read have passed the message filter.
    """

    def __init__(self, server: viser.ViserServer, text: viser.GuiMarkdownHandle, session: RealTimeSession):
        """Adds the controls of a session to a server's page, with the status in `text`."""
        self._gui = server.gui
        self._event_loop = server.get_event_loop()
        self._session = session
        self._text = text
        self._shown_target = session.status.target
        self._joints_moved_at = -np.inf
        self._charts = Charts(server, session.arm.joint_names, session.history.read())
        self._payload_worker = LatestWorker("armctl payload")  # a new payload compiles a model
        self._add_plant()
        self._add_clock()
        self._add_target()
        self._add_joints()
        self._add_gripper()
        self._comparison = ComparisonPanel(server, session)

    def update(self) -> None:
        """Shows the session's status."""
        status = self._session.status
        factor = status.real_time_factor * status.speed
        self._text.content = f"**{describe(status)}**\n\nreal time x {factor:.2f}"
        self._charts.update(self._session.history.read())
        # On viser's event loop: written by this thread, a value could replace one that a client has just sent, before the
        # callback reads it.
        self._event_loop.call_soon_threadsafe(self._show_values, status)

    def _show_values(self, status: Status) -> None:
        """Shows target and joints in the fields and sliders."""
        if status.target is not self._shown_target:  # otherwise a number that is being typed would be overwritten
            self._shown_target = status.target
            _show(self._position, status.target.position)
            _show(self._rpy, np.degrees(status.target.rpy))
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

    def _add_target(self) -> None:
        session = self._session
        status = session.status
        with self._gui.add_folder("Target"):
            self._position = self._gui.add_vector3("position, m", _rounded(status.target.position), step=0.001)
            self._rpy = self._gui.add_vector3("roll, pitch, yaw, deg", _rounded(np.degrees(status.target.rpy)), step=1.0)
            oriented = self._gui.add_checkbox("orientation counts", status.oriented)

        async def aim(event: viser.GuiEvent) -> None:
            if event.client is not None:
                session.aim(Pose(self._position.value, rpy=np.radians(self._rpy.value)))

        async def set_oriented(event: viser.GuiEvent) -> None:
            session.set_oriented(oriented.value)

        self._position.on_update(aim)
        self._rpy.on_update(aim)
        oriented.on_update(set_oriented)

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
        speed = self._gui.add_slider("speed", _MIN_SPEED, _MAX_SPEED, 0.05, 1.0, hint="simulated seconds per second")
        pause = self._gui.add_checkbox("pause", False)
        reset = self._gui.add_button("reset")

        async def set_speed(event: viser.GuiEvent) -> None:
            session.set_speed(speed.value)

        async def set_pause(event: viser.GuiEvent) -> None:
            session.pause(pause.value)

        async def do_reset(event: viser.GuiEvent) -> None:
            session.reset()

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


def _show(field: viser.GuiVector3Handle, value: Array) -> None:
    """Writes a value that differs from what the field shows."""
    if np.abs(np.array(field.value) - value).max() > _ROUNDING:
        field.value = _rounded(value)


def _rounded(value: Array) -> tuple[float, float, float]:
    x, y, z = np.round(value, 3).tolist()
    return x, y, z
