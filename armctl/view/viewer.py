"""Viewer: whatever a simulation does is seen in the browser, at the speed of the clock on the wall."""

from __future__ import annotations

import sys
import threading
import time

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import Controller
from armctl.core.trajectory import TickReference
from armctl.plant import Plant
from armctl.recorder import Recorder
from armctl.rig import Rig
from armctl.robot.arm import Arm
from armctl.view.pace import Pace
from armctl.view.stage import PORT, Stage

_INTERVAL = 0.01  # s between what is shown
_WORDS = 0.2  # s between words
_PATIENCE = 8.0  # s that the browser may take to open


class Viewer:
    """The page that a simulation is seen on.

    Attributes:
        url: Where it is.
        pace: Its clock; `pace.speed` makes slow motion of it.
    """

    def __init__(self, arm: Arm, port: int = PORT):
        """Opens a page, and a browser where there is a screen.

        Args:
            arm: The arm.
            port: Where to serve; the next free one if it is taken, any if 0.

        Raises:
            NotInstalledError: viser or mjviser is missing.
        """
        self._stage, self.pace = Stage(port), Pace()
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

    def show(self, rig: Rig) -> None:
        """Shows what a rig is doing.

        Args:
            rig: The simulated arm.
        """
        data = rig.data
        self._stage.show(data.qpos, data.mocap_pos, data.mocap_quat)
        if time.monotonic() - self._spoken > _WORDS:
            self._spoken = time.monotonic()
            self._stage.words.content = f"**{self._name}**\n\nt = {data.time:.1f} s, real time x {self.real_time_factor:.2f}"


class WatchedRig(Rig):
    """A rig that is seen. What it computes is the same to the last bit; it only takes its time.

    Attributes:
        viewer: The page.
    """

    def __init__(self, arm: Arm, plant: Plant):
        """A watched rig with the arm at home, at rest.

        Args:
            arm: The arm.
            plant: How reality differs from it.

        Raises:
            NotInstalledError: viser or mjviser is missing.
        """
        self.viewer = Viewer(arm)
        super().__init__(arm, plant)

    def reset(self, q: ArrayLike, v: ArrayLike) -> None:
        """Starts afresh at t = 0.

        Args:
            q: (n,) rad where the arm is.
            v: (n,) rad/s how it moves.

        Raises:
            InputError: A wrong length or a number that is not finite.
        """
        super().reset(q, v)
        self.viewer.show(self)

    def follow(self, controller: Controller, reference: TickReference, recorder: Recorder) -> None:
        """The tick loop, a few ticks at a time, each shown when its time has come.

        Args:
            controller: What makes the torques.
            reference: Where the arm should be, tick by tick.
            recorder: What it is recorded in.

        Raises:
            SimulationError: As for `Rig.follow`.
        """
        ticks = max(1, round(_INTERVAL / self.dt))
        self.viewer.pace.resume()
        for first in range(0, len(reference.q), ticks):
            part = TickReference(*(np.asarray(column)[first : first + ticks] for column in reference))
            super().follow(controller, part, recorder)
            self.viewer.show(self)
            self.viewer.pace.wait(len(part.q) * self.dt)
            if self.end:
                return
