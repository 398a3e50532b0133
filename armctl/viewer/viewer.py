"""Viewer: whatever a simulation does is seen in the browser, at the speed of the clock on the wall."""

from __future__ import annotations

import sys
import threading
import time

import mujoco

from armctl.robot.arm import Arm
from armctl.sim.clock import RealTimeClock
from armctl.viewer.web_scene import PORT, WebScene

_WORDS = 0.2  # s between words
_PATIENCE = 8.0  # s that the browser may take to open


class Viewer:
    """The page that a simulation is seen on.

    Attributes:
        interval: s of simulated time between what is shown.
        url: Where it is.
        pace: Its clock; `pace.speed` makes slow motion of it.
    """

    interval = 0.01

    def __init__(self, arm: Arm, port: int = PORT):
        """Opens a page, and a browser where there is a screen.

        Args:
            arm: The arm.
            port: Where to serve; the next free one if it is taken, any if 0.

        Raises:
            NotInstalledError: viser or mjviser is missing.
        """
        self._stage, self.pace = WebScene(port), RealTimeClock()
        self.url, self._name, self._spoken = self._stage.url, arm.name, 0.0
        coming = self._stage.open_browser()
        self._stage.set(arm)
        self._stage.words.content = "waiting for a move"
        print(f"armctl: {arm.name} is at {self.url}", file=sys.stderr)
        if coming:
            self._stage.wait_for_someone(_PATIENCE)

    @property
    def real_time_factor(self) -> float:
        """1 where the simulation keeps up with the clock."""
        return self.pace.real_time_factor

    def wait(self) -> None:
        """Keeps the page until Ctrl-C."""
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Takes the page away."""
        self._stage.close()

    def after_reset(self, data: mujoco.MjData) -> None:
        """Shows the new state.

        Args:
            data: The plant's state.
        """
        self._show(data)

    def before_run(self) -> None:
        """Starts the clock, unless the last run ended a moment ago."""
        self.pace.resume()

    def after_ticks(self, data: mujoco.MjData, seconds: float) -> None:
        """Shows the state, and waits until it is time.

        Args:
            data: The plant's state.
            seconds: Simulated time since the last call, s.
        """
        self._show(data)
        self.pace.wait(seconds)

    def _show(self, data: mujoco.MjData) -> None:
        self._stage.show(data.qpos, data.mocap_pos, data.mocap_quat)
        if time.monotonic() - self._spoken > _WORDS:
            self._spoken = time.monotonic()
            self._stage.words.content = f"**{self._name}**\n\nt = {data.time:.1f} s, real time x {self.real_time_factor:.2f}"
