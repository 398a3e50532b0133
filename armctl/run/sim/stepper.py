"""Stepper: the simulated plant, and the tick loop of all runs."""

from collections.abc import Sequence
from math import hypot, inf  # hypot of a short list is faster than numpy's norm
from threading import Lock
from typing import Protocol, TypeGuard

import mujoco
import numpy as np
from mujoco import mj_step
from numpy import ndarray
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.failure import ControllerFailure, checked_torque
from armctl.control.interface import CompiledController, Controller, State, has_compiled_law, traits
from armctl.core import hooks
from armctl.core.defaults import AT_REST_SPEED
from armctl.core.errors import InputError
from armctl.core.log import LogSource, LogTorques, SimulationError
from armctl.core.pose import Pose, computed_pose
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array, IntArray, read_only, vector
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.run.execution.recorder import Recorder, ReferenceTips, TickRows
from armctl.run.sim.compiled_loop import CompiledLoop
from armctl.run.sim.disturbances import Disturbances
from armctl.run.sim.drivetrain import Drivetrain, drivetrain_of, new_model, structure_of
from armctl.run.sim.plant import DIVERGED_SPEED, Brake, Plant, apply_plant, held_dofs, steps_in_python
from armctl.run.sim.repairs import has_repaired, repair, repair_counts
from armctl.run.sim.wrench_sensor import WrenchSensor

_MAX_KEPT_TICKS = 20_000
_FLOAT64 = np.dtype(np.float64)


class Observer(Protocol):
    """An observer of the tick loop, such as a viewer. It must not change the state; it may block."""

    interval: float  # s of simulated time between two calls of `after_ticks`

    def after_reset(self, data: mujoco.MjData) -> None:
        """Called after the state was reset."""
        ...

    def before_run(self) -> None:
        """Called before a run."""
        ...

    def after_ticks(self, data: mujoco.MjData, seconds: float) -> None:
        """Called during a run, `seconds` of simulated time after the last call."""
        ...


class _OneThread:
    """Lets one thread at a time work on a simulation; another one gets an InputError and does not wait."""

    def __init__(self) -> None:
        self._lock = Lock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise InputError("simulation: another thread runs it; give each thread a simulation of its own")

    def __exit__(self, *exception: object) -> None:
        self._lock.release()


class Stepper:
    """One or several arms of one model as a simulated plant, and its state over time.

    It keeps no reference to an Arm, so that arms can be forgotten while a stepper waits for the next run.

    Its `description` is the plant in words; after a run that `diverged` only `reset` helps.
    """

    source = LogSource.SIMULATION
    torques = LogTorques.BOTH

    def __init__(self, arms: Sequence[Arm], plant: Plant, observer: Observer | None = None):
        """A stepper of arms that share no joint, at home, at rest. Payload and pushes act at the tip of the first."""
        self._observer = observer
        self._one_thread = _OneThread()
        self._pushed_arm = arms[0].core_model
        self._home = np.concatenate([arm.home for arm in arms])
        self._home_qpos = arms[0].home_qpos
        self._home_ctrl = arms[0].home_ctrl
        self._structure: object = None
        self._disturbances: Disturbances | None = None
        self._measurement: tuple[Array, Array] | None = None
        self._unobserved = 0.0
        self._reference_tips = ReferenceTips()
        self._sampled: tuple[Trajectory, tuple[float, int, bool], TickReference] | None = None
        self._held_dofs = held_dofs(*arms)
        self.set_plant(plant, arms)
        self.reset()

    def set_plant(self, plant: Plant, arms: Sequence[Arm]) -> None:
        """Gives the same simulated arms another plant. The state is lost: call `reset` afterwards."""
        structure = structure_of(arms, plant)
        if structure != self._structure:
            self._use_model(new_model(arms, plant), drivetrain_of(arms, plant))
            self._structure = structure
        apply_plant(self.model, self.data, plant, arms)
        self.plant = plant
        self.late = 0  # a simulation waits for its references
        self.description = str(plant)
        self._steps_in_python = steps_in_python(plant, self._train)
        self._brake = Brake(self.model, self._held_dofs)
        self._released = np.zeros(0, dtype=np.int64)
        self.continuous = bool(self.model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4))
        self.dt = arms[0].dt if plant.timestep is None else plant.timestep
        self._substeps = round(self.dt / self.model.opt.timestep)
        self._wrench_sensor = WrenchSensor(arms, plant, self.model, self.data, self.dt, self.continuous)
        self._compiled = CompiledLoop(self.actuation, self.model, self.data, self._substeps, self._pushed_arm)

    def _use_model(self, model: mujoco.MjModel, train: Drivetrain) -> None:
        """Takes a model, and where the joints and motors of the arms are in it."""
        self.model = model
        self.data = mujoco.MjData(model)
        self._repairs = repair_counts(self.data)
        self.actuation = train.actuation
        self._train = train
        self._joints = self.actuation.qpos_adr if train.springs else _index(self.actuation.qpos_adr)
        self._dofs = self.actuation.dof_adr if train.springs else _index(self.actuation.dof_adr)
        self._motors = _index(self.actuation.ctrl_adr)
        forces = _index(self.actuation.motor_adr)
        # A slice of MuJoCo's arrays is a view that stays valid; other addresses have to be gathered at every tick.
        has_no_gears = bool((self.actuation.gear == 1.0).all())
        self._qvel = self.data.qvel[self._dofs] if isinstance(self._dofs, slice) else None
        self._motor_torque = self.data.actuator_force[forces] if isinstance(forces, slice) and has_no_gears else None
        self._is_direct = isinstance(self._motors, slice) and has_no_gears

    @property
    def n(self) -> int:
        """The number of driven joints of all arms."""
        return self.actuation.n

    @property
    def blocked(self) -> str:
        """Why no motion may start: the state diverged; empty if one may."""
        return f"{self.failure}; call reset() to start again" if self.diverged else ""

    def is_still(self, joints: slice) -> bool:
        return bool(np.abs(self._train.link_speeds(self.data.qvel)[joints]).max() < AT_REST_SPEED)

    @property
    def state(self) -> State:
        q = self._train.link_positions(self.data.qpos)
        v = self._train.link_speeds(self.data.qvel)
        wrench = self._wrench_sensor.read(self._push)
        return State(q, v, float(self.data.time), self.dt, self.continuous, wrench, self._train.deflection(self.data))

    @property
    def measured_state(self) -> State:
        """The state as the plant's sensors measure it now; the same until the next tick."""
        state = self.state
        if self._disturbances is not None:
            q, v = self._measure(state.q, state.v)
            state = state._replace(q=q, v=v, deflection=self._disturbances.deflection)
        return state._replace(wrench=self._wrench_sensor.measure(self._push, state, self.motor_torque))

    @property
    def motor_torque(self) -> Array:
        """(n,) N m at the joints, of the motors in the last tick; what else acts on a joint, as friction, is not among it."""
        return self.data.actuator_force[self.actuation.motor_adr] * self.actuation.gear

    def tip_pose(self, arm: Arm) -> Pose:
        """The pose of an arm's tip in the simulation now, T_world_tip."""
        mujoco.mj_kinematics(self.model, self.data)
        body = arm.tip_body
        return computed_pose(self.data.xpos[body], self.data.xmat[body].reshape(3, 3)) @ arm.T_body_tip

    def reset(self, q: ArrayLike | None = None, v: ArrayLike | None = None) -> None:
        """Sets time to 0 and the joints to q, rad, and v, rad/s; home and rest by default. Everything else is at home."""
        q = vector("q", self._home if q is None else q, self.n)
        v = vector("v", np.zeros(self.n) if v is None else v, self.n)
        with self._one_thread:
            self._reset(q, v)
        if self._observer is not None:
            self._observer.after_reset(self.data)

    def _reset(self, q: Array, v: Array) -> None:
        if len(self._released):
            self._released = self._released[:0]
            self._brake.release_only(self._released)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[: len(self._home_qpos)] = self._home_qpos
        self.actuation.joint_map.set_positions(self.data.qpos, q)
        self.actuation.joint_map.set_speeds(self.data.qvel, v)
        self.data.ctrl[:] = self._home_ctrl
        self._train.settle(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.q_ref = q
        self.failure = ""
        self.diverged = False
        self._measurement = None
        self._unobserved = 0.0
        self._wrench_sensor.reset()
        self._disturbances = None
        if self.plant.has_signal_disturbances or self._steps_in_python:
            self._disturbances = Disturbances(self.plant, self.model, self.data, self._train, self._pushed_arm, self.dt)

    def release(self, dofs: IntArray) -> None:
        """Releases the brake of joints outside the arms, such as a gripper's, by addresses in qvel; `reset` brakes them."""
        if not np.isin(dofs, self._released).all():
            self._released = np.union1d(self._released, dofs)
            self._brake.release_only(self._released)
            self.data.eq_active[:] = self.model.eq_active0

    def recorder(self) -> Recorder:
        return Recorder(self.model, self.actuation, self._reference_tips, self._train.link_positions)

    def reference(self, trajectory: Trajectory, ticks: int) -> TickReference:
        """The first `ticks` ticks of a trajectory. The last motion is kept on its ticks: many runs follow the same one."""
        grid = (self.dt, ticks, self.continuous)
        if self._sampled is not None and self._sampled[0] is trajectory and self._sampled[1] == grid:
            return self._sampled[2]
        reference = TickReference(*map(read_only, TickReference.of(trajectory, self.dt, ticks, self.continuous)))
        is_immutable = isinstance(trajectory, JointTrajectory)  # others may be a user's
        self._sampled = (trajectory, grid, reference) if is_immutable and ticks <= _MAX_KEPT_TICKS else None
        return reference

    def run(self, controller: Controller, reference: TickReference, recorder: Recorder, to_rest: Pieces | None = None) -> None:
        """Runs the tick loop along a reference, whose arrays become read-only: measure, control, step, record.

        The run ends early, and `failure` says why, if the arm diverges or the controller returns a torque that is not finite.
        If it ends by an exception, all complete ticks are recorded, and `q_ref` is the reference of the last one.
        SimulationError if an earlier run ended early, or the controller failed.
        """
        if self.failure:
            raise SimulationError(f"{self.failure}; call reset() to start again")
        rows = recorder.begin(reference)
        if self._runs_compiled(controller):
            controller.law_for(self.dt, self.continuous)
            recorder.restart_clock()
        if self._observer is None:
            self._run_ticks(controller, rows, 0, len(reference.q))
            return
        ticks = max(1, round(self._observer.interval / self.dt))
        self._observer.before_run()
        for first in range(0, len(reference.q), ticks):
            last = min(first + ticks, len(reference.q))
            self._run_ticks(controller, rows, first, last)
            self._observer.after_ticks(self.data, (last - first) * self.dt)
            if self.failure:
                return

    def come_to_rest(self, *, stop: bool) -> None:
        """Nothing: a simulation stands between two runs."""

    def instability(self, arm: Arm, controller: Controller, q: Array) -> str:
        return hooks.instability(arm, controller, q, self.plant)

    def _runs_compiled(self, controller: Controller) -> TypeGuard[CompiledController]:
        """Whether the ticks of a controller need no Python. A compiled law can get the wrench on one tip."""
        if self._steps_in_python or not has_compiled_law(controller, self.n):
            return False
        return self._wrench_sensor.arms == 1 or not controller.needs_wrench

    def step(self, controller: Controller, rows: TickRows) -> None:
        """Runs the next tick of rows that are not complete; SimulationError as for `run`, also if this tick ended early."""
        if self.failure:
            raise SimulationError(f"{self.failure}; call reset() to start again")
        if self._observer is not None and self._unobserved == 0.0:
            self._observer.before_run()
        self._run_ticks(controller, rows, rows.count, rows.count + 1)
        if self.failure:
            raise SimulationError(self.failure)
        if self._observer is not None:
            self._unobserved += self.dt
            if self._unobserved > self._observer.interval - 0.5 * self.dt:
                self._observer.after_ticks(self.data, self._unobserved)
                self._unobserved = 0.0

    def _run_ticks(self, controller: Controller, rows: TickRows, first: int, last: int) -> None:
        """The ticks of rows [first, last): compiled if the law of the controller is, else in Python."""
        with self._one_thread:
            if last == first + 1 or not self._runs_compiled(controller):
                self._run_python_ticks(controller, rows, first, last)
                return
            if self._measurement is not None or self._wrench_sensor.has_measured(self.data.time):  # the first tick is measured
                self._run_python_ticks(controller, rows, first, first + 1)
            if not self.failure:
                self._run_compiled_ticks(controller, rows, last)

    def _run_compiled_ticks(self, controller: CompiledController, rows: TickRows, last: int) -> None:
        begin = float(self.data.time)
        done = rows.count
        end = self._compiled.run(controller, rows, last, self.state, self._disturbances, self._wrench_sensor)
        reached = rows.reference.q[end.row]
        self.q_ref = reached if np.isfinite(reached).all() else self.state.q
        self._measurement = None
        if end.error:
            raise mujoco.FatalError(end.error)
        if end.status == _core.TickStatus.diverged:
            self._diverge(rows.v[end.row])
        elif end.status == _core.TickStatus.repaired:
            self._repaired(begin + (end.row - done) * self.dt)
        elif end.status == _core.TickStatus.not_finite:
            if self._disturbances is not None:
                self._measurement = (np.array(end.q_seen), np.array(end.v_seen))
            self.failure = f"the controller gave no finite torque at {self.data.time:.3f} s"

    def _run_python_ticks(self, controller: Controller, rows: TickRows, first: int, last: int) -> None:  # noqa: PLR0915  # locals are fast
        """The ticks of rows [first, last). The speed of every simulation depends on each line of this loop."""
        data = self.data
        model = self.model
        dt = self.dt
        continuous = self.continuous
        substeps = self._substeps
        disturbances = self._disturbances
        qvel = self._qvel
        motor_torque = self._motor_torque
        is_direct = self._is_direct and disturbances is None
        command = data.ctrl[self._motors] if is_direct else np.empty(self.n)
        n = self.n
        qpos = data.qpos
        qpos_rows = rows.qpos
        v_rows = rows.v
        command_rows = rows.tau_cmd
        torque_rows = rows.tau
        # A controller gets read-only views of the recorded rows.
        v_seen_rows = read_only(v_rows)
        q_seen_rows = read_only(qpos_rows[:, self._joints]) if isinstance(self._joints, slice) else None
        torque = controller.torque
        own = traits(controller)
        sensor = self._wrench_sensor if own.needs_wrench else None
        wrench_rows = None if sensor is None else rows.with_wrench(len(sensor.true))
        wrench = None
        needs_deflection = own.needs_deflection
        deflection = None
        new = tuple.__new__  # a NamedTuple's own constructor takes twice as long
        touching = rows.contacts[-1][1] if rows.contacts else b""
        row = first
        count = rows.count
        foresee = own.foresee
        repairs = self._repairs
        try:
            for row, setpoint in enumerate(zip(*(column[first:last] for column in rows.reference), strict=True), first):
                v_rows[row] = self._train.link_speeds(data.qvel) if qvel is None else qvel
                qpos_rows[row] = qpos
                v = v_seen_rows[row]
                if not hypot(*v.tolist()) < DIVERGED_SPEED:
                    self._diverge(v)
                    break
                q = read_only(self._train.link_positions(qpos)) if q_seen_rows is None else q_seen_rows[row]
                q_seen, v_seen = (q, v) if disturbances is None else self._measure(q, v)
                if sensor is not None and wrench_rows is not None:
                    seen = State(q_seen, v_seen, data.time, dt, continuous)
                    wrench = sensor.measure(self._push, seen, self.motor_torque)
                    wrench_rows[row] = sensor.true
                if needs_deflection:
                    late = self._train.deflection(data) if disturbances is None else disturbances.deflection
                    deflection = read_only(late)
                try:
                    if foresee is not None:
                        foresee(TickReference(*(column[row:] for column in rows.reference)))
                    state = new(State, (q_seen, v_seen, data.time, dt, continuous, wrench, deflection))
                    tau = torque(state, new(Setpoint, setpoint))
                    if not (type(tau) is ndarray and tau.dtype is _FLOAT64 and len(tau) == n):
                        tau = checked_torque(tau, n)
                    command[:] = tau
                except Exception as error:
                    raise self._controller_failed(controller, error) from error
                if not hypot(*command.tolist()) < inf:
                    self.failure = f"the controller gave no finite torque at {data.time:.3f} s"
                    break
                command_rows[row] = command
                if not is_direct:
                    driven = command if disturbances is None else disturbances.driven(command, q, v)
                    data.ctrl[self._motors] = driven / self.actuation.gear
                    self._measurement = None
                time = data.time
                mj_step(model, data, substeps)
                if has_repaired(repairs):
                    self._repaired(time)
                    break
                torque_rows[row] = self.motor_torque if motor_torque is None else motor_torque
                if data.ncon or touching:
                    before = touching
                    touching = data.contact.geom[data.contact.exclude == 0].tobytes()
                    if touching != before:
                        rows.contacts.append((row, touching))
                count = row + 1
        finally:
            rows.count = count
            reached = rows.reference.q[row]
            self.q_ref = reached if hypot(*reached.tolist()) < inf else self.state.q

    def _measure(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The measurement of this tick; `measured_state` may have made it already."""
        if self._measurement is None:
            assert self._disturbances is not None
            self._measurement = self._disturbances.measured(q, v)
        return self._measurement

    @property
    def _push(self) -> Array | None:
        return None if self._disturbances is None else self._disturbances.push

    def _controller_failed(self, controller: Controller, error: Exception) -> SimulationError:
        cause: BaseException | None = error
        whose = ""
        if isinstance(error, ControllerFailure):
            cause = error.__cause__
            controller = error.controller
            whose = f" of {error.tip!r:.80}" if error.tip else ""
        name = traits(controller).name
        self.failure = f"the controller {name:.80}{whose} failed at {self.data.time:.3f} s: {cause}"
        return SimulationError(self.failure)

    def _repaired(self, time: float) -> None:
        """Ends a run in which MuJoCo found a number that is NaN or huge, since it then goes on from another state."""
        self.diverged = True
        self.failure = f"MuJoCo stopped at {time:.3f} s: {repair(self.model, self.data)}"

    def _diverge(self, v: Array) -> None:
        worst = int(np.argmax(np.abs(np.nan_to_num(v, nan=np.inf))))
        joint = self.actuation.joint_names[worst]
        unit = self.actuation.units[worst]
        self.diverged = True
        self.failure = f"diverged at {self.data.time:.3f} s: {joint} moves at {v[worst]:.3g} {unit}/s"


def _index(addresses: IntArray) -> slice | IntArray:
    """Addresses as a slice where they are consecutive: NumPy reads and writes those faster."""
    first = int(addresses[0])
    consecutive = np.array_equal(addresses, np.arange(first, first + len(addresses)))
    return slice(first, first + len(addresses)) if consecutive else addresses
