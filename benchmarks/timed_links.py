"""Links that note how long each tick takes from the reading of the robot until its torques are sent."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import armctl
from armctl.run.links.torque_interface import TorqueLink

_PROBES = 1  # streams at first, which measure the delay of the link and have no law


class TickTimes:
    """The computing time of each tick under a law, and the torques that were sent; for a file, as a link is in a process."""

    def __init__(self, path: Path):
        self.path = path
        self._streams = 0
        self._begun = 0.0  # s of the clock
        self._seconds: list[float] = []
        self._sent: list[np.ndarray] = []  # (n,) N m each; NaN between two streams

    def begin_stream(self) -> None:
        self._streams += 1
        if self._sent:
            self._sent.append(np.full_like(self._sent[-1], np.nan))

    def begin_tick(self) -> None:
        self._begun = time.perf_counter()

    def end_tick(self, tau: np.ndarray) -> None:
        if self._streams > _PROBES:
            self._seconds.append(time.perf_counter() - self._begun)
            self._sent.append(np.array(tau))

    def write(self) -> None:
        np.savez(self.path, seconds=np.array(self._seconds), sent=np.array(self._sent))


class _Timed(armctl.links.Link, TorqueLink):
    """What both links have in common. It stands before the link in a list of bases, whose methods it calls."""

    times: TickTimes

    def start_torques(self) -> None:
        self.times.begin_stream()
        super().start_torques()  # pyright: ignore[reportAbstractUsage]

    def wait(self) -> tuple[int, armctl.links.Reading]:
        found = super().wait()  # pyright: ignore[reportAbstractUsage]
        self.times.begin_tick()
        return found

    def send_torques(self, tau: np.ndarray, last: bool) -> None:
        self.times.end_tick(tau)
        super().send_torques(tau, last)  # pyright: ignore[reportAbstractUsage]

    def close(self) -> None:
        self.times.write()
        super().close()  # pyright: ignore[reportAbstractUsage]


class TimedPlantLink(_Timed, armctl.links.PlantLink):
    """A simulated robot."""

    def __init__(
        self,
        arm: armctl.Arm,
        plant: armctl.Plant,
        torque: armctl.links.TorqueInterface,
        times: TickTimes,
        real_time: bool,
    ):
        super().__init__(arm, plant, torque=torque, real_time=real_time)
        self.times = times


class TimedFranka(_Timed, armctl.links.Franka):
    """A Franka, or a simulator of one."""

    def __init__(self, host: str, torque: armctl.links.TorqueInterface, times: TickTimes):
        super().__init__(host, real_time=False, torque=torque)
        self.times = times
