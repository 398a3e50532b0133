"""Native: the session in MuJoCo's own viewer, on a machine with a screen. Ctrl and right-drag move the target."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time

import mujoco

from armctl.core.errors import NotInstalledError
from armctl.mjmodel.target_marker import find_target, is_movable, read_target, set_target
from armctl.robot.arm import Arm
from armctl.sim.realtime import RealTimeSession

_INTERVAL = 1 / 60  # s between drawings
_PATIENCE = 5.0  # s for the window to close


def view_natively(arm: Arm, controller: str) -> None:
    """Runs a session in a window until that is closed, or Ctrl-C.

    Args:
        arm: The arm.
        controller: The name of the controller.

    Raises:
        NotInstalledError: There is no screen.
        UnknownNameError: There is no such controller.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise NotInstalledError("there is no screen for MuJoCo's own viewer here; without --native a browser will do")
    import mujoco.viewer

    session, model, data = RealTimeSession(arm, controller), arm.model, mujoco.MjData(arm.model)
    _show(session, model, data)
    set_target(model, data, session.target.position, session.target.quat)
    session.start()
    others = set(threading.enumerate())
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),
            mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window,
        ):
            window.perturb.select = find_target(model) or 0
            while window.is_running():
                with window.lock():
                    wanted = read_target(model, data) if is_movable(model) else session.target
                    _show(session, model, data)
                if wanted != session.target:
                    session.aim(wanted)
                window.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, session.status, ""))
                window.sync()
                time.sleep(_INTERVAL)
    finally:
        for thread in set(threading.enumerate()) - others:  # the window's: it must not draw on while Python ends
            thread.join(timeout=_PATIENCE)
        session.stop()


def _show(session: RealTimeSession, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qpos[:] = session.shown
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
