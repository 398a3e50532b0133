"""CompiledLoop: runs ticks of a simulation without Python, for a controller that has a kernel.

Import this only in a function that needs it, because numba takes long to load.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.control import KernelController, State
from armctl.control.computed_torque_kernel import computed_torque
from armctl.control.interface import WRENCH_SIZE
from armctl.control.kernel_call import entry_point
from armctl.core.validation import Array
from armctl.robot.actuation import Actuation
from armctl.robot.packed_dynamics import PackedDynamics
from armctl.sim import tick_kernel as kernel
from armctl.sim.box_proofs import BoxProofs
from armctl.sim.contact_skip import ContactSkip
from armctl.sim.disturbances import Disturbances, Signals, tick_times
from armctl.sim.free_space import FreeSpace
from armctl.sim.mujoco_library import address_of, contact_layout, guarded_call
from armctl.sim.recorder import TickRows
from armctl.sim.wrench_sensor import WrenchSensor

_MAX_TICKS = 20_000  # of one call, which an interrupt cannot end
_INCOMPLETE = (kernel.NOT_FINITE, kernel.KERNEL_FAILED)  # the state was measured, but no step was made
_EVENTS_SIZE = 4096  # numbers for changes of contacts in one call


class LoopEnd(NamedTuple):
    """How a run of the compiled loop ended.

    Attributes:
        row: The last row that was begun.
        status: One of the statuses of `tick_kernel`.
        error: The message of MuJoCo, if it could not make a step.
        measurement: q and v (n,) that were measured at the last row, if that tick was not completed and there are disturbances.
    """

    row: int
    status: int
    error: str = ""
    measurement: tuple[Array, Array] | None = None


class CompiledLoop:
    """The compiled loop of one simulation; it keeps the addresses of the simulation's arrays."""

    def __init__(
        self,
        actuation: Actuation,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        substeps: int,
        tip: PackedDynamics,
        free_space: FreeSpace | None,
        proofs: BoxProofs,
    ):
        """The loop of a simulation.

        Args:
            actuation: The joints.
            model: The plant's model.
            data: The state of the simulation.
            substeps: Steps of MuJoCo in a tick.
            tip: The dynamics of the arm on whose tip pushes act.
            free_space: What moves the arm instead of `mj_step`.
            proofs: What proves that nothing touches, for steps without collision detection.
        """
        n = actuation.n
        self._n = n
        layout = contact_layout()
        self._function = kernel.run_table.address  # loads code, which no run is to wait for
        self._data = data
        self._contact_skip = ContactSkip(proofs, model, data) if free_space is None else None
        self._timestep = float(model.opt.timestep)
        self._substeps = substeps
        self._free_space = free_space
        self._indices = np.array([actuation.qpos_adr, actuation.dof_adr, actuation.ctrl_adr, actuation.torque_adr], np.int64)
        self._scales = np.array([actuation.gear, actuation.torque_share])
        self._pushed_model = tip.vector(0.0)
        self._scratch = np.zeros(kernel.SCRATCH_VECTORS * n + 7 * tip.n + tip.work_size())
        self._events = np.zeros(_EVENTS_SIZE, np.int32)
        self._table = np.zeros(kernel.TABLE_SIZE, np.int64)
        self._set_numbers(
            {
                kernel.N: n,
                kernel.NQ: model.nq,
                kernel.NV: model.nv,
                kernel.NCTRL: len(data.ctrl),
                kernel.SUBSTEPS: substeps,
                kernel.EVENTS_SIZE: _EVENTS_SIZE,
                kernel.MODEL: model._address,
                kernel.DATA: data._address,
                kernel.STEP_FUNCTION: address_of("mj_step"),
                kernel.CONTACT_COUNT: layout.size,
                kernel.CONTACT_ARRAY: layout.array,
                kernel.CONTACT_STRIDE: layout.stride,
                kernel.CONTACT_GEOMS: layout.geoms,
                kernel.PUSHED_MODEL_SIZE: len(self._pushed_model),
                kernel.SCRATCH_SIZE: len(self._scratch),
            }
        )
        self._set_arrays(
            {
                kernel.QPOS: data.qpos,
                kernel.QVEL: data.qvel,
                kernel.CTRL: data.ctrl,
                kernel.QFRC_ACTUATOR: data.qfrc_actuator,
                kernel.QFRC_APPLIED: data.qfrc_applied,
                kernel.INDICES: self._indices,
                kernel.SCALES: self._scales,
                kernel.PUSHED_MODEL: self._pushed_model,
                kernel.SCRATCH: self._scratch,
                kernel.EVENTS: self._events,
            }
        )

        if free_space is not None:
            self._set_free_space(free_space)

    def run(
        self,
        controller: KernelController,
        rows: TickRows,
        last: int,
        state: State,
        disturbances: Disturbances | None,
        sensor: WrenchSensor,
    ) -> LoopEnd:
        """Runs the ticks up to row `last`, which are complete afterwards unless the run ends early.

        Args:
            controller: The controller, whose law is its kernel.
            rows: Where the ticks are recorded, from the first row that is not complete.
            last: The row behind the last one.
            state: The state now; only its times matter.
            disturbances: What disturbs the signals, if anything does.
            sensor: What measures the wrench, if the controller needs it.

        Returns:
            How it ended.
        """
        parameters, memory = controller.begin(state)
        columns = [np.ascontiguousarray(column, dtype=np.float64) for column in rows.reference]
        reference = np.array([column.ctypes.data for column in columns])
        self._set_numbers(
            {
                kernel.TICKS: len(rows.v),
                kernel.KERNEL: entry_point(controller.kernel),
                kernel.PARAMETERS_SIZE: len(parameters),
                kernel.MEMORY_SIZE: len(memory),
            }
        )
        self._set_arrays(
            {
                kernel.PARAMETERS: parameters,
                kernel.MEMORY: memory,
                kernel.REFERENCE: reference,
                kernel.QPOS_ROWS: rows.qpos,
                kernel.V_ROWS: rows.v,
                kernel.COMMAND_ROWS: rows.tau_cmd,
                kernel.TORQUE_ROWS: rows.tau,
            }
        )
        shares_dynamics = self._shares_dynamics(controller, parameters)
        end = LoopEnd(rows.count, kernel.COMPLETE)
        steps = (last - rows.count) * self._substeps
        with nullcontext(0) if self._contact_skip is None else self._contact_skip.table(steps) as skip:
            self._table[kernel.SKIP] = skip
            while rows.count < last and end.status in (kernel.COMPLETE, kernel.EVENTS_FULL) and not end.error:
                end = self._run_part(
                    rows,
                    min(last, rows.count + _MAX_TICKS),
                    disturbances,
                    sensor if controller.needs_wrench else None,
                    memory[-self._n * (self._n + 1) :] if shares_dynamics else None,
                )
        was_called = end.status in _INCOMPLETE
        controller.finish(self._data.time + (state.dt if was_called else 0.0))
        if was_called and disturbances is not None:
            q = self._scratch[kernel.Q_SEEN * self._n :][: self._n]
            v = self._scratch[kernel.V_SEEN * self._n :][: self._n]
            end = end._replace(measurement=(q.copy(), v.copy()))
        return end

    def _shares_dynamics(self, controller: KernelController, parameters: Array) -> bool:
        """Whether the kernel leaves bias and inertia of the plant in its memory, unless noise disturbs its state."""
        if self._free_space is None or self._substeps != 1 or controller.kernel is not computed_torque:
            return False
        vector = self._free_space.vector
        return np.array_equal(parameters[-len(vector) :], vector)

    def _run_part(
        self,
        rows: TickRows,
        last: int,
        disturbances: Disturbances | None,
        sensor: WrenchSensor | None,
        dynamics: Array | None,
    ) -> LoopEnd:
        """Some ticks in one call; `dynamics` is where the kernel leaves inertia and bias of the plant."""
        first = rows.count
        self._set_numbers({kernel.FIRST: first, kernel.LAST: last, kernel.ROW: first, kernel.COUNT: first})
        self._begin_events(rows)
        signals = None if disturbances is None else disturbances.planned(last - first)
        if signals is not None:
            self._set_signals(signals)
        is_undisturbed = signals is None or signals.noise is None
        self._table[kernel.KNOWN_DYNAMICS] = dynamics.ctypes.data if dynamics is not None and is_undisturbed else 0
        self._table[kernel.SENSE_TABLE] = 0
        if sensor is not None:
            self._set_sensor(sensor, rows, last, None if disturbances is None else disturbances.push)
        error = ""
        try:
            error = guarded_call(self._function, self._table.ctypes.data)
        finally:
            end = LoopEnd(int(self._table[kernel.ROW]), int(self._table[kernel.STATUS]), error)
            rows.count = int(self._table[kernel.COUNT])
            self._end_events(rows, is_full=end.status == kernel.EVENTS_FULL)
            if self._free_space is not None:
                steps = np.full(1 + (rows.count - first) * self._substeps, self._timestep)
                steps[0] = self._data.time
                self._data.time = np.add.accumulate(steps)[-1]  # step by step, as MuJoCo adds
            measured = rows.count - first + (end.status in _INCOMPLETE)
            if disturbances is not None:
                disturbances.took(measured, int(self._table[kernel.COMMANDS_GIVEN]))
            if sensor is not None:
                sensor.took(measured)
        return end

    def _set_sensor(self, sensor: WrenchSensor, rows: TickRows, last: int, push: Array | None) -> None:
        from armctl.sim import wrench_kernel

        vector = self._scratch.itemsize * self._n
        scratch = self._scratch.ctypes.data
        signals = {
            wrench_kernel.Q: scratch + kernel.Q_SEEN * vector,
            wrench_kernel.V: scratch + kernel.V_SEEN * vector,
            wrench_kernel.TORQUE: scratch + kernel.TAU * vector,
            wrench_kernel.RESULT: int(self._table[kernel.MEMORY]),
        }
        times = tick_times(self._data.time, last - rows.count, self._substeps, self._timestep)
        true = rows.with_wrench(WRENCH_SIZE)[rows.count : last]
        self._table[kernel.SENSE] = wrench_kernel.sense_table.address
        self._table[kernel.SENSE_TABLE] = sensor.plan(push, times, true, signals)

    def _set_free_space(self, free_space: FreeSpace) -> None:
        self._set_numbers({kernel.FREE_MODEL_SIZE: len(free_space.vector), kernel.FREE_WORK_SIZE: len(free_space.work)})
        self._set_arrays(
            {
                kernel.FREE_MODEL: free_space.vector,
                kernel.FREE_BOUNDS: free_space.bounds,
                kernel.FREE_WORK: free_space.work,
            }
        )

    def _set_numbers(self, entries: dict[int, int]) -> None:
        for entry, number in entries.items():
            self._table[entry] = number

    def _set_arrays(self, entries: dict[int, NDArray[Any]]) -> None:
        """Sets addresses of arrays, which the caller keeps alive."""
        for entry, array in entries.items():
            self._table[entry] = array.ctypes.data

    def _set_signals(self, signals: Signals) -> None:
        self._set_numbers(
            {
                kernel.DELAY: len(signals.commands) - 1,
                kernel.COMMANDS_GIVEN: signals.commands_given,
                kernel.PUSHED_JOINTS: 0 if signals.wrenches is None else signals.pushed_joints,
            }
        )
        self._set_arrays({kernel.COMMANDS: signals.commands, kernel.RIPPLE: signals.ripple, kernel.PUSH: signals.push})
        self._table[kernel.NOISE] = 0 if signals.noise is None else signals.noise.ctypes.data
        self._table[kernel.WRENCHES] = 0 if signals.wrenches is None else signals.wrenches.ctypes.data

    def _begin_events(self, rows: TickRows) -> None:
        """Begins the list of events with the contacts of the last complete row, if it has any."""
        self._set_numbers({kernel.EVENTS_USED: 0, kernel.LAST_EVENT: -1})
        geoms = np.frombuffer(rows.contacts[-1][1] if rows.contacts else b"", np.int32)
        used = len(geoms) + 2
        if rows.contacts and used <= _EVENTS_SIZE:
            self._events[0] = -1
            self._events[1] = len(geoms) // 2
            self._events[2:used] = geoms
            self._set_numbers({kernel.EVENTS_USED: used, kernel.LAST_EVENT: 0})

    def _end_events(self, rows: TickRows, *, is_full: bool) -> None:
        """Adds the changes of contacts to the rows."""
        at = 0
        while at < self._table[kernel.EVENTS_USED]:
            row = int(self._events[at])
            end = at + 2 + 2 * int(self._events[at + 1])
            if row >= 0:
                rows.contacts.append((row, self._events[at + 2 : end].tobytes()))
            at = end
        if is_full:
            rows.contacts.append((rows.count - 1, self._data.contact.geom.tobytes()))
