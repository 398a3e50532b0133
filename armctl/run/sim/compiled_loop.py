"""CompiledLoop: runs ticks of a simulation without Python, for a controller that has a compiled law."""

from typing import Any

import mujoco
import numpy as np

from armctl import _core
from armctl.control.interface import WRENCH_SIZE, CompiledController, State
from armctl.core.validation import Array
from armctl.model.arm.actuation import Actuation
from armctl.run.execution.recorder import TickRows
from armctl.run.sim.disturbances import Disturbances, tick_times
from armctl.run.sim.mujoco_library import mujoco_api
from armctl.run.sim.plant import DIVERGED_SPEED
from armctl.run.sim.wrench_sensor import WrenchSensor

_MAX_TICKS = 20_000  # of one call, which an interrupt cannot end

_CALLED = (_core.TickStatus.not_finite, _core.TickStatus.repaired)  # the law was called in the row that did not complete


class CompiledLoop:
    """The compiled loop of one simulation."""

    def __init__(
        self, actuation: Actuation, model: mujoco.MjModel, data: mujoco.MjData, substeps: int, pushed_arm: _core.ArmModel
    ):
        """A tick has so many `substeps` of MuJoCo; pushes act on the tip of `pushed_arm`."""
        self._data = data
        self._timestep = float(model.opt.timestep)
        self._substeps = substeps
        self._loop = _core.TickLoop(
            mujoco_api(),
            model,
            data,
            qpos_addresses=np.asarray(actuation.qpos_adr, np.int64),
            dof_addresses=np.asarray(actuation.dof_adr, np.int64),
            ctrl_addresses=np.asarray(actuation.ctrl_adr, np.int64),
            motor_addresses=np.asarray(actuation.motor_adr, np.int64),
            gear=np.asarray(actuation.gear, np.float64),
            pushed_arm=pushed_arm,
            substeps=substeps,
            dt=substeps * self._timestep,
            diverged_speed=DIVERGED_SPEED,
        )

    def run(
        self,
        controller: CompiledController,
        rows: TickRows,
        last: int,
        state: State,
        disturbances: Disturbances | None,
        sensor: WrenchSensor,
    ) -> _core.TickEnd:
        """Completes the rows from the first that is not complete to the one before `last`, unless the run ends early."""
        law = controller.begin(state)
        arrays = {name: np.ascontiguousarray(column, dtype=np.float64) for name, column in rows.reference._asdict().items()} | {
            "qpos_rows": rows.qpos,
            "v_rows": rows.v,
            "command_rows": rows.tau_cmd,
            "torque_rows": rows.tau,
        }
        used_sensor = sensor if controller.needs_wrench else None
        end = _core.TickEnd(rows.count)
        while rows.count < last and end.status == _core.TickStatus.complete and not end.error:
            end = self._run_part(law, rows, arrays, min(last, rows.count + _MAX_TICKS), disturbances, used_sensor)
        was_called = end.status in _CALLED
        controller.finish(self._data.time + (state.dt if was_called else 0.0))
        return end

    def _run_part(
        self,
        law: _core.Law,
        rows: TickRows,
        arrays: dict[str, Array],
        last: int,
        disturbances: Disturbances | None,
        sensor: WrenchSensor | None,
    ) -> _core.TickEnd:
        first = rows.count
        signals: dict[str, Any] = {}
        if disturbances is not None:
            planned = disturbances.planned(last - first)
            signals = {
                "noise": planned.noise,
                "pushes": planned.wrenches,
                "push": disturbances.push,
                "last_position": disturbances.last_position,
            }
        compiled_sensor = None
        if sensor is not None:
            times = tick_times(self._data.time, last - first, self._substeps, self._timestep)
            compiled_sensor, wrench_noise = sensor.plan(times)
            signals |= {"times": times, "wrench_noise": wrench_noise}
            signals |= {"wrench_rows": rows.with_wrench(WRENCH_SIZE)}
        touching = rows.contacts[-1][1] if rows.contacts else b""
        end = _core.TickEnd(first)
        try:
            delay = None if disturbances is None else disturbances.delay
            self._loop.run(law, end, delay, compiled_sensor, touching, **arrays, **signals, first=first, last=last)
        finally:  # an interrupt ends the call after its last tick
            rows.count = end.count
            rows.contacts += end.contacts
            # The state is measured in a tick that did not complete, too.
            measured = end.count - first + (end.status in _CALLED)
            if disturbances is not None:
                disturbances.took(measured)
            if sensor is not None:
                sensor.took(measured)
        return end
