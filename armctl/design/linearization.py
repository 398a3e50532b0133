"""Linearization of an arm and a controller around a configuration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.control import Controller, controller_name
from armctl.core.errors import InputError
from armctl.core.validation import Array, integer, number
from armctl.design.loop import MAX_DELAY_TICKS, Loop
from armctl.design.state_space import StateSpace, linear_controller
from armctl.mjmodel.dc_motor import current_state, remove_bristles
from armctl.robot.arm import Arm, check_arm
from armctl.sim.drivetrain import drivetrain_of
from armctl.sim.move import read_controller
from armctl.sim.plant import Plant, read_plant

_POSITION_STEP = 1e-6  # rad (m), and rad/s (m/s), of the central differences of the plant
_TORQUE_STEP = 1e-4  # of the torque limits
_WHOLE_TICK_TOLERANCE = 1e-6
_WINDING_STEPS = 2000  # until the current of a motor that holds still is constant
_SWITCHED_OFF = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT,
    mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS,
    mujoco.mjtDisableBit.mjDSBL_LIMIT,
)


def linearize(arm: Arm, controller: Controller | str, q: ArrayLike, plant: Plant | None = None, delay: float = 0.0) -> Loop:
    """Linearizes the loop of an arm and a controller that holds it at a configuration.

    The arm is differentiated through one control period of the simulation: with the springs of elastic joints, the windings of
    DC motors and the delays of actuators. The controller can be any object with a method
    `torque(state, setpoint)`: its linear model, memory included, follows from its responses to small impulses.

    Args:
        controller: A controller or its name. Its own memory does not change if it can be copied.
        q: (n,) rad, the configuration.
        plant: How the simulated arm differs from the model; by default it does not. Its noise, pushes, dry friction, gaps and
            the steps of encoders have no effect; jitter counts as the greatest delay.
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
    dt = arm.dt if plant.timestep is None else plant.timestep
    ticks = round(delay / dt)
    if abs(delay / dt - ticks) > _WHOLE_TICK_TOLERANCE:
        raise InputError(f"delay: expected a whole number of control periods of {dt:g} s, got {delay:g} s")
    # Gaps and bristles act as dry friction does: they are left out.
    linear = _linear_arm(arm, replace(plant, backlash=0.0, friction="coulomb"), q, dt)
    return Loop(
        robot=arm.name,
        controller=controller_name(controller),
        plant=str(plant),
        joint_names=arm.joint_names,
        q=q,
        dt=dt,
        delay=integer("delay", plant.delay + plant.jitter + ticks, 0, MAX_DELAY_TICKS),
        holding_torque=linear.holding_torque,
        _arm=linear.system,
        _push=linear.push,
        _position=linear.position,
        _law=linear_controller(arm, controller, q, dt, plant.continuous),
        _tip_jacobian=arm.jacobian(q)[:3],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _LinearArm:
    """A plant around rest at a configuration.

    Attributes:
        system: One control period, from the torques (n) that the motors are given to measured positions and velocities (2n).
        push: (k, n), what torques on the links change in its state.
        position: (n, k), the true positions of the links.
        holding_torque: (n,) N m that holds it there.
    """

    system: StateSpace
    push: Array
    position: Array
    holding_torque: Array


def _linear_arm(arm: Arm, plant: Plant, q: Array, dt: float) -> _LinearArm:
    """One control period of the plant at rest at q, differentiated.

    The state is that of the arm, of its springs and motors, and the torques that are on their way through an actuator's delay.
    """
    n = arm.n
    tick = _Tick(arm, plant, q, dt)
    x = tick.rest
    size = len(x)
    past = tick.past_torques
    columns = []
    for i in range(size + (2 + past) * n):
        step = _POSITION_STEP if i < size else _TORQUE_STEP * arm.limits.tau_max[(i - size) % n]
        change = np.zeros(size + (2 + past) * n)
        change[i] = step
        later = tick(x + change[:size], change[size:])
        columns.append((later - tick(x - change[:size], -change[size:])) / (2 * step))
    jacobian = np.array(columns).T
    # Columns: the state, torques on the links, the commanded torque, and those of the ticks before.
    A = np.zeros((size + past * n, size + past * n))
    A[:size, :size] = jacobian[:, :size]
    A[:size, size:] = jacobian[:, size + 2 * n :]
    A[size + n :, size:-n] = np.eye(max(past - 1, 0) * n)
    B = np.zeros((len(A), n))
    B[:size] = jacobian[:, size + n : size + 2 * n]
    B[size : size + n] = np.eye(n) if past else 0.0
    push = np.zeros_like(B)
    push[:size] = jacobian[:, size : size + n]
    links, motors = tick.sides()
    seen = np.zeros((2 * n, len(A)))
    seen[:, :size] = links if plant.encoder_side == "link" else motors
    position = np.zeros((n, len(A)))
    position[:, :size] = links[:n]
    system, added = _sensed(StateSpace(A, B, seen, np.zeros((2 * n, n))), plant, dt)
    push = np.vstack([push, np.zeros((added, n))])
    position = np.hstack([position, np.zeros((n, added))])
    return _LinearArm(system, push, position, tick.holding_torque)


def _sensed(arm: StateSpace, plant: Plant, dt: float) -> tuple[StateSpace, int]:
    """An arm with its sensors, and how many states they add: differenced positions, and measurements that are late."""
    size = len(arm.A)
    n = len(arm.C) // 2
    is_differenced = plant.velocity == "differenced"
    added = n * is_differenced + 2 * n * plant.sensor_delay
    A = np.zeros((size + added, size + added))
    A[:size, :size] = arm.A
    output = np.zeros((2 * n, size + added))
    output[:, :size] = arm.C
    first = size
    if is_differenced:
        A[first : first + n] = output[:n]
        output[n:] = output[:n] / dt
        output[n:, first : first + n] -= np.eye(n) / dt
        first += n
    for _ in range(plant.sensor_delay):
        A[first : first + 2 * n] = output
        output = np.zeros_like(output)
        output[:, first : first + 2 * n] = np.eye(2 * n)
        first += 2 * n
    return StateSpace(A, np.vstack([arm.B, np.zeros((added, n))]), output, arm.D), added


class _Tick:
    """One control period of a plant near rest, without contacts, limits and dry friction.

    Attributes:
        rest: (k,) the state at rest: positions and velocities of the joints, then of the springs, then of the motors' windings.
        past_torques: How many earlier commands act through an actuator's delay.
        holding_torque: (n,) N m.
    """

    def __init__(self, arm: Arm, plant: Plant, q: Array, dt: float):
        self._arm = arm
        model = plant.model(arm)
        for bit in _SWITCHED_OFF:
            model.opt.disableflags |= int(bit)
        model.actuator_ctrllimited[:] = 0
        model.actuator_forcelimited[:] = 0
        model.jnt_actfrclimited[:] = 0
        self._model = model
        self._data = mujoco.MjData(model)
        self._substeps = round(dt / model.opt.timestep)
        self._train = drivetrain_of([arm], plant)
        self._spring_qpos = model.jnt_qposadr[self._train.extra_joints]
        self._spring_dofs = model.jnt_dofadr[self._train.extra_joints]
        owner = np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum)
        self._motors = owner[arm.ctrl_adr]
        self._states = np.array(
            [address for i in self._motors.tolist() if (address := current_state(model, i)) >= 0], dtype=int
        )
        remove_bristles(model)
        longest = float(model.actuator_delay[self._motors].max())
        self.past_torques = math.ceil(longest / dt - _WHOLE_TICK_TOLERANCE)
        data = self._data
        self._reset(q)
        self._train.settle(model, data)
        mujoco.mj_forward(model, data)
        missing = data.qfrc_bias - data.qfrc_passive
        self.holding_torque = arm.joint_map.reduced(missing)
        if self._train.rotors:
            self.holding_torque[self._train.owners] = missing[self._spring_dofs]
        self._at_rest()
        self.rest = self._state()

    def __call__(self, x: Array, torques: Array) -> Array:
        """The state after a control period.

        Args:
            x: (k,) the state before.
            torques: ((2 + past_torques) n,) N m: on the links, and how much more than `holding_torque` the motors were given in
                this tick and in those before.
        """
        arm = self._arm
        data = self._data
        n = arm.n
        k = len(self._spring_dofs)
        on_links, *commands = torques.reshape(-1, n)
        self._reset(x[:n])
        arm.joint_map.set_speeds(data.qvel, x[n : 2 * n])
        data.qpos[self._spring_qpos] = x[2 * n : 2 * n + k]
        data.qvel[self._spring_dofs] = x[2 * n + k : 2 * (n + k)]
        data.act[self._states] = x[2 * (n + k) :]
        data.qfrc_applied[arm.dof_adr] = on_links
        if self._train.springs:
            data.qfrc_applied[self._spring_dofs] = on_links[self._train.owners]
        data.ctrl[arm.ctrl_adr] = (self.holding_torque + commands[0]) / arm.gear
        self._set_history(commands[1:])
        mujoco.mj_step(self._model, data, self._substeps)
        return self._state()

    def sides(self) -> tuple[Array, Array]:
        """(2n, k) each: positions and velocities of the links and of the motors from the state."""
        n = self._arm.n
        owners = self._train.owners
        extra = 2 * n + np.arange(len(self._spring_dofs))
        links = np.eye(2 * n, len(self.rest))
        motors = links.copy()
        if self._train.springs:
            links[owners, extra] = 1.0
            links[n + owners, extra + len(extra)] = 1.0
        elif self._train.rotors:
            motors[[*owners, *(n + owners)]] = 0.0
            motors[owners, extra] = 1.0
            motors[n + owners, extra + len(extra)] = 1.0
        return links, motors

    def _reset(self, q: Array) -> None:
        data = self._data
        mujoco.mj_resetData(self._model, data)
        data.qpos[: len(self._arm.home_qpos)] = self._arm.home_qpos
        self._arm.joint_map.set_positions(data.qpos, q)
        data.ctrl[:] = self._arm.home_ctrl

    def _state(self) -> Array:
        data = self._data
        arm = self._arm
        joints = [data.qpos[arm.qpos_adr], data.qvel[arm.dof_adr]]
        springs = [data.qpos[self._spring_qpos], data.qvel[self._spring_dofs]]
        return np.concatenate([*joints, *springs, data.act[self._states]])

    def _at_rest(self) -> None:
        """Finds the states of the motors while they hold still: the arm is kept where it is."""
        data = self._data
        qpos = data.qpos.copy()
        data.ctrl[self._arm.ctrl_adr] = self.holding_torque / self._arm.gear
        self._set_history([np.zeros(self._arm.n)] * self.past_torques)
        for _ in range(_WINDING_STEPS if len(self._states) else 0):
            data.qpos[:] = qpos
            data.qvel[:] = 0.0
            mujoco.mj_step(self._model, data)
        data.qpos[:] = qpos
        data.qvel[:] = 0.0

    def _set_history(self, past: Sequence[Array]) -> None:
        """Gives delayed actuators the commands of the ticks before, the last one first."""
        model = self._model
        for i, actuator in enumerate(self._motors.tolist()):
            if not model.actuator_delay[actuator] > 0.0:
                continue
            count = int(model.actuator_history[actuator, 0])
            ages = np.arange(count, 0, -1)
            ticks = (ages - 1) // self._substeps
            values = np.array([past[t][i] if t < len(past) else 0.0 for t in ticks.tolist()])
            values = (self.holding_torque[i] + values) / self._arm.gear[i]
            mujoco.mj_initCtrlHistory(model, self._data, actuator, self._data.time - ages * model.opt.timestep, values)
