"""TickLoop: the ticks of a simulation, which the compiled core runs; a controller in Python is called by it at each of them."""

from collections.abc import Callable, Iterable, Iterator
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from armctl import _core
from armctl.control.failure import checked_torque
from armctl.control.interface import WRENCH_SIZE, CompiledController, Controller, State, Traits, has_compiled_law, traits
from armctl.core.trajectory import Setpoint, TickReference
from armctl.core.validation import Array, read_only
from armctl.run.execution.recorder import TickRows
from armctl.run.sim.disturbances import Disturbances
from armctl.run.sim.mujoco_library import mujoco_api
from armctl.run.sim.plant import DIVERGED_SPEED
from armctl.run.sim.plant_model import PlantModel
from armctl.run.sim.wrench_sensor import WrenchSensor

MAX_TICKS = 20_000  # of one call, which an interrupt cannot end while a compiled law runs
_CALLED = (_core.TickStatus.not_finite, _core.TickStatus.repaired)  # the law was called in the row that did not complete
_FLOAT64 = np.dtype(np.float64)

Failed = Callable[[Exception], Exception]


class _SeenRows(NamedTuple):
    """What a controller in Python gets at the coming ticks."""

    written: dict[str, Array]  # by the loop
    read: Iterator[tuple[Array, Array, Array | None, Array | None]]  # at each tick: q, v, wrench, deflection; read-only


class TickLoop:
    """The tick loop of one simulation: measure, control, step, record."""

    def __init__(self, built: PlantModel, wrench_sensor: WrenchSensor):
        """The loop of a plant whose wrenches a sensor measures, for controllers that need them."""
        self._built = built
        self._wrench_sensor = wrench_sensor
        self._loop = _core.TickLoop(
            mujoco_api(),
            built.model,
            built.data,
            **built.drivetrain.addresses,
            pushed_arm=built.pushed_arm,
            substeps=built.substeps,
            dt=built.dt,
            diverged_speed=DIVERGED_SPEED,
        )

    def law_of(self, controller: Controller) -> CompiledController | None:
        """A controller whose compiled law runs the ticks without Python, else None."""
        return controller if has_compiled_law(controller, self._built.actuation.n) else None

    def run(
        self, controller: Controller, rows: TickRows, last: int, disturbances: Disturbances | None, failed: Failed
    ) -> _core.TickEnd:
        """Completes the rows from the first that is not complete to the one before `last`, unless the run ends early.

        `failed` makes the exception that is raised of the one that a controller in Python raised.
        """
        built = self._built
        own = traits(controller)
        compiled = self.law_of(controller)
        law = None
        if compiled is not None:
            law = compiled.begin(State(built.q, built.v, float(built.data.time), built.dt, built.continuous))
        end = _core.TickEnd(rows.count)
        while rows.count < last and end.status == _core.TickStatus.complete and not end.error:
            part = min(last, rows.count + MAX_TICKS)
            if law is None:
                seen = self._seen_rows(own, part - rows.count)
                end = self._run_part(
                    self._callback(controller, own, rows, part, seen, failed), own, rows, part, disturbances, seen.written
                )
            else:
                end = self._run_part(law, own, rows, part, disturbances, {})
        if compiled is not None:
            compiled.finish(built.data.time + (built.dt if end.status in _CALLED else 0.0))
        return end

    def _run_part(
        self,
        law: _core.Law,
        own: Traits,
        rows: TickRows,
        last: int,
        disturbances: Disturbances | None,
        seen: dict[str, Array],
    ) -> _core.TickEnd:
        first = rows.count
        arrays: dict[str, Any] = rows.reference._asdict()
        planned = None if disturbances is None else disturbances.plan(last - first)
        if disturbances is not None and planned is not None:
            arrays |= planned._asdict() | {"push": disturbances.push}
        tips: list[_core.WrenchSensor] = []
        wrench_noise = None
        if own.needs_wrench:
            times = self._built.tick_times(last - first)
            tip, wrench_noise = self._wrench_sensor.plan(times)
            tips = [tip]
            arrays |= {"times": times, "wrench_noise": wrench_noise, "wrench_rows": rows.with_wrench()}
        end = _core.TickEnd(first)
        try:
            self._loop.run(
                law,
                end,
                None if disturbances is None else disturbances.sensors,
                None if disturbances is None else disturbances.delay,
                None if disturbances is None else disturbances.joint_torque(),
                tips,
                rows.contacts[-1][1] if rows.contacts else b"",
                **arrays,
                **seen,
                tips=len(tips),
                first=first,
                last=last,
                qpos_rows=rows.qpos,
                v_rows=rows.v,
                command_rows=rows.tau_cmd,
                torque_rows=rows.tau,
            )
        finally:  # an exception of the law, or an interrupt, ends the call after its last tick
            # A traceback that kept the law would keep the controller: Python does not see what a law of the core keeps.
            del law
            rows.count = end.count
            rows.contacts += end.contacts
            if disturbances is not None and planned is not None:
                disturbances.took(planned, end.measured, end.driven)
            if own.needs_wrench:
                self._wrench_sensor.took(wrench_noise, end.measured)
        return end

    def _seen_rows(self, own: Traits, ticks: int) -> _SeenRows:
        """Rows for what a controller in Python gets, which it may keep."""
        n = self._built.actuation.n
        motion = np.empty((2, ticks, n))
        readable = read_only(motion)
        written = {"q_seen_rows": motion[0], "v_seen_rows": motion[1]}
        wrenches: Iterable[Array | None] = repeat(None)
        deflections: Iterable[Array | None] = repeat(None)
        if own.needs_wrench:
            written["wrench_seen_rows"] = np.empty((ticks, WRENCH_SIZE))
            wrenches = read_only(written["wrench_seen_rows"])
        if own.needs_deflection:
            written["deflection_seen_rows"] = np.zeros((ticks, 2, n))
            deflections = read_only(written["deflection_seen_rows"])
        return _SeenRows(written, zip(readable[0], readable[1], wrenches, deflections, strict=False))

    def _callback(
        self, controller: Controller, own: Traits, rows: TickRows, last: int, seen: _SeenRows, failed: Failed
    ) -> _core.CallbackLaw:
        """A law that calls a controller at the coming ticks. Each simulation's speed depends on each line of `tick`."""
        built = self._built
        data = built.data
        dt = built.dt
        continuous = built.continuous
        n = built.actuation.n
        tau_rows = np.empty(n)
        states = seen.read
        setpoints = zip(*(column[rows.count : last] for column in rows.reference), strict=True)
        torque = controller.torque
        foresee = None if own.foresee is None else _foresee(own.foresee, rows)
        new = tuple.__new__  # a NamedTuple's own constructor takes twice as long

        def tick() -> None:
            q, v, wrench, deflection = next(states)
            setpoint = next(setpoints)
            try:
                if foresee is not None:
                    foresee()
                tau = torque(new(State, (q, v, data.time, dt, continuous, wrench, deflection)), new(Setpoint, setpoint))
                if not (type(tau) is ndarray and tau.dtype is _FLOAT64 and len(tau) == n):
                    tau = checked_torque(tau, n)
                tau_rows[:] = tau
            except Exception as error:
                raise failed(error) from error

        return _core.CallbackLaw(tick, tau_rows)


def _foresee(foresee: Callable[[TickReference], None], rows: TickRows) -> Callable[[], None]:
    """Gives a controller the reference from the next row on, at each call."""
    coming = iter(range(rows.count, len(rows.v)))

    def call() -> None:
        row = next(coming)
        foresee(TickReference(*(column[row:] for column in rows.reference)))

    return call
