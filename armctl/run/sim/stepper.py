"""Stepper: the simulated plant of all runs, and its state over time."""

from dataclasses import dataclass
from math import hypot, inf  # hypot of a short list is faster than numpy's norm
from threading import Lock
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.interface import Controller, State, traits
from armctl.core import hooks
from armctl.core.defaults import AT_REST_SPEED
from armctl.core.errors import InputError
from armctl.core.log import LogSource, LogTorques, SimulationError
from armctl.core.pose import Pose, computed_pose
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array, IntArray, read_only, vector
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm, check_driven
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.run.execution.recorder import Recorder, ReferenceTips, TickRows
from armctl.run.sim.disturbances import Disturbances, disturbances_of
from armctl.run.sim.plant import Plant
from armctl.run.sim.plant_model import PlantModel
from armctl.run.sim.repairs import repair
from armctl.run.sim.tick_loop import TickLoop
from armctl.run.sim.wrench_sensor import WrenchSensor

_MAX_KEPT_TICKS = 20_000


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


class _References:
    """What is computed of the last reference: many runs follow the same motion."""

    def __init__(self) -> None:
        self.tips = ReferenceTips()
        self._sampled: tuple[Trajectory, tuple[float, int, bool], TickReference] | None = None

    def of(self, trajectory: Trajectory, dt: float, ticks: int, continuous: bool) -> TickReference:
        """The first `ticks` ticks of a trajectory."""
        grid = (dt, ticks, continuous)
        if self._sampled is not None and self._sampled[0] is trajectory and self._sampled[1] == grid:
            return self._sampled[2]
        reference = TickReference(*map(read_only, TickReference.from_trajectory(trajectory, *grid)))
        is_immutable = isinstance(trajectory, JointTrajectory)  # others may be a user's
        self._sampled = (trajectory, grid, reference) if is_immutable and ticks <= _MAX_KEPT_TICKS else None
        return reference


@dataclass
class _RunState:
    """What changes from tick to tick, besides MuJoCo's data."""

    q_ref: Array  # (n,) rad, the reference of the last tick
    disturbances: Disturbances | None  # of the signals, if the plant has any
    failure: str = ""
    diverged: bool = False
    unobserved: float = 0.0  # s of single ticks since the observer was called

    @property
    def push(self) -> Array | None:
        """(6,) N and N m, the wrench of the pushes in the last tick, if there may be any."""
        return None if self.disturbances is None else self.disturbances.push


class Stepper:
    """An arm as a simulated plant, and its state over time.

    It keeps no reference to the Arm, so that it can be forgotten while a stepper waits for the next run. After a run that
    `diverged` only `reset` helps.
    """

    source = LogSource.SIMULATION
    torques = LogTorques.BOTH
    late = 0  # a simulation waits for its references

    def __init__(self, arm: Arm, plant: Plant, observer: Observer | None = None):
        """A stepper of an arm at home, at rest. Payload and pushes act at its first tip."""
        check_driven(arm)
        self._observer = observer
        self._one_thread = _OneThread()
        self._home = arm.home
        self._home_qpos = arm.home_qpos
        self._home_ctrl = arm.home_ctrl
        self._references = _References()
        self._built = PlantModel.from_arm(arm, plant)
        self._wrench_sensor = WrenchSensor(arm, self._built)
        self._loop = TickLoop(self._built, self._wrench_sensor)
        self._run = _RunState(self._home, None)
        self.reset()

    def set_plant(self, plant: Plant, arm: Arm) -> None:
        """Gives the same simulated arm another plant. The state is lost: call `reset` afterwards."""
        self._built = PlantModel.from_arm(arm, plant, self._built)
        self._wrench_sensor = WrenchSensor(arm, self._built)
        self._loop = TickLoop(self._built, self._wrench_sensor)

    @property
    def plant(self) -> Plant:
        return self._built.plant

    @property
    def model(self) -> mujoco.MjModel:
        return self._built.model

    @property
    def data(self) -> mujoco.MjData:
        return self._built.data

    @property
    def actuation(self) -> Actuation:
        return self._built.actuation

    @property
    def n(self) -> int:
        """The number of driven joints."""
        return self._built.actuation.n

    @property
    def dt(self) -> float:
        return self._built.dt

    @property
    def continuous(self) -> bool:
        return self._built.continuous

    @property
    def description(self) -> str:
        """The plant in words."""
        return self._built.description

    @property
    def q_ref(self) -> Array:
        return self._run.q_ref

    @property
    def diverged(self) -> bool:
        return self._run.diverged

    @property
    def failure(self) -> str:
        return self._run.failure

    @failure.setter
    def failure(self, failure: str) -> None:
        self._run.failure = failure

    @property
    def blocked(self) -> str:
        """Why no motion may start: the state diverged; empty if one may."""
        return f"{self.failure}; call reset() to start again" if self.diverged else ""

    def is_still(self) -> bool:
        return bool(np.abs(self._built.v).max() < AT_REST_SPEED)

    @property
    def q(self) -> Array:
        """(n,) rad, of the links."""
        return self._built.q

    @property
    def v(self) -> Array:
        """(n,) rad/s, of the links."""
        return self._built.v

    @property
    def state(self) -> State:
        built = self._built
        wrench = self._wrench_sensor.read(self._run.push)
        deflection = built.drivetrain.deflection(built.data)
        return State(built.q, built.v, float(built.data.time), built.dt, built.continuous, wrench, deflection)

    @property
    def measured_state(self) -> State:
        """The state as the plant's sensors measure it now; the same until the next tick."""
        built = self._built
        time = float(built.data.time)
        if self._run.disturbances is None:
            q = built.q
            v = built.v
            deflection = built.drivetrain.deflection(built.data)
        else:
            q, v, deflection = self._run.disturbances.measure()
        wrench = self._wrench_sensor.measure(self._run.push, q, v, time)
        return State(q, v, time, built.dt, built.continuous, wrench, deflection)

    @property
    def motor_torque(self) -> Array:
        """(n,) N m at the joints, of the motors in the last tick; what else acts on a joint, as friction, is not among it."""
        return self._built.motor_torque

    def tip_pose(self, arm: Arm, tip: str | None = None) -> Pose:
        """The pose of one of an arm's tips in the simulation now, T_world_tip; of the first one if left out."""
        mujoco.mj_kinematics(self.model, self.data)
        frame = arm.tip_frames[0 if tip is None else arm.tips.index(tip)]
        return computed_pose(self.data.xpos[frame.body], self.data.xmat[frame.body].reshape(3, 3)) @ frame.T_body_tip

    def reset(self, q: ArrayLike | None = None, v: ArrayLike | None = None) -> None:
        """Sets time to 0 and the joints to q, rad, and v, rad/s; home and rest by default. Everything else is at home."""
        q = vector("q", self._home if q is None else q, self.n)
        v = vector("v", np.zeros(self.n) if v is None else v, self.n)
        with self._one_thread:
            self._reset(q, v)
        if self._observer is not None:
            self._observer.after_reset(self.data)

    def _reset(self, q: Array, v: Array) -> None:
        built = self._built
        built.brake.engage()
        mujoco.mj_resetData(built.model, built.data)
        built.data.qpos[: len(self._home_qpos)] = self._home_qpos
        built.actuation.joint_map.set_positions(built.data.qpos, q)
        built.actuation.joint_map.set_speeds(built.data.qvel, v, q)
        built.data.ctrl[:] = self._home_ctrl
        built.drivetrain.settle(built.model, built.data)
        mujoco.mj_forward(built.model, built.data)
        self._wrench_sensor.reset()
        self._run = _RunState(q, disturbances_of(built))

    def release(self, dofs: IntArray) -> None:
        """Releases the brake of joints outside the arm, such as a gripper's, by addresses in qvel; `reset` brakes them."""
        if self._built.brake.release(dofs):
            self.data.eq_active[:] = self.model.eq_active0

    def recorder(self) -> Recorder:
        return Recorder(self.model, self.actuation, self._references.tips, self._built.drivetrain.link_positions)

    def reference(self, trajectory: Trajectory, ticks: int) -> TickReference:
        """The first `ticks` ticks of a trajectory. The last motion is kept on its ticks: many runs follow the same one."""
        return self._references.of(trajectory, self.dt, ticks, self.continuous)

    def run(self, controller: Controller, reference: TickReference, recorder: Recorder, to_rest: Pieces | None = None) -> None:
        """Runs the tick loop along a reference, whose arrays become read-only: measure, control, step, record.

        The run ends early, and `failure` says why, if the arm diverges or the controller returns a torque that is not finite.
        If it ends by an exception, all complete ticks are recorded, and `q_ref` is the reference of the last one.
        SimulationError if an earlier run ended early, or the controller failed.
        """
        self._check_can_run()
        rows = recorder.begin(reference)
        compiled = self._loop.law_of(controller)
        if compiled is not None:
            compiled.law_for(self.dt, self.continuous)
            recorder.restart_clock()
        if self._observer is None:
            self._run_ticks(controller, rows, len(reference.q))
            return
        ticks = max(1, round(self._observer.interval / self.dt))
        self._observer.before_run()
        for first in range(0, len(reference.q), ticks):
            last = min(first + ticks, len(reference.q))
            self._run_ticks(controller, rows, last)
            self._observer.after_ticks(self.data, (last - first) * self.dt)
            if self.failure:
                return

    def come_to_rest(self, *, stop: bool) -> None:
        """Nothing: a simulation stands between two runs."""

    def instability(self, arm: Arm, controller: Controller, q: Array) -> str:
        return hooks.instability(arm, controller, q, self.plant)

    def step(self, controller: Controller, rows: TickRows) -> None:
        """Runs the next tick of rows that are not complete; SimulationError as for `run`, also if this tick ended early."""
        self._check_can_run()
        run = self._run
        if self._observer is not None and run.unobserved == 0.0:
            self._observer.before_run()
        self._run_ticks(controller, rows, rows.count + 1)
        if run.failure:
            raise SimulationError(run.failure)
        if self._observer is not None:
            run.unobserved += self.dt
            if run.unobserved > self._observer.interval - 0.5 * self.dt:
                self._observer.after_ticks(self.data, run.unobserved)
                run.unobserved = 0.0

    def _check_can_run(self) -> None:
        if self.failure:
            raise SimulationError(f"{self.failure}; call reset() to start again")

    def _run_ticks(self, controller: Controller, rows: TickRows, last: int) -> None:
        """The ticks from the first row that is not complete to the one before `last`."""
        with self._one_thread:
            begin = float(self.data.time)
            first = rows.count

            def failed(error: Exception) -> SimulationError:
                return self._controller_failed(controller, error)

            try:
                end = self._loop.run(controller, rows, last, self._run.disturbances, failed)
            finally:
                if last > first:
                    reached = rows.reference.q[min(rows.count, last - 1)]
                    self._run.q_ref = reached if hypot(*reached.tolist()) < inf else self._built.q
            if end.error:
                raise mujoco.FatalError(end.error)
            if end.status == _core.TickStatus.diverged:
                self._diverge(rows.v[end.row])
            elif end.status == _core.TickStatus.repaired:
                self._repaired(begin + (end.row - first) * self.dt)
            elif end.status == _core.TickStatus.not_finite:
                self.failure = f"the controller gave no finite torque at {self.data.time:.3f} s"

    def _controller_failed(self, controller: Controller, error: Exception) -> SimulationError:
        name = traits(controller).name
        self.failure = f"the controller {name:.80} failed at {self.data.time:.3f} s: {error}"
        return SimulationError(self.failure)

    def _repaired(self, time: float) -> None:
        """Ends a run in which MuJoCo found a number that is NaN or huge, since it then goes on from another state."""
        self._run.diverged = True
        self.failure = f"MuJoCo stopped at {time:.3f} s: {repair(self.model, self.data)}"

    def _diverge(self, v: Array) -> None:
        worst = int(np.argmax(np.abs(np.nan_to_num(v, nan=np.inf))))
        joint = self.actuation.joint_names[worst]
        unit = self.actuation.units[worst]
        self._run.diverged = True
        self.failure = f"diverged at {self.data.time:.3f} s: {joint} moves at {v[worst]:.3g} {unit}/s"
