"""Simulation: the only object that changes in time. It owns the plant, its MjData and the clock."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import Array, IntArray, number, vector
from armctl.control import ComputedTorque, Controller, State, controller_by_name, controller_name
from armctl.errors import InputError, LimitError, SimulationError
from armctl.ik import solve_ik
from armctl.log import Log
from armctl.motion import move_j
from armctl.plant import Plant
from armctl.pose import Pose, rotation_angle
from armctl.recorder import Recorder
from armctl.robots import TARGET, load
from armctl.trajectory import Setpoint, TickReference, Trajectory

TOLERANCE = 1e-3  # m: within it a move counts as reached
ANGLE_TOLERANCE = 1e-2  # rad
_SETTLED_SPEED = 1e-3  # rad/s
_SETTLE_CHUNK = 0.02  # s
_RUNAWAY = 1e4**2  # (rad/s)^2: a sum of squared speeds no arm survives


@dataclass(frozen=True, eq=False)
class MoveResult:
    """How a move ended.

    Attributes:
        reached: Whether the tip is at the target and at rest.
        position_error: m, measured in the simulation.
        orientation_error: rad, measured likewise; 0 where no orientation was asked for.
        duration: s of simulated time.
        reason: Why it was not reached, in words; empty if it was.
        log: Every tick of it; None where nothing moved.
    """

    reached: bool
    position_error: float
    orientation_error: float
    duration: float
    reason: str
    log: Log | None

    def __bool__(self) -> bool:
        return self.reached

    def __str__(self) -> str:
        if self.reached:
            return f"reached within {max(1e3 * self.position_error, 0.01):.2g} mm in {self.duration:.2f} s"
        return f"not reached: {self.reason}"


class Simulation:
    """An arm in its scene, with a controller, commanded in Cartesian or joint targets.

    Attributes:
        arm: The arm as its controller knows it.
        controller: What makes the torques.
        plant: How the simulated arm differs.
        model: The plant's MuJoCo model.
        data: Its MjData; read it freely.
        log: The last run, or None.
    """

    def __init__(self, robot: Arm | str, controller: Controller | str | None = None, plant: Plant | None = None):
        """A simulation with the arm at home, at rest.

        Args:
            robot: An arm, or a name for `armctl.load`.
            controller: A controller or the name of one; computed torque if left out.
            plant: How reality differs from the model; in nothing if left out.

        Raises:
            InputError: The controller has no method `torque`.
            UnknownNameError: There is no such robot or controller.
            ModelError: The robot's model is no arm.
        """
        self.arm = robot if isinstance(robot, Arm) else load(robot)
        if isinstance(controller, str):
            controller = controller_by_name(controller, self.arm)
        self.controller = ComputedTorque(self.arm) if controller is None else controller
        if not callable(getattr(self.controller, "torque", None)):
            raise InputError(f"controller: {controller!r} has no method torque(state, setpoint)")
        self.plant = Plant() if plant is None else plant
        self.model = self.plant.model(self.arm)
        self.data = mujoco.MjData(self.model)
        self.log: Log | None = None
        self._adr = tuple(map(_index, (self.arm.qpos_adr, self.arm.dof_adr, self.arm.ctrl_adr)))
        self.reset()

    @property
    def dt(self) -> float:
        """The tick, s: the plant's step and the control period."""
        return float(self.model.opt.timestep)

    @property
    def state(self) -> State:
        """The arm's state now."""
        return State(self.data.qpos[self.arm.qpos_adr], self.data.qvel[self.arm.dof_adr], float(self.data.time), self.dt)

    @property
    def tip(self) -> Pose:
        """Where the simulated tip is now, T_world_tip."""
        mujoco.mj_kinematics(self.model, self.data)
        body = self.arm.tip_body
        return Pose.from_rotation(self.data.xpos[body], self.data.xmat[body].reshape(3, 3)) @ self.arm.T_body_tip

    @property
    def target(self) -> Array:
        """(3,) m, where the green target is now."""
        return self.data.xpos[mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, TARGET)].copy()

    def reset(self, q: ArrayLike | None = None, v: ArrayLike | None = None) -> None:
        """Starts afresh at t = 0.

        Args:
            q: (n,) rad where the arm is; home if left out.
            v: (n,) rad/s how it moves; at rest if left out.

        Raises:
            InputError: A wrong length or a number that is not finite.
        """
        q = self.arm.home if q is None else vector("q", q, self.arm.n)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.arm.qpos(q)
        self.data.qvel[self.arm.dof_adr] = 0.0 if v is None else vector("v", v, self.arm.n)
        self.data.ctrl[:] = self.arm.home_ctrl
        mujoco.mj_forward(self.model, self.data)
        self._q_ref, self._end = np.array(q), ""

    def run(self, trajectory: Trajectory, settle: float = 0.0) -> Log:
        """Follows a trajectory, starting now.

        Args:
            trajectory: The motion; it should start where the arm is.
            settle: s to go on holding its end.

        Returns:
            Every tick of it. A run that diverges ends early, and `log.end` says why.

        Raises:
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        recorder = Recorder(self.arm.n)
        ticks = _ticks(trajectory.duration + number("settle", settle, 0.0), self.dt)
        started = time.perf_counter()
        self._follow(TickReference.of(trajectory, self.dt, ticks), recorder)
        self.log = self._log(recorder, trajectory.duration, np.full(7, np.nan), time.perf_counter() - started)
        return self.log

    def move_to(
        self,
        target: Pose | ArrayLike,
        *,
        tolerance: float = TOLERANCE,
        angle_tolerance: float = ANGLE_TOLERANCE,
        settle: float = 1.0,
    ) -> MoveResult:
        """Brings the tip to a target by inverse kinematics and a jerk-limited motion of the joints.

        Args:
            target: T_world_tip, or (3,) m where the orientation does not matter.
            tolerance: m within which the target counts as reached.
            angle_tolerance: rad, likewise.
            settle: s that the arm may take to come to rest after the motion.

        Returns:
            How it ended; what the world refuses (out of reach, not settled, diverged) is in its `reason`.

        Raises:
            InputError: The target has a wrong length or a number that is not finite, or a tolerance is negative.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        goal = _goal(target)
        number("tolerance", tolerance, 0.0)
        number("angle_tolerance", angle_tolerance, 0.0)
        self.show_target(goal)
        if self._end:
            return self._refused(goal, f"{self._end}; reset() starts afresh")
        ik = solve_ik(self.arm, target, self.arm.limits.clamp(self._q_ref))
        if not ik.ok:
            short = 1e3 * ik.position_error
            return self._refused(goal, f"out of reach by {short:.1f} mm" if short >= 0.1 else ik.reason)
        trajectory = move_j(self.arm, self.arm.limits.clamp(self._q_ref), ik.q)
        return self._move(trajectory, goal, tolerance, angle_tolerance, number("settle", settle, 0.0))

    def apply_ctrl(self, ctrl: ArrayLike, seconds: float) -> Log:
        """Holds the arm's motors at constant controls, without a controller.

        Args:
            ctrl: (n,) controls, in the units of the model's motors: torque = gear x ctrl.
            seconds: How long, s.

        Returns:
            Every tick of it; its references are NaN.

        Raises:
            InputError: A wrong length, a number that is not finite, or a negative time.
            LimitError: A control outside its motor's range.
        """
        ctrl, bound = vector("ctrl", ctrl, self.arm.n), self.arm.limits.tau_max / np.abs(self.arm.gear)
        outside = np.abs(ctrl) > bound * (1 + 1e-9)
        if outside.any():
            i = int(outside.argmax())
            raise LimitError(f"ctrl: {self.arm.joint_names[i]}: {ctrl[i]:g} is outside [{-bound[i]:g}, {bound[i]:g}]")
        recorder, controller = Recorder(self.arm.n), self.controller
        nothing = np.full((_ticks(number("seconds", seconds, 0.0), self.dt), self.arm.n), np.nan)
        self.controller = _Constant(ctrl * self.arm.gear)
        try:
            self._follow(TickReference(*[nothing] * 5), recorder)
            self.log = self._log(recorder, seconds, np.full(7, np.nan), math.inf)
        finally:
            self.controller = controller
        return self.log

    def show_target(self, goal: ArrayLike) -> None:
        """Puts the green target somewhere.

        Args:
            goal: (3,) m, or (7,) with the orientation as wxyz.
        """
        goal = np.asarray(goal, dtype=np.float64)
        body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, TARGET)
        mocap = self.model.body_mocapid[body]
        if mocap >= 0:
            self.data.mocap_pos[mocap] = goal[:3]
            if goal.size == 7 and np.isfinite(goal[3:]).all():
                self.data.mocap_quat[mocap] = goal[3:]

    def _move(self, trajectory: Trajectory, goal: Array, tolerance: float, angle: float, settle: float) -> MoveResult:
        """Follows a motion, then holds its end until the tip has come to rest, at most `settle` seconds."""
        recorder, started, begin = Recorder(self.arm.n), time.perf_counter(), self.data.time
        self._follow(TickReference.of(trajectory, self.dt, _ticks(trajectory.duration, self.dt)), recorder)
        end = trajectory(trajectory.duration)
        chunk = _ticks(_SETTLE_CHUNK, self.dt)
        still = np.zeros((chunk, self.arm.n))
        hold = TickReference(end.q + still, still, still, still, still)
        deadline = self.data.time + settle
        while not self._end and not self._arrived(goal, tolerance, angle) and self.data.time < deadline:
            self._follow(hold, recorder)
        self.log = self._log(recorder, trajectory.duration, goal, time.perf_counter() - started)
        position_error, orientation_error = self._distance(goal)
        reason = self._end
        if not reason and (position_error > tolerance or orientation_error > angle):
            reason = f"the tip is {1e3 * position_error:.3g} mm and {orientation_error:.3g} rad from the target"
        elif not reason and not self._at_rest():
            reason = f"the arm has not come to rest within {settle:g} s"
        duration = float(self.data.time - begin)
        return MoveResult(not reason, position_error, orientation_error, duration, reason, self.log)

    def _follow(self, reference: TickReference, recorder: Recorder) -> None:
        """The tick loop: measure, control, record, step. All runs go through here."""
        if self._end:
            raise SimulationError(f"{self._end}; reset() starts afresh", self.log)
        model, data, dt, arm = self.model, self.data, self.dt, self.arm
        qpos, qvel, ctrl, applied = data.qpos, data.qvel, data.ctrl, data.qfrc_actuator
        body_position, body_quat = data.xpos[arm.tip_body], data.xquat[arm.tip_body]
        qi, vi, ci = self._adr
        torque, step, rec = self.controller.torque, mujoco.mj_step, recorder
        rec.reserve(rec.size + len(reference.q))
        for k, row in enumerate(range(rec.size, rec.size + len(reference.q))):
            rec.q[row], rec.v[row] = qpos[qi], qvel[vi]
            q, v = rec.q[row], rec.v[row]
            if not v.dot(v) < _RUNAWAY:
                self._end = self._runaway(v)
                break
            setpoint = Setpoint(*(column[k] for column in reference))
            try:
                rec.tau_cmd[row] = tau = torque(State(q, v, data.time, dt), setpoint)
                total = float(tau.dot(tau))
            except Exception as error:
                raise self._failed(error, recorder) from error
            if not total < math.inf:
                self._end = f"the controller gave no finite torque at {data.time:.3f} s"
                break
            ctrl[ci] = tau / arm.gear
            step(model, data)
            rec.q_ref[row], rec.v_ref[row], rec.a_ref[row] = setpoint[:3]
            rec.tau[row] = applied[vi]
            rec.body_position[row], rec.body_quat[row] = body_position, body_quat
            rec.size = row + 1
        last = reference.q[-1]
        self._q_ref = last if np.isfinite(last).all() else np.array(qpos[qi])

    def _log(self, recorder: Recorder, motion_duration: float, goal: Array, wall: float) -> Log:
        return recorder.log(
            self.arm,
            controller=controller_name(self.controller),
            dt=self.dt,
            motion_duration=float(motion_duration),
            target=goal,
            real_time_factor=recorder.size * self.dt / max(wall, 1e-9),
            end=self._end,
        )

    def _failed(self, error: Exception, recorder: Recorder) -> SimulationError:
        self._end = f"the controller {controller_name(self.controller)} failed at {self.data.time:.3f} s: {error}"
        self.log = self._log(recorder, 0.0, np.full(7, np.nan), 0.0)
        return SimulationError(self._end, self.log)

    def _runaway(self, v: Array) -> str:
        worst = int(np.argmax(np.abs(np.nan_to_num(v, nan=np.inf))))
        return f"diverged at {self.data.time:.3f} s: {self.arm.joint_names[worst]} moves at {v[worst]:.3g} rad/s"

    def _refused(self, goal: Array, reason: str) -> MoveResult:
        return MoveResult(False, *self._distance(goal), 0.0, reason, None)

    def _distance(self, goal: Array) -> tuple[float, float]:
        tip = self.tip
        position_error = float(np.linalg.norm(tip.position - goal[:3]))
        if np.isnan(goal[3:]).any():
            return position_error, 0.0
        return position_error, rotation_angle(tip.rotation.T @ Pose(goal[:3], goal[3:]).rotation)

    def _arrived(self, goal: Array, tolerance: float, angle: float) -> bool:
        position_error, orientation_error = self._distance(goal)
        return self._at_rest() and position_error <= tolerance and orientation_error <= angle

    def _at_rest(self) -> bool:
        return bool(np.abs(self.data.qvel[self.arm.dof_adr]).max() < _SETTLED_SPEED)


def simulate(
    arm: Arm, controller: Controller | str, trajectory: Trajectory, plant: Plant | None = None, settle: float = 0.25
) -> Log:
    """Follows a trajectory from its start, in a simulation of its own.

    Args:
        arm: The arm.
        controller: A controller or the name of one.
        trajectory: The motion.
        plant: How reality differs from the model; in nothing if left out.
        settle: s to go on holding its end.

    Returns:
        Every tick of it. A run that diverges ends early, and `log.end` says why.

    Raises:
        UnknownNameError: There is no such controller.
        SimulationError: The controller failed; `error.log` holds what there was until then.
    """
    simulation = Simulation(arm, controller, plant)
    start = trajectory(0.0)
    simulation.reset(start.q, start.v)
    return simulation.run(trajectory, settle)


class _Constant:
    """The controller of an open-loop run."""

    name = "constant"

    def __init__(self, tau: Array):
        self.tau = tau

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        return self.tau


def _ticks(duration: float, dt: float) -> int:
    """How many ticks show a motion from its first instant to its last."""
    return math.ceil(duration / dt - 1e-9) + 1


def _index(addresses: IntArray) -> slice | IntArray:
    """Addresses as a slice where they are consecutive: NumPy reads and writes those faster."""
    first = int(addresses[0])
    consecutive = np.array_equal(addresses, np.arange(first, first + len(addresses)))
    return slice(first, first + len(addresses)) if consecutive else addresses


def _goal(target: Pose | ArrayLike) -> Array:
    if isinstance(target, Pose):
        return np.concatenate([target.position, target.quat])
    return np.concatenate([vector("target", target, 3), np.full(4, np.nan)])
