"""Links that note how long each tick takes from the reading of the robot until its torques are sent."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import armctl

_FRANKA_JOINTS = 7
_PROBES = 1  # streams at first, which measure the delay of the link and have no law


class TickTimes:
    """The computing time of each tick under a law, and the torques that were sent; for a file, as a link is in a process."""

    def __init__(self, path: Path):
        self.path = path
        self._streams = 0
        self._begun = 0.0  # s of the clock
        self._seconds: list[float] = []
        self._sent: list[np.ndarray] = []  # (n,) N m each; NaN between two streams

    def begin_stream(self, n: int) -> None:
        self._streams += 1
        self._sent.append(np.full(n, np.nan))

    def begin_tick(self) -> None:
        self._begun = time.perf_counter()

    def end_tick(self, tau: np.ndarray) -> None:
        if self._streams > _PROBES:
            self._seconds.append(time.perf_counter() - self._begun)
            self._sent.append(np.array(tau))

    def write(self) -> None:
        np.savez(self.path, seconds=np.array(self._seconds), sent=np.array(self._sent))


class TimedPlantLink(armctl.links.PlantLink):
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

    def start_torques(self) -> None:
        self.times.begin_stream(len(self.q_start))
        super().start_torques()

    def wait(self) -> tuple[int, armctl.links.Reading]:
        found = super().wait()
        self.times.begin_tick()
        return found

    def send_torques(self, tau: np.ndarray, last: bool) -> None:
        self.times.end_tick(tau)
        super().send_torques(tau, last)

    def close(self) -> None:
        self.times.write()
        super().close()


class TimedFranka(armctl.links.Franka):
    """A Franka, or a simulator of one."""

    def __init__(self, host: str, torque: armctl.links.TorqueInterface, times: TickTimes):
        super().__init__(host, real_time=False, torque=torque)
        self.times = times

    def start_torques(self) -> None:
        self.times.begin_stream(_FRANKA_JOINTS)
        super().start_torques()

    def wait(self) -> tuple[int, armctl.links.Reading]:
        found = super().wait()
        self.times.begin_tick()
        return found

    def send_torques(self, tau: np.ndarray, last: bool) -> None:
        self.times.end_tick(tau)
        super().send_torques(tau, last)

    def close(self) -> None:
        self.times.write()
        super().close()
