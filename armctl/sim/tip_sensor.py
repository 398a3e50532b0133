"""TipSensor: the wrench sensor of one arm, as a table and arrays for `wrench_kernel`.

Import this only in a function that needs it, because numba takes long to load.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.control.interface import WRENCH_SIZE
from armctl.core.validation import Array
from armctl.mjmodel.queries import is_below
from armctl.sim import wrench_kernel as kernel
from armctl.sim.mujoco_library import address_of, contact_layout
from armctl.sim.sensor_site import SensorKind, Site

_MIN_JOINTS_FOR_MOMENTS = 6  # the torques of fewer joints do not separate moments from forces


class TipSensor:
    """The sensor of one arm."""

    def __init__(self, site: Site, kind: SensorKind, model: mujoco.MjModel, data: mujoco.MjData):
        """A sensor that has measured nothing.

        Args:
            site: The place of the sensor.
            kind: What it measures.
            model: The plant's model.
            data: Its state.
        """
        n = site.dynamics.n
        delay = kind.plant.wrench_delay
        bodies = [body for body in range(site.last_body, model.nbody) if is_below(model, body, site.last_body)]
        self._estimate = np.zeros(kernel.estimate_size(n))
        self._arrays: dict[int, NDArray[Any]] = {
            kernel.XFRC_APPLIED: data.xfrc_applied,
            kernel.CFRC_EXT: data.cfrc_ext,
            kernel.XPOS: data.xpos,
            kernel.XMAT: data.xmat,
            kernel.SUBTREE_COM: data.subtree_com,
            kernel.BODIES: np.array(bodies, np.int64),
            kernel.OFFSET: np.array(site.offset),
            kernel.PERIOD: np.array([kind.dt, (delay + 0.5) * kind.dt]),
            kernel.SAMPLES: np.zeros((delay + 2, kernel.SAMPLE_SIZE)),
            kernel.DYNAMICS: site.dynamics.vector(kind.dt, kind.continuous),
            kernel.WORK: np.zeros(site.dynamics.work_size()),
            kernel.ESTIMATE: self._estimate,
        }
        # What `measure` passes to the kernel and gets from it.
        self._signals: dict[int, Array] = {
            kernel.Q: np.zeros(n),
            kernel.V: np.zeros(n),
            kernel.TORQUE: np.zeros(n),
            kernel.TIMES: np.zeros(1),
            kernel.NOISE: np.zeros(WRENCH_SIZE),
            kernel.RESULT: np.zeros(WRENCH_SIZE),
            kernel.TRUE: np.zeros(WRENCH_SIZE),
        }
        rows = WRENCH_SIZE if n >= _MIN_JOINTS_FOR_MOMENTS else 3
        numbers = {
            kernel.N: n,
            kernel.BODIES_COUNT: len(bodies),
            kernel.ALL_BODIES: model.nbody,
            kernel.KEPT: delay + 2,
            kernel.MODEL_SIZE: len(self._arrays[kernel.DYNAMICS]),
            kernel.WORK_SIZE: len(self._arrays[kernel.WORK]),
            kernel.ROWS: rows if kind.plant.wrench_source == "torques" else 0,
            kernel.MODEL: model._address,
            kernel.DATA: data._address,
            kernel.POST_CONSTRAINT: address_of("mj_rnePostConstraint"),
            kernel.CONTACT_COUNT: contact_layout().size,
            kernel.IS_CONNECTED: kind.is_connected,
            kernel.IS_SAMPLED: kind.is_sampled,
            kernel.ROOT: int(model.body_rootid[site.last_body]),
            kernel.TIP: site.tip_body,
        }
        self._table = np.zeros(kernel.TABLE_SIZE, np.int64)
        for entry, number in numbers.items():
            self._table[entry] = number
        self._point_to(self._arrays)
        self.reset()

    def reset(self) -> None:
        """Forgets all measurements."""
        self._table[kernel.OLDEST] = 0
        self._table[kernel.COUNT] = 0
        self._estimate[:] = 0.0
        self._estimate[0] = np.nan  # the time of the last tick

    def read(self, push: Array | None) -> Array:
        """The true wrench now, (6,); `push` (6,) is that of the plant's pushes, if there are any."""
        wrench = np.zeros(WRENCH_SIZE)
        self._set_push(push)
        kernel.read_wrench(self._table, wrench)
        return wrench

    def measure(self, q: Array, v: Array, tau: Array, t: float, noise: Array, push: Array | None) -> tuple[Array, Array]:
        """What the sensor gives at this tick, and the true wrench, each (6,).

        Args:
            q: (n,) rad, measured.
            v: (n,) rad/s, measured.
            tau: (n,) N m, the torque of the motors during the last tick.
            t: s.
            noise: (6,) of a new measurement.
            push: As for `read`.
        """
        signals = self._signals
        for entry, value in ((kernel.Q, q), (kernel.V, v), (kernel.TORQUE, tau), (kernel.TIMES, t), (kernel.NOISE, noise)):
            signals[entry][:] = value
        self._point_to(signals)
        self._set_push(push)
        self._table[kernel.TICK] = 0
        kernel.sense(self._table)
        return signals[kernel.RESULT].copy(), signals[kernel.TRUE].copy()

    def plan(self, push: Array | None, times: Array, true: Array, noise: Array | None, signals: Mapping[int, int]) -> int:
        """Prepares for ticks of the compiled loop; all arrays have to stay until their end.

        Args:
            push: As for `read`; the loop changes it.
            times: (ticks,) s.
            true: (ticks, 6), where the true wrenches are noted.
            noise: (ticks, 6); None for none.
            signals: Addresses of the measured positions and velocities, of the torque of the motors, and of the result, by the
                entries of the table.

        Returns:
            The address of the table.
        """
        self._point_to({kernel.TIMES: times, kernel.TRUE: true})
        self._table[kernel.NOISE] = 0 if noise is None else noise.ctypes.data
        for entry, address in signals.items():
            self._table[entry] = address
        self._set_push(push)
        self._table[kernel.TICK] = 0
        return int(self._table.ctypes.data)

    def _set_push(self, push: Array | None) -> None:
        self._table[kernel.PUSH] = 0 if push is None else push.ctypes.data

    def _point_to(self, arrays: Mapping[int, NDArray[Any]]) -> None:
        for entry, array in arrays.items():
            self._table[entry] = array.ctypes.data
