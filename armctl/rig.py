"""Rig: a simulated arm under a controller, and the tick loop that all runs go through."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import Array, IntArray, vector
from armctl.control import Controller, State, controller_name
from armctl.errors import SimulationError
from armctl.log import Log
from armctl.plant import Plant
from armctl.pose import Pose
from armctl.recorder import Recorder
from armctl.trajectory import Setpoint, TickReference

_RUNAWAY = 1e4**2  # (rad/s)^2: a sum of squared speeds no arm survives


class Rig:
    """The plant and its state in time.

    Attributes:
        arm: The arm as its controller knows it.
        plant: How the simulated arm differs.
        model: The plant's MuJoCo model.
        data: Its MjData.
        dt: s, the tick: the plant's step and the control period.
        q_ref: (n,) rad, where the arm was last told to be.
        end: Why nothing more can be run, in words; empty while all is well.
    """

    def __init__(self, arm: Arm, plant: Plant):
        """A rig with the arm at home, at rest.

        Args:
            arm: The arm.
            plant: How reality differs from it.
        """
        self.arm, self.plant = arm, plant
        self.model = plant.model(arm)
        self.data = mujoco.MjData(self.model)
        self.dt = float(self.model.opt.timestep)
        self._qi, self._vi, self._ci = map(_index, (arm.qpos_adr, arm.dof_adr, arm.ctrl_adr))
        self.reset(arm.home, np.zeros(arm.n))

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

    def reset(self, q: ArrayLike, v: ArrayLike) -> None:
        """Starts afresh at t = 0.

        Args:
            q: (n,) rad where the arm is.
            v: (n,) rad/s how it moves.

        Raises:
            InputError: A wrong length or a number that is not finite.
        """
        q, v = vector("q", q, self.arm.n), vector("v", v, self.arm.n)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.arm.qpos(q)
        self.data.qvel[self.arm.dof_adr] = v
        self.data.ctrl[:] = self.arm.home_ctrl
        mujoco.mj_forward(self.model, self.data)
        self.q_ref, self.end = q, ""

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
        if self.end:
            raise SimulationError(f"{self.end}; reset() starts afresh")
        model, data, dt, arm = self.model, self.data, self.dt, self.arm
        qpos, qvel, ctrl, applied = data.qpos, data.qvel, data.ctrl, data.qfrc_actuator
        body_position, body_quat = data.xpos[arm.tip_body], data.xquat[arm.tip_body]
        qi, vi, ci = self._qi, self._vi, self._ci
        torque, step, rec = controller.torque, mujoco.mj_step, recorder
        rec.reserve(rec.size + len(reference.q))
        for k, row in enumerate(range(rec.size, rec.size + len(reference.q))):
            rec.q[row], rec.v[row] = qpos[qi], qvel[vi]
            q, v = rec.q[row], rec.v[row]
            if not v.dot(v) < _RUNAWAY:
                self.end = self._runaway(v)
                break
            setpoint = Setpoint(*(column[k] for column in reference))
            try:
                rec.tau_cmd[row] = tau = torque(State(q, v, data.time, dt), setpoint)
                total = float(tau.dot(tau))
            except Exception as error:
                raise self._failed(controller, error, recorder) from error
            if not total < math.inf:
                self.end = f"the controller gave no finite torque at {data.time:.3f} s"
                break
            ctrl[ci] = tau / arm.gear
            step(model, data)
            rec.q_ref[row], rec.v_ref[row], rec.a_ref[row] = setpoint[:3]
            rec.tau[row] = applied[vi]
            rec.body_position[row], rec.body_quat[row] = body_position, body_quat
            rec.size = row + 1
        last = reference.q[-1]
        self.q_ref = last if np.isfinite(last).all() else np.array(qpos[qi])

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
            dt=self.dt,
            motion_duration=float(motion_duration),
            target=goal,
            real_time_factor=recorder.size * self.dt / max(wall, 1e-9),
            end=self.end,
        )

    def _failed(self, controller: Controller, error: Exception, recorder: Recorder) -> SimulationError:
        self.end = f"the controller {controller_name(controller)} failed at {self.data.time:.3f} s: {error}"
        return SimulationError(self.end, self.log(controller, recorder, 0.0, np.full(7, np.nan), math.inf))

    def _runaway(self, v: Array) -> str:
        worst = int(np.argmax(np.abs(np.nan_to_num(v, nan=np.inf))))
        return f"diverged at {self.data.time:.3f} s: {self.arm.joint_names[worst]} moves at {v[worst]:.3g} rad/s"


def _index(addresses: IntArray) -> slice | IntArray:
    """Addresses as a slice where they are consecutive: NumPy reads and writes those faster."""
    first = int(addresses[0])
    consecutive = np.array_equal(addresses, np.arange(first, first + len(addresses)))
    return slice(first, first + len(addresses)) if consecutive else addresses
