"""Viewer: shows a simulation in the browser while it runs, at the speed of the wall clock."""

import sys
import threading
import time

import mujoco
import numpy as np

from armctl.model.arm.arm import Arm
from armctl.view.plan_preview import RobotDrawing
from armctl.view.realtime.clock import RealTimeClock
from armctl.view.web_scene import PORT, WebScene

_TEXT_INTERVAL_S = 0.2
_BROWSER_TIMEOUT_S = 8.0
_FRAME_HEIGHT_PX = 600


class Viewer:
    """The page of a simulation. It observes the simulation's tick loop.

    Attributes:
        interval: Simulated time between two drawn states, s.
        url: Address of the page.
        clock: The page's clock; `clock.speed = 0.2` is slow motion.
    """

    interval = 0.01

    def __init__(self, arm: Arm, port: int = PORT):
        """Opens a page, and a browser where there is a screen.

        Args:
            port: Port of the page; the next free one if it is taken, any free one if 0.

        Raises:
            NotInstalledError: viser or mjviser is missing.
            InputError: The port is not a port.
        """
        ipython = sys.modules.get("IPython")
        in_notebook = ipython is not None and hasattr(ipython.get_ipython(), "kernel")
        self.scene = WebScene(port, title=f"{arm.name} - armctl", in_notebook=in_notebook)
        self.clock = RealTimeClock()
        self.url = self.scene.url
        self._arm = arm
        self._text_written_at = -np.inf
        browser_opens = not in_notebook and self.scene.open_browser()
        self.scene.set(arm)
        self.scene.text.content = "waiting for a move"
        print(f"armctl: {arm.name} is at {self.url}", file=sys.stderr)
        if browser_opens:
            self.scene.wait_for_client(_BROWSER_TIMEOUT_S)

    @property
    def real_time_factor(self) -> float:
        """1 if the simulation keeps up with the clock."""
        return self.clock.real_time_factor

    def _repr_html_(self) -> str:
        """The page in a frame, for a notebook of this machine. Elsewhere browsers refuse to show it."""
        return f'<iframe src="{self.url}" title="armctl viewer" width="100%" height="{_FRAME_HEIGHT_PX}"></iframe>'

    def wait(self) -> None:
        """Keeps the page open until Ctrl-C."""
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        self.scene.close()

    def drawing_of_robot(self, name: str) -> RobotDrawing:
        """What draws a robot of this name on the page, in place of a simulation."""
        return RobotDrawing(self.scene, self._arm, name)

    def after_reset(self, data: mujoco.MjData) -> None:
        self._show(data)

    def before_run(self) -> None:
        """Starts the clock, unless the last run ended a moment ago."""
        self.clock.resume()

    def after_ticks(self, data: mujoco.MjData, seconds: float) -> None:
        """Shows the state after `seconds` of simulated time, and waits for the wall clock."""
        self._show(data)
        self.clock.wait(seconds)

    def _show(self, data: mujoco.MjData) -> None:
        self.scene.show(data.qpos, data.mocap_pos, data.mocap_quat)
        if time.monotonic() - self._text_written_at > _TEXT_INTERVAL_S:
            self._text_written_at = time.monotonic()
            self.scene.text.content = f"**{self._arm.name}**\n\nt = {data.time:.1f} s, real time x {self.real_time_factor:.2f}"
