"""Linearization of an arm and a controller around a configuration."""

from __future__ import annotations

from dataclasses import dataclass

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


def linearize(arm: Arm, controller: Controller | str, q: ArrayLike, plant: Plant | None = None, delay: float = 0.0) -> Loop:
    """Linearizes the loop of an arm and a controller that holds it at a configuration.

    The arm is differentiated through one control period of the simulation. The controller can be any object with a method
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
    dt = arm.dt if plant.timestep is None else plant.timestep
    ticks = round(delay / dt)
    if abs(delay / dt - ticks) > _WHOLE_TICK_TOLERANCE:
        raise InputError(f"delay: expected a whole number of control periods of {dt:g} s, got {delay:g} s")
    linear = _linear_arm(arm, plant, q, dt)
    return Loop(
        robot=arm.name,
        controller=controller_name(controller),
        plant=str(plant),
        joint_names=arm.joint_names,
        q=q,
        dt=dt,
        delay=integer("delay", plant.delay + ticks, 0, MAX_DELAY_TICKS),
        holding_torque=linear.holding_torque,
        _arm=linear.system,
        _law=linear_controller(arm, controller, q, dt, plant.continuous),
        _tip_jacobian=arm.jacobian(q)[:3],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _LinearArm:
    """A plant around rest at a configuration, and the torque (n,) that holds it there."""

    system: StateSpace
    holding_torque: Array


def _linear_arm(arm: Arm, plant: Plant, q: Array, dt: float) -> _LinearArm:
    """One control period of the plant at rest at q: from torques (n) to positions and velocities (2n)."""
    n = arm.n
    model = plant.model(arm)
    for bit in _SWITCHED_OFF:
        model.opt.disableflags |= int(bit)
    model.actuator_ctrllimited[:] = 0
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    data = mujoco.MjData(model)
    substeps = round(dt / model.opt.timestep)

    def after_tick(x: Array) -> Array:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = arm.home_qpos
        arm.joint_map.set_positions(data.qpos, x[:n])
        arm.joint_map.set_speeds(data.qvel, x[n : 2 * n])
        data.ctrl[:] = arm.home_ctrl
        data.ctrl[arm.ctrl_adr] = x[2 * n :] / arm.gear
        mujoco.mj_step(model, data, substeps)
        return np.concatenate([data.qpos[arm.qpos_adr], data.qvel[arm.dof_adr]])

    mujoco.mj_resetData(model, data)
    data.qpos[:] = arm.home_qpos
    arm.joint_map.set_positions(data.qpos, q)
    data.ctrl[:] = arm.home_ctrl
    mujoco.mj_forward(model, data)
    holding = arm.joint_map.reduced(data.qfrc_bias - data.qfrc_passive)
    x = np.concatenate([q, np.zeros(n), holding])
    steps = np.concatenate([np.full(2 * n, _POSITION_STEP), _TORQUE_STEP * arm.limits.tau_max])
    columns = []
    for i, step in enumerate(steps):
        change = np.zeros(3 * n)
        change[i] = step
        columns.append((after_tick(x + change) - after_tick(x - change)) / (2 * step))
    jacobian = np.array(columns).T
    system = StateSpace(jacobian[:, : 2 * n], jacobian[:, 2 * n :], np.eye(2 * n), np.zeros((2 * n, n)))
    return _LinearArm(system, holding)
