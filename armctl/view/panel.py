"""Panel: the controls of a session and its status in words and charts."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from armctl.control import CONTROLLERS
from armctl.core.latest_worker import LatestWorker
from armctl.core.validation import Array
from armctl.report.render.stick_figure import NO_SHAPES, has_shapes
from armctl.view.charts import Charts
from armctl.view.drawings import ContactArrows
from armctl.view.long_panels import ComparisonPanel, ReachabilityPanel
from armctl.view.picture_panel import PicturePanel
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Activity, Status
from armctl.view.status_text import describe, describe_contacts, is_only_orientation_out_of_reach, readings
from armctl.view.target_controls import TargetControls, on_value

if TYPE_CHECKING:
    import viser

MAX_PAYLOAD_KG = 5.0
_HINT = "*Drag an arrow, a plane or an arc of the green target; the arm follows.*"
_ORIENTATION_HINT = '*Turn the target by its arcs, or switch off "orientation counts" under "Target".*'
_REFUSED_HINT = '*Drag the target to another place, or click "undo" under "Target".*'
_HOME = "home"
_PLAY = "play"
_PAUSE = "pause"
_RESET = "reset"
_MIN_OVERRIDE_PERCENT = 5.0
_MIN_PLAY_SPEED = 0.05
_MAX_SPEED = 2.0
_JOINT_SLIDERS_IDLE_S = 0.5  # joint sliders that were not moved for this long show the simulated joints


class Panel:
    """The controls of a session, the same on all pages; callbacks are coroutines, which viser runs in order."""

    def __init__(
        self,
        server: viser.ViserServer,
        text: viser.GuiMarkdownHandle,
        session: RealTimeSession,
        targets: Mapping[str, TargetControls],
        root: str,
        choose: Callable[[str], None],
    ):
        """Adds the controls of a session to a server's page, with the status in `text`; drawings go below the node `root`.

        Of several tips, the controls of each are in a folder of its own, and only those of one are shown; `choose` is called
        with the name of another.
        """
        self._gui = server.gui
        self._event_loop = server.get_event_loop()
        self._session = session
        self._text = text
        self._targets = targets
        self._shape_note = "" if has_shapes(session.arm) else f"*{NO_SHAPES[0].upper()}{NO_SHAPES[1:]}.*"
        self._joints_moved_at = -np.inf
        self._joint_command: Array | None = None
        self._payload_worker = LatestWorker("armctl payload")  # a new payload compiles a model
        self._contact_arrows = ContactArrows(server.scene, root)
        self._readings = server.gui.add_html("")
        self._add_clock()
        self._add_plant()
        self._add_motion()
        self._comparison = ComparisonPanel(server, session)  # near the top, so that its table opens in the window
        with server.gui.add_folder("Charts"):
            self.charts = Charts(server, session.arm.joint_names, session.history.read())
        self._add_tip_choice(choose)
        self._tip_folders: dict[str, viser.GuiFolderHandle] = {}
        for tip in self._in_tip_folders():
            targets[tip].add_fields()
        self._add_joints()
        for tip in self._in_tip_folders():
            self._add_gripper(tip)
        self._reachability = [ReachabilityPanel(server, session.arm, root, tip) for tip in self._in_tip_folders()]
        self.pictures = PicturePanel(server, session)

    def show_tip(self, tip: str) -> None:
        """Shows the controls of one tip of several."""
        for name, folder in self._tip_folders.items():
            folder.visible = name == tip
        if self._chosen is not None:
            self._chosen.value = tip

    def update(self, status: Status, notice: str = "", *, is_held: bool = False) -> None:
        samples = self._session.history.read()
        refused = status.activity in (Activity.BLOCKED, Activity.OUT_OF_REACH)
        hint = _ORIENTATION_HINT if is_only_orientation_out_of_reach(status) else _REFUSED_HINT if refused else _HINT
        lines = [
            notice,
            f"**{describe(status, is_held=is_held)}**",
            describe_contacts(status),
            hint,
            self._shape_note,
        ]
        self._text.content = "\n\n".join(line for line in lines if line)
        self._readings.content = readings(samples, self._session.arm.joint_names, status.real_time_factor * status.speed)
        self._contact_arrows.show(status.contacts)
        self.charts.update(samples)
        # On viser's event loop: written by this thread, a value could replace one that a client has just sent, before the
        # callback reads it.
        self._event_loop.call_soon_threadsafe(self._show_values, status)

    def _show_values(self, status: Status) -> None:
        for target in self._targets.values():
            target.show_values(status)
        if not status.joint_control and time.monotonic() - self._joints_moved_at > _JOINT_SLIDERS_IDLE_S:
            for slider, angle in zip(self._joints, status.q, strict=True):
                slider.value = round(float(angle), 3)

    def close(self) -> None:
        self._payload_worker.close()
        for panel in self._reachability:
            panel.close()
        self.pictures.close()
        self._comparison.close()

    def _add_plant(self) -> None:
        session = self._session
        controller = self._gui.add_dropdown("controller", tuple(CONTROLLERS), initial_value=session.status.controller)
        payload = self._gui.add_slider(
            "payload, kg", 0.0, MAX_PAYLOAD_KG, 0.1, session.status.payload, hint="mass at the tip, unknown to the controller"
        )

        on_value(controller, session.set_controller)
        on_value(payload, lambda mass: self._payload_worker.submit(lambda: session.set_payload(mass)))

    def _add_clock(self) -> None:
        session = self._session
        keyframe = None
        others = tuple(name for name in session.keyframes if name != _HOME)
        if others:
            keyframe = self._gui.add_dropdown("reset to", (_HOME, *others), initial_value=_HOME, hint="a keyframe of the scene")
        time_buttons = self._gui.add_button_group("time", (_PLAY, _PAUSE, _RESET))

        async def change_time(event: viser.GuiEvent) -> None:
            if time_buttons.value == _RESET:
                session.reset("" if keyframe is None or keyframe.value == _HOME else keyframe.value)
            else:
                session.pause(time_buttons.value == _PAUSE)

        time_buttons.on_click(change_time)

    def _add_motion(self) -> None:
        session = self._session
        override = self._gui.add_slider(
            "arm speed, %", _MIN_OVERRIDE_PERCENT, 100.0, 1.0, 100.0, hint="speed override of the arm's motions"
        )
        speed = self._gui.add_slider(
            "simulation speed", _MIN_PLAY_SPEED, _MAX_SPEED, 0.05, 1.0, hint="simulated seconds per second; 0.1 is slow motion"
        )
        avoid = self._gui.add_checkbox("avoid contacts", session.status.avoiding, hint="off for pressing and grasping")
        contacts = self._gui.add_checkbox("contact forces", False, hint="arrows, 1 cm per N, at most 30 cm")

        async def show_contacts(event: viser.GuiEvent) -> None:
            self._contact_arrows.visible = contacts.value

        on_value(avoid, session.set_avoiding)
        on_value(override, lambda percent: session.set_speed_override(0.01 * percent))
        on_value(speed, session.set_speed)
        contacts.on_update(show_contacts)

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
            joint = self._gui.add_dropdown("joint", session.arm.joint_names)
            step = self._gui.add_slider("joint step", 0.01, 0.5, 0.01, 0.1, hint="rad, or m for a slide joint")
            jog = self._gui.add_button_group("jog", ("-", "+"))

        async def move_joints(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._command_joints(np.array([slider.value for slider in self._joints]))

        async def jog_joint(event: viser.GuiEvent) -> None:
            status = session.status
            is_steered = status.joint_control or time.monotonic() - self._joints_moved_at < _JOINT_SLIDERS_IDLE_S
            q = np.array(self._joint_command if is_steered and self._joint_command is not None else status.q)
            q[session.arm.joint_names.index(joint.value)] += step.value if jog.value == "+" else -step.value
            self._command_joints(q)

        jog.on_click(jog_joint)
        for slider in self._joints:
            slider.on_update(move_joints)

    def _command_joints(self, q: Array) -> None:
        self._joints_moved_at = time.monotonic()
        self._joint_command = self._session.arm.limits.clamp(q)
        self._session.move_joints(self._joint_command)

    def _add_tip_choice(self, choose: Callable[[str], None]) -> None:
        """A list of several tips to choose from."""
        tips = self._session.arm.tips
        self._chosen = None
        if len(tips) > 1:
            self._chosen = self._gui.add_dropdown("tip", tips, hint="whose target and gripper are below; or drag its target")
            on_value(self._chosen, choose)

    def _in_tip_folders(self) -> Iterator[str]:
        """The tips, each with the folder for its controls entered, if there are several."""
        tips = self._session.arm.tips
        for tip in tips:
            if len(tips) > 1 and tip not in self._tip_folders:
                self._tip_folders[tip] = self._gui.add_folder(tip)
            with self._tip_folders.get(tip, contextlib.nullcontext()):
                yield tip

    def _add_gripper(self, tip: str) -> None:
        session = self._session
        if tip not in session.gripper_width_max:
            return
        max_mm = float(np.floor(1e3 * session.gripper_width_max[tip]))
        width_mm = min(max_mm, float(round(1e3 * session.status.gripper_widths[tip])))
        slider = self._gui.add_slider("gripper, mm", 0.0, max_mm, 1.0, width_mm)
        on_value(slider, lambda width: session.grip(1e-3 * width, tip))
