"""A real-time session in MuJoCo's own viewer, on a machine with a screen. Ctrl and right-drag move the target."""

import contextlib
import os
import sys
import threading
import time

import mujoco

from armctl.core.errors import NotInstalledError
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.target_marker import find_target, is_movable, read_target, set_target
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Status
from armctl.view.status_text import describe

_DRAW_INTERVAL_S = 1 / 60
_CLOSE_TIMEOUT_S = 5.0


def view_natively(arm: Arm, controller: str) -> None:
    """Runs a session in a window until that is closed, or Ctrl-C."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise NotInstalledError("MuJoCo's own viewer needs a screen; without --native the page opens in a browser")
    import mujoco.viewer

    session = RealTimeSession(arm, controller)
    model = arm.model
    data = mujoco.MjData(model)
    status = session.status
    _show(status, model, data)
    set_target(model, data, status.target.position, status.target.quat)
    session.prepare()
    session.start()
    other_threads = set(threading.enumerate())
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),
            mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window,
        ):
            window.perturb.select = find_target(model) or 0
            is_held = False
            while window.is_running():
                status = session.status
                with window.lock():
                    target = read_target(model, data) if is_movable(model) else status.target
                    was_held = is_held
                    is_held = bool(window.perturb.active)
                    _show(status, model, data)
                if target != status.target or (was_held and not is_held):
                    session.aim(target, held=is_held)
                window.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, describe(status, is_held=is_held), ""))
                window.sync()
                time.sleep(_DRAW_INTERVAL_S)
    finally:
        for thread in set(threading.enumerate()) - other_threads:  # the window's threads must not draw while Python ends
            thread.join(timeout=_CLOSE_TIMEOUT_S)
        session.stop()


def _show(status: Status, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qpos[:] = status.qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
