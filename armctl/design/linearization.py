"""Linearization of an arm and a controller around a configuration."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.control import Controller, controller_name
from armctl.core.errors import InputError
from armctl.core.validation import Array, integer, number
from armctl.design.loop import MAX_DELAY_TICKS, Loop
from armctl.design.state_space import StateSpace, linear_controller
from armctl.robot.arm import Arm, check_arm
from armctl.sim.move import read_controller
from armctl.sim.plant import Plant, read_plant

_POSITION_STEP = 1e-6  # rad (m), and rad/s (m/s), of the central differences of the plant
_TORQUE_STEP = 1e-4  # of the torque limits
_WHOLE_TICK_TOLERANCE = 1e-6
_SWITCHED_OFF = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT,
    mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS,
    mujoco.mjtDisableBit.mjDSBL_LIMIT,
)


class LinearArm(NamedTuple):
    """An arm at rest at a configuration, linear in small deviations, over one control period.

    The state x has the positions and velocities of the joints: x[k + 1] = A x[k] + B tau[k].

    Attributes:
        A: (2n, 2n).
        B: (2n, n).
        holding_torque: (n,) N m that holds the arm still; tau is the deviation from it.
        dt: s, the control period.
    """

    A: Array
    B: Array
    holding_torque: Array
    dt: float


def linear_arm(arm: Arm, q: ArrayLike, plant: Plant | None = None) -> LinearArm:
    """Linearizes an arm without a controller, for the design of controllers of your own.

    The arm is differentiated through one control period of the simulation, in which the torque is held. Contacts, limits and
    dry friction are left out.

    Args:
        q: (n,) rad, the configuration.
        plant: How the simulated arm differs from the model; by default it does not.

    Returns:
        A, B, the torque that holds the arm, and the control period.

    Raises:
        InputError: An argument has a wrong type, length or value.
        LimitError: A position outside the limits.
    """
    check_arm(arm)
    return Linearizer(arm, read_plant(plant)).arm_at(arm.checked("q", q))


def linearize(arm: Arm, controller: Controller | str, q: ArrayLike, plant: Plant | None = None, delay: float = 0.0) -> Loop:
    """Linearizes the loop of an arm and a controller that holds it at a configuration.

    The arm is that of `linear_arm`. The controller can be any object with a method
    `torque(state, setpoint)`: its linear model, memory included, follows from its responses to small impulses.

    Args:
        controller: A controller or its name. Its own memory does not change if it can be copied.
        q: (n,) rad, the configuration.
        plant: How the simulated arm differs from the model; by default it does not. Its noise, pushes and dry friction
            have no effect.
        delay: s of delay between controller and motors besides that of the plant; a whole number of control periods.

    Returns:
        The loop, broken at the input of the motors.

    Raises:
        InputError: An argument has a wrong type, length or value.
        LimitError: A position outside the limits.
        ModelError: The controller fails, or no linear model describes it.
        UnknownNameError: There is no such controller.
    """
    check_arm(arm)
    law = read_controller(controller, arm)
    return loop_at(arm, law, arm.checked("q", q), read_plant(plant), number("delay", delay, 0.0))


def loop_at(arm: Arm, controller: Controller, q: Array, plant: Plant, delay: float = 0.0) -> Loop:
    """`linearize` for checked arguments."""
    return Linearizer(arm, plant).loop_at(controller, q, delay)


class Linearizer:
    """Linearizes one plant at many configurations; a copy of a model with meshes takes longer than the rest."""

    def __init__(self, arm: Arm, plant: Plant):
        self.arm = arm
        self.plant = plant
        self.dt = arm.dt if plant.timestep is None else plant.timestep
        self._model = plant.model(arm)
        for bit in _SWITCHED_OFF:
            self._model.opt.disableflags |= int(bit)
        self._model.actuator_ctrllimited[:] = 0
        self._model.actuator_forcelimited[:] = 0
        self._model.jnt_actfrclimited[:] = 0
        self._data = mujoco.MjData(self._model)
        self._substeps = round(self.dt / self._model.opt.timestep)

    def arm_at(self, q: Array) -> LinearArm:
        """The arm at rest at q."""
        arm = self.arm
        n = arm.n
        data = self._data
        self._place(q)
        mujoco.mj_forward(self._model, data)
        holding = arm.joint_map.reduced(data.qfrc_bias - data.qfrc_passive)
        x = np.concatenate([q, np.zeros(n), holding])
        steps = np.concatenate([np.full(2 * n, _POSITION_STEP), _TORQUE_STEP * arm.limits.tau_max])
        columns = []
        for i, step in enumerate(steps):
            change = np.zeros(3 * n)
            change[i] = step
            columns.append((self._after_tick(x + change) - self._after_tick(x - change)) / (2 * step))
        jacobian = np.array(columns).T
        return LinearArm(jacobian[:, : 2 * n], jacobian[:, 2 * n :], holding, self.dt)

    def loop_at(self, controller: Controller, q: Array, delay: float = 0.0) -> Loop:
        """The loop of the plant and a controller at q, with s of further delay."""
        arm = self.arm
        ticks = round(delay / self.dt)
        if abs(delay / self.dt - ticks) > _WHOLE_TICK_TOLERANCE:
            raise InputError(f"delay: expected a whole number of control periods of {self.dt:g} s, got {delay:g} s")
        linear = self.arm_at(q)
        return Loop(
            robot=arm.name,
            controller=controller_name(controller),
            plant=str(self.plant),
            joint_names=arm.joint_names,
            q=q,
            dt=self.dt,
            delay=integer("delay", self.plant.delay + ticks, 0, MAX_DELAY_TICKS),
            holding_torque=linear.holding_torque,
            _arm=_measured(linear, self.plant.differences_positions),
            _law=linear_controller(arm, controller, q, self.dt, self.plant.continuous),
            _tip_jacobian=arm.jacobian(q)[:3],
        )

    def _place(self, q: Array) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self.arm.home_qpos
        self.arm.joint_map.set_positions(self._data.qpos, q)
        self._data.ctrl[:] = self.arm.home_ctrl

    def _after_tick(self, x: Array) -> Array:
        """Positions and velocities one control period after positions, velocities and torques, (3n,)."""
        arm = self.arm
        n = arm.n
        data = self._data
        self._place(x[:n])
        arm.joint_map.set_speeds(data.qvel, x[n : 2 * n])
        data.ctrl[arm.ctrl_adr] = x[2 * n :] / arm.gear
        mujoco.mj_step(self._model, data, self._substeps)
        return np.concatenate([data.qpos[arm.qpos_adr], data.qvel[arm.dof_adr]])


def _measured(linear: LinearArm, is_differenced: bool) -> StateSpace:
    """From torques to measured positions and velocities, (2n,), which may be differences of positions over the last tick."""
    n = len(linear.holding_torque)
    if not is_differenced:
        return StateSpace(linear.A, linear.B, np.eye(2 * n), np.zeros((2 * n, n)))
    last = slice(2 * n, 3 * n)  # the positions of the last tick
    A = np.zeros((3 * n, 3 * n))
    A[: 2 * n, : 2 * n] = linear.A
    A[last, :n] = np.eye(n)
    C = np.zeros((2 * n, 3 * n))
    C[:n, :n] = np.eye(n)
    C[n:, :n] = np.eye(n) / linear.dt
    C[n:, last] = -np.eye(n) / linear.dt
    return StateSpace(A, np.vstack([linear.B, np.zeros((n, n))]), C, np.zeros((2 * n, n)))
