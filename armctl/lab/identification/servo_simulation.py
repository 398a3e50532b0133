"""Rollouts of position-controlled arms by MuJoCo's own model, many parameters at once, on threads."""

from __future__ import annotations

import copy
import math
import os
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.log import Log
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.brake import brake
from armctl.run.sim.drivetrain import apply_drivetrain, drivetrain_of, finish_drivetrain, new_model
from armctl.run.sim.plant import Plant, apply_plant, held_dofs

_ROLLOUTS_AT_ONCE = 16  # bounds the memory of their states
_SOLVER_TOLERANCE = 1e-12  # of dry friction, so that finite differences show parameters and not its rounding
_MIN_BACKLASH = 1e-6  # rad, of a joint that has a rotor in the model
FINER = 4  # times the steps of the arm, in the limit of short ones
_LOST = 1e3  # rad, instead of positions that are not finite


@dataclass(frozen=True, slots=True, eq=False)
class ServoParameters:
    """The parameters of an arm's position servos: torque = stiffness (command - q) - damping v, within the torque limits.

    Attributes:
        armature: (n,) kg m^2, inertia of the rotors at the joints.
        stiffness: (n,) N m/rad (kp of MuJoCo's position actuator).
        damping: (n,) N m s/rad (its kv), beside the joint damping of the file.
        coulomb_friction: (n,) N m (MuJoCo's frictionloss).
        offset: (n,) rad, by which measured positions differ from those that are commanded.
        backlash: (n,) rad, the gap between each measured motor and its link, as that of a `Plant`.
        delay: s, from a command until measured positions respond.
    """

    armature: Array
    stiffness: Array
    damping: Array
    coulomb_friction: Array
    offset: Array
    backlash: Array
    delay: float


class ServoSimulation:
    """Rollouts of an arm; with `gaps`, motors are bodies of their own, as in plants with backlash."""

    def __init__(self, arm: Arm, dt: float, gaps: bool):
        self.arm = arm
        self.gaps = gaps
        geared = Plant(backlash=_MIN_BACKLASH if gaps else 0.0)
        model = new_model(arm, geared)
        apply_plant(model, mujoco.MjData(model), Plant(), arm)  # its masses and places are the arm's, not the file's
        self._train = drivetrain_of(arm, geared)
        self._steps = max(1, math.ceil(dt / model.opt.timestep - 1e-9))  # from one sample to the next
        model.opt.timestep = dt / self._steps
        # A plant has no reset: unstable candidates end in numbers that are not finite. Contacts would take most of the time.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.opt.tolerance = _SOLVER_TOLERANCE
        self._actuators = arm.model.actuator_ctrladr.searchsorted(arm.ctrl_adr)
        model.actuator_delay[:] = 0.0
        model.actuator_ctrllimited[self._actuators] = 0
        model.actuator_biastype[self._actuators] = int(mujoco.mjtBias.mjBIAS_AFFINE)
        limit = arm.limits.tau_max / np.abs(arm.gear)
        model.actuator_forcelimited[self._actuators] = np.isfinite(limit)
        model.actuator_forcerange[self._actuators] = np.column_stack([-limit, limit])
        self._model = model
        self._data = mujoco.MjData(model)

    def limit(self, candidates: list[ServoParameters], log: Log, starts: Array | None = None, finer: int = FINER) -> Array:
        """(B, T, n) rad, the measured positions without the error of first order that steps have.

        Args:
            candidates: B parameters.
            log: The recording with the commands.
            starts: (B, n) rad, the measured positions of each at the start, at rest; the first of the recording if None.
            finer: By what steps are divided, and by half of which again: Richardson's extrapolation (1911) from both.
        """
        once = self._divided(finer // 2).positions(candidates, log, starts)
        twice = self._divided(finer).positions(candidates, log, starts)
        return 2.0 * twice - once

    def _divided(self, by: int) -> ServoSimulation:
        finer = copy.copy(self)
        finer._steps = by * self._steps
        finer._model = copy.copy(self._model)
        finer._model.opt.timestep /= by
        return finer

    def positions(self, candidates: list[ServoParameters], log: Log, starts: Array | None = None) -> Array:
        """(B, T, n) rad, the measured positions along a recording's commands for each candidate, in the arm's steps."""
        from mujoco import rollout

        offsets = np.array([each.offset for each in candidates])
        links = (log.q[0] if starts is None else starts) - offsets
        found = np.empty((len(candidates), len(log), self.arm.n))
        threads = [mujoco.MjData(self._model) for _ in range(min(len(candidates), os.cpu_count() or 1))]
        for first in range(0, len(candidates), _ROLLOUTS_AT_ONCE):
            part = candidates[first : first + _ROLLOUTS_AT_ONCE]
            states, _ = rollout.rollout(
                [self.model(each) for each in part],
                threads,
                np.array([self._start(q) for q in links[first : first + len(part)]]),
                np.array([self._controls(log, each.delay) for each in part]),
            )
            columns = 1 + self._train.motor_qpos  # behind the time
            moved = np.asarray(states)[:, self._steps - 1 :: self._steps, columns]
            found[first : first + len(part), 1:] = np.where(np.isfinite(moved), np.clip(moved, -_LOST, _LOST), _LOST)
        found[:, 0] = links
        return found + offsets[:, None]

    def model(self, parameters: ServoParameters) -> mujoco.MjModel:
        """The model with position servos on its joints; all other joints are braked."""
        model = copy.copy(self._model)
        gear = self.arm.gear
        set_rotors_and_friction(model, self.arm, parameters)
        if self._train.rotors:
            geared = Plant(backlash=np.maximum(parameters.backlash, _MIN_BACKLASH), rotor_inertia=parameters.armature)
            apply_drivetrain(model, geared, self.arm, self._train)
            mujoco.mj_setConst(model, mujoco.MjData(model))
            finish_drivetrain(model, geared, self._train)
        model.actuator_gainprm[self._actuators, 0] = parameters.stiffness / gear
        model.actuator_biasprm[self._actuators, 0] = 0.0
        model.actuator_biasprm[self._actuators, 1] = -parameters.stiffness / gear**2
        model.actuator_biasprm[self._actuators, 2] = -parameters.damping / gear**2
        brake(model, held_dofs(self.arm))
        return model

    def _start(self, q: Array) -> Array:
        kind = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[: self.arm.model.nq] = self.arm.qpos(q)
        self._data.qpos[self._train.motor_qpos] = q
        state = np.empty(mujoco.mj_stateSize(self._model, kind))
        mujoco.mj_getState(self._model, self._data, state, kind)
        return state

    def _controls(self, log: Log, delay: float) -> Array:
        """(steps, nctrl), delayed commands: means over steps, which change continuously with the delay, as a fit needs."""
        controls = np.tile(self.arm.home_ctrl, ((len(log) - 1) * self._steps, 1))
        step = log.dt / self._steps
        delay = delay + 0.5 * step  # positions of semi-implicit steps are half a step early
        before = delay + log.dt
        times = np.concatenate([[-before], np.arange(len(log)) * log.dt])
        edges = np.arange(len(controls) + 1) * step - delay
        for joint, address in enumerate(self.arm.ctrl_adr):
            command = log.q_ref[:, joint]
            integral = np.concatenate([[-before * command[0], 0.0], np.cumsum(command[:-1]) * log.dt])
            controls[:, address] = np.diff(np.interp(edges, times, integral)) * (self._steps / log.dt)
        return controls


def set_rotors_and_friction(model: mujoco.MjModel, arm: Arm, parameters: ServoParameters) -> None:
    model.dof_armature[arm.dof_adr] = parameters.armature
    model.dof_frictionloss[arm.dof_adr] = parameters.coulomb_friction
    mujoco.mj_setConst(model, mujoco.MjData(model))
