"""A simulated robot that writes what it is sent and what it measures to a file, from the process that streams."""

import time
from pathlib import Path

import numpy as np

import armctl


class RecordedPlant(armctl.links.PlantLink):
    """It writes rows of float64: the time, s, positions, rad, speeds, rad/s, and torques, N m, (n,) each.

    Its time stands still where the computer is busy, so that no tick is lost.
    """

    def __init__(self, arm: armctl.Arm, path: Path | str, **options):
        """A link as `PlantLink` makes it, and a file."""
        super().__init__(arm, real_time=True, **options)
        self._path = Path(path)

    def wait(self) -> tuple[int, armctl.links.Reading]:
        self._due = time.monotonic()
        return super().wait()

    def send_torques(self, tau: np.ndarray, last: bool) -> None:
        super().send_torques(tau, last)
        robot = self._opened()
        state = robot.stepper.state
        with self._path.open("ab") as file:
            file.write(np.concatenate([[self.dt * robot.tick], state.q, state.v, tau]).tobytes())
