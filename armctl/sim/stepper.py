"""Stepper: a simulated arm under a controller, and the tick loop that all runs go through."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.control import Controller, State, controller_name
from armctl.core.log import Log, SimulationError
from armctl.core.pose import Pose
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array, IntArray, vector
from armctl.robot.arm import Arm
from armctl.sim.disturbances import Disturbances
from armctl.sim.plant import Plant
from armctl.sim.recorder import Recorder

_BRAKED = ("dof_armature", "dof_frictionloss", "jnt_limited", "tendon_limited", "tendon_frictionloss", "eq_active0")
_RUNAWAY = 1e4  # rad/s: speeds no arm survives


class Observer(Protocol):
    """Something that watches the tick loop, such as a viewer. It must not change the state; it may take its time.

    Attributes:
        interval: s of simulated time between two calls of `after_ticks`.
    """

    interval: float

    def after_reset(self, data: mujoco.MjData) -> None:
        """The state was set anew.

        Args:
            data: The plant's state.
        """
        ...

    def before_run(self) -> None:
        """A run begins."""
        ...

    def after_ticks(self, data: mujoco.MjData, seconds: float) -> None:
        """A few ticks of a run are over.

        Args:
            data: The plant's state.
            seconds: Simulated time since the last call, s.
        """
        ...


class Stepper:
    """The plant and its state in time.

    Attributes:
        arm: The arm as its controller knows it.
        plant: How the simulated arm differs.
        model: The plant's MuJoCo model.
        data: Its MjData.
        dt: s, the tick: the control period.
        continuous: Whether the arm moves on continuously between ticks.
        q_ref: (n,) rad, where the arm was last told to be.
        failure: Why nothing more can be run, in words; empty while all is well.
    """

    def __init__(self, arm: Arm, plant: Plant, observer: Observer | None = None):
        """A stepper with the arm at home, at rest.

        Args:
            arm: The arm.
            plant: How reality differs from it.
            observer: What watches the tick loop, or None.
        """
        self.arm, self.plant, self._observer = arm, plant, observer
        self._loose = np.zeros(0, dtype=np.int64)
        self.model = plant.model(arm)
        self.data = mujoco.MjData(self.model)
        self.continuous = bool(self.model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4))
        self.dt = arm.dt if plant.timestep is None else float(plant.timestep)
        self._steps = round(self.dt / self.model.opt.timestep)
        self._motors = _index(arm.ctrl_adr)
        addresses = (arm.qpos_adr, arm.dof_adr, arm.actuation.torque_adr)
        self._read = list(map(_reader, (self.data.qpos, self.data.qvel, self.data.qfrc_actuator), addresses))
        self.reset(arm.home, np.zeros(arm.n))

    @property
    def state(self) -> State:
        """The arm's state now."""
        return State(
            self.data.qpos[self.arm.qpos_adr], self.data.qvel[self.arm.dof_adr], float(self.data.time), self.dt, self.continuous
        )

    @property
    def tip(self) -> Pose:
        """Where the simulated tip is now, T_world_tip."""
        mujoco.mj_kinematics(self.model, self.data)
        body = self.arm.tip_body
        return Pose.from_rotation(self.data.xpos[body], self.data.xmat[body].reshape(3, 3)) @ self.arm.T_body_tip

    def reset(self, q: ArrayLike, v: ArrayLike) -> None:
        """Starts afresh at t = 0.

        Args:
            q: (n,) rad where the arm is.
            v: (n,) rad/s how it moves.

        Raises:
            InputError: A wrong length or a number that is not finite.
        """
        q, v = vector("q", q, self.arm.n), vector("v", v, self.arm.n)
        if len(self._loose):
            self._set_loose(self._loose[:0])
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.arm.qpos(q)
        self.data.qvel[:] = self.arm.qvel(v)
        self.data.ctrl[:] = self.arm.home_ctrl
        mujoco.mj_forward(self.model, self.data)
        self.q_ref, self.failure = q, ""
        self._disturbances = Disturbances(self.plant, self.arm, self.data) if self.plant.disturbs else None
        if self._observer is not None:
            self._observer.after_reset(self.data)

    def loosen(self, dofs: IntArray) -> None:
        """Takes the brake off joints outside the arm, such as a gripper's; `reset` puts it on again.

        Args:
            dofs: Their addresses in `MjData.qvel`.
        """
        if not np.isin(dofs, self._loose).all():
            self._set_loose(np.union1d(self._loose, dofs))
            self.data.eq_active[:] = self.model.eq_active0

    def _set_loose(self, dofs: IntArray) -> None:
        self._loose, source = dofs, self.plant.model(self.arm, dofs)
        for name in _BRAKED:
            getattr(self.model, name)[:] = getattr(source, name)
        self.model.opt.tolerance = source.opt.tolerance

    def reference(self, trajectory: Trajectory, ticks: int) -> TickReference:
        """A trajectory on this stepper's ticks.

        Args:
            trajectory: The motion.
            ticks: How many ticks, from its beginning on.

        Returns:
            Its rows.
        """
        return TickReference.of(trajectory, self.dt, ticks, self.continuous)

    def follow(self, controller: Controller, reference: TickReference, recorder: Recorder) -> None:
        """The tick loop: measure, control, record, step.

        It ends early, and `end` says why, where the arm runs away or the controller gives no finite torque.

        Args:
            controller: What makes the torques.
            reference: Where the arm should be, tick by tick.
            recorder: What it is recorded in.

        Raises:
            SimulationError: The controller failed, or an earlier run ended early; `error.log` holds what there was until then.
        """
        if self.failure:
            raise SimulationError(f"{self.failure}; reset() starts afresh")
        if self._observer is None:
            self._run_ticks(controller, reference, recorder)
            return
        ticks = max(1, round(self._observer.interval / self.dt))
        self._observer.before_run()
        for first in range(0, len(reference.q), ticks):
            part = TickReference(*(np.asarray(column)[first : first + ticks] for column in reference))
            self._run_ticks(controller, part, recorder)
            self._observer.after_ticks(self.data, len(part.q) * self.dt)
            if self.failure:
                return

    def _run_ticks(self, controller: Controller, reference: TickReference, recorder: Recorder) -> None:
        model, data, dt, continuous, steps = self.model, self.data, self.dt, self.continuous, self._steps
        (read_q, read_v, read_tau), motors, gear, qpos, ctrl = self._read, self._motors, self.arm.gear, data.qpos, data.ctrl
        torque, step, disturbances, tape = controller.torque, mujoco.mj_step, self._disturbances, recorder.tape
        share = self.arm.actuation.torque_share
        is_whole = bool((share == 1.0).all())
        direct = disturbances is None and isinstance(motors, slice) and bool((gear == 1.0).all())
        command = ctrl[motors] if direct else np.empty(self.arm.n)
        length = math.hypot  # of a short list, faster than numpy's dot
        new = tuple.__new__  # a NamedTuple's own constructor takes twice as long
        recorder.follow(reference)
        for wanted in zip(*reference, strict=True):
            q, v = read_q(), read_v()
            if not length(*v.tolist()) < _RUNAWAY:
                self.failure = self._runaway(v)
                break
            row = qpos.tobytes() + v.tobytes()
            q_seen, v_seen = (q, v) if disturbances is None else disturbances.measured(q, v)
            try:
                tau = torque(new(State, (q_seen, v_seen, data.time, dt, continuous)), new(Setpoint, wanted))
                command[:] = tau if len(tau) == len(command) else vector("torque", tau, len(command))
            except Exception as error:
                raise self._failed(controller, error, recorder) from error
            if not length(*command.tolist()) < math.inf:
                self.failure = f"the controller gave no finite torque at {data.time:.3f} s"
                break
            if not direct:
                ctrl[motors] = (command if disturbances is None else disturbances.driven(command, q)) / gear
            step(model, data, steps)
            done = read_tau() if is_whole else read_tau() * share
            tape += row + command.tobytes() + done.tobytes()
        last = reference.q[-1]
        self.q_ref = last if np.isfinite(last).all() else read_q()

    def hold(self, controller: Controller, seconds: float) -> None:
        """Holds the arm where it was last told to be, unrecorded.

        Args:
            controller: What makes the torques.
            seconds: How long, at least one tick.

        Raises:
            SimulationError: As for `follow`.
        """
        still = np.zeros((max(1, round(seconds / self.dt)), self.arm.n))
        self.follow(controller, TickReference(self.q_ref + still, *[still] * 4), Recorder(self.arm))

    def log(self, controller: Controller, recorder: Recorder, motion_duration: float, goal: Array, wall: float) -> Log:
        """What was recorded, as a Log.

        Args:
            controller: What made the torques.
            recorder: What it was recorded in.
            motion_duration: s, when the reference came to rest.
            goal: (7,) where the tip should end, NaN for what was not asked for.
            wall: s that it took.

        Returns:
            The log.
        """
        return recorder.log(
            self.arm,
            controller=controller_name(controller),
            plant=str(self.plant),
            dt=self.dt,
            motion_duration=float(motion_duration),
            target=goal,
            real_time_factor=recorder.size * self.dt / max(wall, 1e-9),
            failure=self.failure,
        )

    def _failed(self, controller: Controller, error: Exception, recorder: Recorder) -> SimulationError:
        self.failure = f"the controller {controller_name(controller)} failed at {self.data.time:.3f} s: {error}"
        return SimulationError(self.failure, self.log(controller, recorder, 0.0, np.full(7, np.nan), math.inf))

    def _runaway(self, v: Array) -> str:
        worst = int(np.argmax(np.abs(np.nan_to_num(v, nan=np.inf))))
        joint, unit = self.arm.joint_names[worst], self.arm.units[worst]
        return f"diverged at {self.data.time:.3f} s: {joint} moves at {v[worst]:.3g} {unit}/s"


class ConstantTorque:
    """The controller of an open-loop run.

    Attributes:
        tau: (n,) N m.
    """

    name = "constant"

    def __init__(self, tau: Array):
        """A controller that gives one torque whatever happens.

        Args:
            tau: (n,) N m.
        """
        self.tau = tau

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: Not looked at.
            setpoint: Not looked at.

        Returns:
            (n,) N m.
        """
        return self.tau


def _index(addresses: IntArray) -> slice | IntArray:
    """Addresses as a slice where they are consecutive: NumPy reads and writes those faster."""
    first = int(addresses[0])
    consecutive = np.array_equal(addresses, np.arange(first, first + len(addresses)))
    return slice(first, first + len(addresses)) if consecutive else addresses


def _reader(values: Array, addresses: IntArray) -> Callable[[], Array]:
    """A function that copies some of MuJoCo's numbers as they are when it is called."""
    index = _index(addresses)
    return values[index].copy if isinstance(index, slice) else partial(values.take, index)
