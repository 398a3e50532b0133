"""Linearization of an arm and a controller around a configuration."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.control.interface import CompiledController, Controller, traits
from armctl.core.errors import ArmctlError, InputError
from armctl.core.validation import Array, integer, number
from armctl.lab.loops.loop import MAX_DELAY_TICKS, Loop
from armctl.lab.loops.state_space import StateSpace, linear_controller
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.mjmodel.dc_motor import current_state, remove_bristles
from armctl.run.execution.move import read_controller
from armctl.run.sim.disturbances import encoder_steps
from armctl.run.sim.drivetrain import drivetrain_of
from armctl.run.sim.plant import Plant, read_plant

_POSITION_STEP = 1e-6  # rad (m), and rad/s (m/s), of the central differences of the plant
_TORQUE_STEP = 1e-4  # of the torque limits
WHOLE_TICK_TOLERANCE = 1e-6
_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)  # time, positions, velocities, activations, histories of commands
_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
_SENSOR_TICKS = 1000  # after which the ages of measurements repeat, nearly if their interval is no whole number of ticks
_SWITCHED_OFF = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT,
    mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS,
    mujoco.mjtDisableBit.mjDSBL_LIMIT,
)


class LinearArm(NamedTuple):
    """An arm at rest at a configuration, linear in small deviations, over one control period.

    The state x has the positions and velocities of the joints: x[k + 1] = A x[k] + B tau[k]. Those of the springs of elastic
    joints, the currents of motors and the commands on their way through an actuator's delay follow, if there are any.

    Attributes:
        A: (k, k), k = 2n for a rigid arm with ideal motors.
        B: (k, n).
        holding_torque: (n,) N m that holds the arm still; tau is the deviation from it.
        dt: s, the control period.
        C: (2n, k), positions and velocities where they are measured.
        push: (k, n), of torques on the links instead of tau.
        position: (n, k), positions of the links.
    """

    A: Array
    B: Array
    holding_torque: Array
    dt: float
    C: Array
    push: Array
    position: Array


def linear_arm(arm: Arm, q: ArrayLike, plant: Plant | None = None) -> LinearArm:
    """Linearizes an arm without a controller, for the design of controllers of your own.

    The arm is differentiated through one control period of the simulation, in which the torque is held: with the springs of
    elastic joints, the windings of motors and the delays of actuators. Contacts, limits, dry friction and gaps are left out.

    Args:
        q: (n,) rad, the configuration.
        plant: How the simulated arm differs from the model; by default it does not.

    Returns:
        A, B, the torque that holds the arm, the control period, and what is measured.

    Raises:
        InputError: An argument has a wrong type, length or value.
        LimitError: A position outside the limits.
    """
    check_arm(arm)
    return Linearizer(arm, read_plant(plant)).arm_at(arm.checked("q", q))


def instability(arm: Arm, controller: Controller, q: Array, plant: Plant) -> str:
    """What the reason of a failed run says besides if the loop is unstable. Only compiled laws are called outside of runs."""
    try:
        if not isinstance(controller, CompiledController) or (loop := linearize(arm, controller, q, plant)).robustness():
            return ""
    except ArmctlError:
        return ""
    return f"; the loop of {traits(controller).name} is unstable at its period of {1e3 * loop.dt:g} ms: lower its gains"


def linearize(arm: Arm, controller: Controller | str, q: ArrayLike, plant: Plant | None = None, delay: float = 0.0) -> Loop:
    """Linearizes the loop of an arm and a controller that holds it at a configuration.

    The arm is that of `linear_arm`. The controller can be any object with a method
    `torque(state, setpoint)`: its linear model, memory included, follows from its responses to small impulses.

    Args:
        controller: A controller or its name. Its own memory does not change if it can be copied.
        q: (n,) rad, the configuration.
        plant: How the simulated arm differs from the model; by default it does not. Its pushes, dry friction and gaps have no
            effect, its sensors' noise and steps one on `Loop.chatter` only; jitter and the intervals of sensors count as the
            mean of their delays.
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
    q = arm.checked("q", q)
    return Linearizer(arm, read_plant(plant)).loop_at(law, q, number("delay", delay, 0.0))


class Linearizer:
    """Linearizes one plant at many configurations; a copy of a model with meshes takes longer than the rest."""

    def __init__(self, arm: Arm, plant: Plant):
        self.arm = arm
        self.plant = plant
        self.dt = arm.dt if plant.timestep is None else plant.timestep
        plant = replace(plant, backlash=0.0, friction="coulomb")  # gaps and bristles are left out as dry friction is
        model = plant.model(arm)
        for bit in _SWITCHED_OFF:
            model.opt.disableflags |= int(bit)
        model.actuator_ctrllimited[:] = 0
        model.actuator_forcelimited[:] = 0
        model.jnt_actfrclimited[:] = 0
        remove_bristles(model)
        self._model = model
        self._data = mujoco.MjData(model)
        self._substeps = round(self.dt / model.opt.timestep)
        self._train = drivetrain_of(arm, plant)
        self.is_elastic = bool(self._train.extra_joints)
        self._spring_dofs = model.jnt_dofadr[self._train.extra_joints]
        motors = arm.actuation.motor_adr.tolist()
        currents = [current_state(model, motor) for motor in motors]
        states = [address for address in currents if address >= 0]
        further = [1 + model.jnt_qposadr[self._train.extra_joints], 1 + model.nq + self._spring_dofs]
        further.append(np.array(states, dtype=int) + 1 + model.nq + model.nv)
        # In MuJoCo's state, where the time comes first, the elements of ours: joints that follow others are only written.
        self._read = np.concatenate([1 + arm.qpos_adr, 1 + model.nq + arm.dof_adr, *further])
        moved = arm.joint_map
        self._written = np.concatenate([1 + moved.qpos_adr, 1 + model.nq + moved.dof_adr, *further])
        longest = float(model.actuator_delay[motors].max())
        self._past_torques = math.ceil(longest / self.dt - WHOLE_TICK_TOLERANCE)
        self._plant_in_words = str(self.plant)
        self._noise = _sensor_noise(arm, self.plant)
        ages = self.plant.sensor_delay + self._train.sensors.ages(np.arange(_SENSOR_TICKS), self.dt)
        shares = np.array([(ages == age).mean(axis=0) for age in range(ages.max() + 1)])
        # What all sensors have in common acts as a delay of the torques does, which needs fewer states.
        is_common = (shares == shares[:, :1]).all()
        common = shares[:, 0] if is_common else np.eye(1 + ages.min())[-1]
        self._shares = np.ones((1, arm.n)) if is_common else shares[ages.min() :]
        self._lag = np.convolve(common, _jitter_weights(plant.jitter))

    def arm_at(self, q: Array) -> LinearArm:
        n = self.arm.n
        past = self._past_torques
        holding = self._rest_at(q)
        size = len(self._read)
        steps = np.tile(_TORQUE_STEP * self.arm.limits.tau_max, 2 + past)
        steps = np.concatenate([np.full(size, _POSITION_STEP), steps])
        changes = np.diag(steps)
        later = self._after_tick(holding, np.vstack([changes, -changes]))
        jacobian = ((later[: len(steps)] - later[len(steps) :]) / (2 * steps[:, None])).T
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
        links, motors = self._sides(len(A))
        measured = links if self.plant.encoder_side == "link" else motors
        return LinearArm(A, B, holding, self.dt, measured, push, links[:n])

    def loop_at(self, controller: Controller, q: Array, delay: float = 0.0) -> Loop:
        """The loop of the plant and a controller at q, with s of further delay."""
        arm = self.arm
        ticks = round(delay / self.dt)
        if abs(delay / self.dt - ticks) > WHOLE_TICK_TOLERANCE:
            raise InputError(f"delay: expected a whole number of control periods of {self.dt:g} s, got {delay:g} s")
        linear = self.arm_at(q)
        if traits(controller).needs_deflection:
            links, motors = self._sides(len(linear.A))
            linear = linear._replace(C=np.vstack([linear.C, motors - links]))
        linear, lag = _without_lag(linear, len(self._read))
        system, added = _sensed(linear, self.plant.differences_positions, self._shares)
        return Loop(
            robot=arm.name,
            controller=traits(controller).name,
            plant=self._plant_in_words,
            joint_names=arm.joint_names,
            q=q,
            dt=self.dt,
            delay=integer("delay", self.plant.delay + ticks, 0, MAX_DELAY_TICKS),
            holding_torque=linear.holding_torque,
            _arm=system,
            _lag=np.concatenate([np.zeros(lag), self._lag]),
            _push=np.vstack([linear.push, np.zeros((added, arm.n))]),
            _position=np.hstack([linear.position, np.zeros((arm.n, added))]),
            _law=linear_controller(arm, controller, q, self.dt, self.plant.continuous),
            _tip_jacobian=arm.jacobian(q)[:3],
            _noise=self._noise,
        )

    def _rest_at(self, q: Array) -> Array:
        """Puts the arm to rest at q, and returns the torque that holds it there, (n,)."""
        data = self._data
        mujoco.mj_resetData(self._model, data)
        data.qpos[: len(self.arm.home_qpos)] = self.arm.home_qpos
        self.arm.joint_map.set_positions(data.qpos, q)
        data.ctrl[:] = self.arm.home_ctrl
        return self._train.settle(self._model, data)

    def _after_tick(self, holding: Array, changes: Array) -> Array:
        """(k, size) the states one tick after small changes of the rest at which the arm is, in (k, size + ...) rows.

        Those of torques follow: torques on the links, and those beyond `holding` at the motors, now and in the ticks before.
        """
        from mujoco import rollout

        arm = self.arm
        n = arm.n
        model = self._model
        data = self._data
        size = len(self._read)
        on_links, added, *before = np.hsplit(changes[:, size:], 2 + self._past_torques)
        initial = np.empty((len(changes), mujoco.mj_stateSize(model, _STATE)))
        for row, *past in zip(initial, *before, strict=True):
            if past:
                self._train.set_commands(model, data, holding + np.array(past), self._substeps)
            mujoco.mj_getState(model, data, row, _STATE)
        x = initial[:, self._read] + changes[:, :size]
        moved = arm.joint_map
        initial[:, self._written] = np.hstack([moved.positions(x[:, :n]), moved.speeds(x[:, n : 2 * n]), x[:, 2 * n :]])
        inputs = np.zeros((len(changes), 1, model.nu + model.nv))
        inputs[:, 0, : model.nu] = arm.home_ctrl
        inputs[:, 0, arm.ctrl_adr] = (holding + added) / arm.gear
        inputs[:, 0, model.nu + arm.dof_adr] = on_links
        if self._train.springs:
            inputs[:, 0, model.nu + self._spring_dofs] = on_links[:, self._train.owners]
        later, _ = rollout.rollout(model, data, initial, inputs, control_spec=_INPUTS, nstep=self._substeps)
        return np.asarray(later)[:, -1, self._read]

    def _sides(self, size: int) -> tuple[Array, Array]:
        """(2n, size) each: positions and velocities of the links and of the motors from the state."""
        n = self.arm.n
        owners = self._train.owners
        extra = 2 * n + np.arange(len(self._spring_dofs))
        links = np.eye(2 * n, size)
        motors = links.copy()
        if self._train.springs:
            links[owners, extra] = 1.0
            links[n + owners, extra + len(extra)] = 1.0
        elif self._train.rotors:
            motors[[*owners, *(n + owners)]] = 0.0
            motors[owners, extra] = 1.0
            motors[n + owners, extra + len(extra)] = 1.0
        return links, motors


def _sensor_noise(arm: Arm, plant: Plant) -> Array:
    """(3, n) standard deviations: of positions that velocities are differenced from, of other positions, and of velocities."""
    steps = encoder_steps(plant, arm.units) / math.sqrt(12)
    noise = np.full(arm.n, plant.encoder_noise)
    from_steps = plant.differences_positions
    from_noise = plant.velocity_noise is None
    return np.array(
        [
            np.hypot(steps * from_steps, noise * from_noise),
            np.hypot(steps * (not from_steps), noise * (not from_noise)),
            np.full(arm.n, plant.velocity_noise or 0.0),
        ]
    )


def _jitter_weights(jitter: int) -> Array:
    """(jitter + 1,) the weights of a command 0, 1, ... ticks ago in the expected motion, where commands are late at random."""
    ages = np.arange(jitter + 1)
    steps = np.zeros((len(ages), len(ages)))
    for age in ages:
        np.add.at(steps[age], np.minimum(ages, age + 1), 1 / len(ages))  # a command is not followed by an older one
    return np.linalg.matrix_power(steps, 64)[0]


def _without_lag(arm: LinearArm, size: int) -> tuple[LinearArm, int]:
    """An arm without those ticks that every command waits before it acts on the first `size` states, and how many they are."""
    n = arm.B.shape[1]
    blocks = [arm.B[:size], *np.hsplit(arm.A[:size, size:], (len(arm.A) - size) // n)] if len(arm.A) > size else [arm.B]
    lag = next((age for age, block in enumerate(blocks) if block.any()), 0)
    if not lag:
        return arm, 0
    kept = len(arm.A) - lag * n
    A = arm.A[:kept, :kept].copy()
    A[:size, size:] = np.hstack(blocks[lag + 1 :]) if kept > size else 0.0
    B = arm.B[:kept].copy()
    B[:size] = blocks[lag]
    return arm._replace(A=A, B=B, C=arm.C[:, :kept], push=arm.push[:kept], position=arm.position[:, :kept]), lag


def _sensed(arm: LinearArm, is_differenced: bool, shares: Array) -> tuple[StateSpace, int]:
    """An arm with its sensors, and how many states they add. A measurement is a mean of ages with their (ages, n) shares."""
    size = len(arm.A)
    n = arm.B.shape[1]
    signals = len(arm.C)
    added = n * is_differenced + signals * (len(shares) - 1)
    A = np.zeros((size + added, size + added))
    A[:size, :size] = arm.A
    output = np.zeros((signals, size + added))
    output[:, :size] = arm.C
    first = size
    if is_differenced:
        A[first : first + n] = output[:n]
        output[n : 2 * n] = output[:n] / arm.dt
        output[n : 2 * n, first : first + n] -= np.eye(n) / arm.dt
        first += n
    read = np.tile(shares[0], signals // n)[:, None] * output
    for share in shares[1:]:
        A[first : first + signals] = output
        output = np.zeros_like(output)
        output[:, first : first + signals] = np.eye(signals)
        read += np.tile(share, signals // n)[:, None] * output
        first += signals
    return StateSpace(A=A, B=np.vstack([arm.B, np.zeros((added, n))]), C=read, D=np.zeros((signals, n))), added
