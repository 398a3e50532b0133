"""SensorTiming: when a file's sensors measure its joints, and how late they are read."""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray

_JOINT_SENSORS = {int(mujoco.mjtSensor.mjSENS_JOINTPOS), int(mujoco.mjtSensor.mjSENS_JOINTVEL)}
_ACTUATOR_SENSORS = {int(mujoco.mjtSensor.mjSENS_ACTUATORPOS), int(mujoco.mjtSensor.mjSENS_ACTUATORVEL)}
_TOLERANCE = 1e-6  # of a tick


class SensorTiming(NamedTuple):
    """When n joints are measured: at multiples of an interval; a measurement is read after a delay, until the next one."""

    delay: Array  # (n,) s
    interval: Array  # (n,) s; 0 for every tick
    phase: Array  # (n,) s, the time of the last measurement before 0, above -interval; 0 for one at 0

    @property
    def is_late(self) -> bool:
        """Whether anything is late."""
        return bool(self.delay.any() or self.interval.any())

    def ages(self, ticks: IntArray, dt: float) -> IntArray:
        """(T, n) by how many ticks what is read at ticks (T,) is old. MuJoCo measures in the first step after a multiple."""
        latest = ticks[:, None] - np.ceil(self.delay / dt - _TOLERANCE)
        period = np.maximum(self.interval / dt, 1.0)
        start = np.where(self.interval > dt, self.phase / dt, 0.0)
        measured = np.floor((latest - start) / period + _TOLERANCE)
        return np.asarray(ticks[:, None] - np.ceil(measured * period + start - _TOLERANCE), dtype=np.int64)


def sensor_timing(model: mujoco.MjModel, joints: Mapping[int, int], actuators: Mapping[int, int], n: int) -> SensorTiming:
    """The timing of n joints by the latest sensor of each; a joint without one is measured at every tick.

    `joints` and `actuators` say which of the n joints those of the model belong to, such as the motor's and its spring's.
    """
    timing = SensorTiming(np.zeros(n), np.zeros(n), np.zeros(n))
    for sensor in range(model.nsensor):
        kind = int(model.sensor_type[sensor])
        owners = joints if kind in _JOINT_SENSORS else actuators if kind in _ACTUATOR_SENSORS else {}
        i = owners.get(int(model.sensor_objid[sensor]))
        if i is None:
            continue
        timing.delay[i] = max(timing.delay[i], model.sensor_delay[sensor])
        period, phase = model.sensor_interval[sensor]
        if period > timing.interval[i]:
            timing.interval[i] = period
            timing.phase[i] = phase
    return timing
