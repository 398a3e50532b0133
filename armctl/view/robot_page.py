"""RobotPage: a robot on a web page, beside its last command, which a visitor's hand moves as long as it holds on."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.errors import ArmctlError
from armctl.core.pose import Pose, rotation_vector
from armctl.core.validation import Array
from armctl.run.links.robot import Robot
from armctl.view.plan_preview import RobotDrawing
from armctl.view.target_controls import GIZMO_SIZE_M
from armctl.view.web_scene import PORT, WebScene

if TYPE_CHECKING:
    import viser

_SHOW_INTERVAL_S = 0.05
_RENEWAL_S = 0.04
_DRAG_LIFETIME_S = 0.5  # without a motion of the mouse, a drag has ended
_APPROACH_S = 0.3  # in which the tip would reach a handle at its first speed
_MAX_DRAG_SPEED = 0.1  # m/s
_MAX_DRAG_TURN = 0.5  # rad/s


class RobotPage:
    """A robot on a page: as it measures itself, and as a ghost where it was commanded to be.

    It moves while one visitor holds a key, a button or a handle, and brakes when that ends. Each motion is proved and checked.
    """

    def __init__(self, robot: Robot, scene: WebScene):
        self.robot = robot
        self.scene = scene
        self._closing = threading.Event()
        self._reason = ""
        self._wants_recovery = False
        self._holder: int | None = None
        self._handle: Pose | None = None
        self._dragged_at = 0.0
        scene.set(robot.arm)
        self._drawing = RobotDrawing(scene, robot.arm, robot.link.name)
        self._gizmo = scene.server.scene.add_transform_controls("/hand", scale=GIZMO_SIZE_M, depth_test=False)
        self._gizmo.on_update(self._dragged)
        recover = scene.server.gui.add_button("recover", hint="clears a fault: only if the robot may move again")
        recover.on_click(self._recover)

    def serve(self) -> None:
        """Shows the robot, and moves it while a hand asks for it, until `close`."""
        while not self._closing.wait(_SHOW_INTERVAL_S):
            try:
                if self._wants_recovery:
                    self._wants_recovery = False
                    self.robot.recover()
                if self._asked(self.robot.tip) is not None and not self.robot.fault:
                    self._move()
                self._show(None)
            except ArmctlError as error:
                self._reason = str(error)

    def close(self) -> None:
        self._closing.set()

    def _move(self) -> None:
        self._reason = ""
        with self.robot.streaming() as run:
            while not self._closing.is_set() and not self._reason:
                velocity = self._asked(self.robot.arm.fk(run.stream.setpoint.q))
                if velocity is None:
                    break
                run.stream.push_twist(*velocity)
                self._reason = run.advance(_RENEWAL_S)
                self._show(run.stream.setpoint.q)
            obstacle = run.stream.report.obstacle
            run.stream.stop()
            self._reason = self._reason or run.advance(_RENEWAL_S) or obstacle

    def _asked(self, tip: Pose) -> tuple[Array, Array] | None:
        """The velocity of the tip that a visitor's hand asks for; None if none does."""
        handle = self._handle
        if self._holder not in self.scene.server.get_clients() or time.monotonic() - self._dragged_at > _DRAG_LIFETIME_S:
            handle = None
            self._holder = None
        velocity = self.scene.devices.velocity
        if velocity is not None or handle is None:
            return velocity
        linear = (handle.position - tip.position) / _APPROACH_S
        angular = rotation_vector(handle.rotation @ tip.rotation.T) / _APPROACH_S
        if self.robot.arm.n < 6:  # it cannot choose its orientation
            angular = np.zeros(3)
        return _shortened(linear, _MAX_DRAG_SPEED), _shortened(angular, _MAX_DRAG_TURN)

    def _show(self, q_ref: Array | None) -> None:
        """Draws the robot where it measures itself, and the ghost where it was commanded to be while it moves."""
        q = self.robot.state.q
        if self._holder is None:
            tip = self.robot.tip
            self._gizmo.position = tip.position
            self._gizmo.wxyz = tip.quat
        state = self.robot.fault or self._reason or ("moves" if q_ref is not None else "stands")
        self._drawing.show(q, q_ref, state)

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        if self._holder not in (None, event.client_id):
            return
        self._holder = None if event.phase == "end" else event.client_id
        self._handle = Pose(event.target.position, quat=event.target.wxyz)
        self._dragged_at = time.monotonic()

    async def _recover(self, event: viser.GuiEvent) -> None:
        self._wants_recovery = event.client is not None


def view_robot(robot: Robot, *, port: int = PORT, host: str | None = None, token: str | None = None) -> None:
    """Serves a page with an open robot, which stays open, until Ctrl-C. Address and token are as for `view`."""
    scene = WebScene(port, host, token, title=f"{robot.link.name} - armctl")
    try:
        print(f"{robot.link.name} is at {scene.url}; Ctrl-C ends it", flush=True)
        scene.open_browser()
        RobotPage(robot, scene).serve()
    except KeyboardInterrupt:
        pass
    finally:
        scene.close()


def _shortened(x: Array, longest: float) -> Array:
    return x * min(1.0, longest / max(float(np.linalg.norm(x)), 1e-9))
