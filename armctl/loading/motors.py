"""Turns the actuators of an arm into torque motors, in a specification or in a compiled model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, shown
from armctl.mjmodel.queries import actuator_name
from armctl.mjmodel.transmissions import Transmission, Transmissions, generalized_gear

_IDLE_FORCE = 1e-12  # range of an actuator that another one replaces; MuJoCo refuses an empty range
_SWITCHED_ON = "the model's options disable its actuators; armctl enables them"


def make_motors(
    spec: mujoco.MjSpec, analysis: Transmissions, transmissions: Sequence[Transmission], tau_max: Array
) -> list[str]:
    """Turns the actuators of an arm into torque motors, in place; gears, names, armature and damping stay.

    Args:
        spec: The specification that `analysis.model` was compiled from.
        transmissions: What moves the arm's joints.
        tau_max: (n,) N m, which become the motors' ranges.

    Returns:
        What else had to be changed, one sentence each.
    """
    model = analysis.model
    joints = {j.id: j for j in spec.joints}
    motors = {a.id: a for a in spec.actuators}
    states: set[int] = set()
    for transmission in transmissions:
        for joint in transmission.coupled:
            joints[joint].actgravcomp = False  # as a motor's torque it would count against the motor's limit
    for transmission, actuator, gear, bound in _motors_of(analysis, transmissions, tau_max):
        motor = motors[actuator]
        first_state = int(model.actuator_actadr[actuator])
        states |= set(range(first_state, first_state + int(model.actuator_actnum[actuator])))
        _move_reflected(motor, joints[transmission.joint], gear)
        motor.set_to_motor()
        motor.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor.actrange = (0.0, 0.0)
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange = (-bound, bound)
        motor.forcerange = (-bound, bound)
    for key in spec.keys:
        key.act = [x for k, x in enumerate(key.act) if k not in states]
    groups = {motors[transmission.actuator].group for transmission in transmissions}
    return [_SWITCHED_ON] if _enable_actuators(spec.option, groups) else []


def make_motors_in_model(
    model: mujoco.MjModel, analysis: Transmissions, transmissions: Sequence[Transmission], tau_max: Array
) -> list[str]:
    """Turns the actuators of an arm into torque motors in a compiled model, in place; the result acts as `make_motors`' does.

    Raises:
        ModelError: An actuator has an activation state, a delay or a plugin, which a compiled model cannot lose.
    """
    for transmission in transmissions:
        for joint in transmission.coupled:
            model.jnt_actgravcomp[joint] = 0
    for transmission, actuator, gear, bound in _motors_of(analysis, transmissions, tau_max):
        if _has_memory(model, actuator):
            name = shown(actuator_name(model, actuator))
            raise ModelError(
                f"the actuator {name} has an activation state, a delay or a plugin, which a compiled MjModel cannot lose; "
                "give the MjSpec or the file"
            )
        dof = int(model.jnt_dofadr[transmission.joint])
        model.dof_armature[dof] += gear**2 * model.actuator_armature[actuator]
        model.dof_damping[dof] += gear**2 * model.actuator_damping[actuator]
        model.dof_dampingpoly[dof] += gear**2 * model.actuator_dampingpoly[actuator]
        model.actuator_armature[actuator] = 0.0
        model.actuator_damping[actuator] = 0.0
        model.actuator_dampingpoly[actuator] = 0.0
        model.actuator_gaintype[actuator] = int(mujoco.mjtGain.mjGAIN_FIXED)
        model.actuator_gainprm[actuator] = 0.0
        model.actuator_gainprm[actuator, 0] = 1.0
        model.actuator_biastype[actuator] = int(mujoco.mjtBias.mjBIAS_NONE)
        model.actuator_biasprm[actuator] = 0.0
        model.actuator_dyntype[actuator] = int(mujoco.mjtDyn.mjDYN_NONE)
        model.actuator_actlimited[actuator] = 0
        control = int(model.actuator_ctrladr[actuator])
        model.actuator_ctrllimited[control] = 1
        model.actuator_ctrlrange[control] = (-bound, bound)
        model.actuator_forcelimited[actuator] = 1
        model.actuator_forcerange[actuator] = (-bound, bound)
    groups = {int(model.actuator_group[transmission.actuator]) for transmission in transmissions}
    return [_SWITCHED_ON] if _enable_actuators(model.opt, groups) else []


def _motors_of(
    analysis: Transmissions, transmissions: Sequence[Transmission], tau_max: Array
) -> Iterator[tuple[Transmission, int, float, float]]:
    """Every actuator on the arm's joints, its gear to the leading joint, and the bound of its force.

    Besides the actuator that drives a joint, others may act on it, such as a damper: these become motors that stay idle.
    """
    for transmission, torque in zip(transmissions, tau_max, strict=True):
        for actuator in analysis.acting_on(set(transmission.coupled)):
            gear = abs(generalized_gear(analysis.moments[actuator], transmission.coupled)) or 1.0
            bound = torque / gear if actuator == transmission.actuator else _IDLE_FORCE
            yield transmission, actuator, gear, bound


def _has_memory(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator is more than a function of one control and the joint's present state."""
    has_state = model.actuator_actnum[actuator] > 0 or model.actuator_delay[actuator] > 0
    return bool(has_state or model.actuator_plugin[actuator] >= 0 or model.actuator_ctrlnum[actuator] != 1)


def _enable_actuators(option: mujoco.MjOption, groups: set[int]) -> bool:
    """Lets the actuators of some groups act; returns whether the options had disabled them."""
    flag = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    bits = sum(1 << group for group in groups if 0 <= group < 31)
    disabled = bool(option.disableflags & flag or option.disableactuator & bits)
    option.disableflags &= ~flag
    option.disableactuator &= ~bits
    return disabled


def _move_reflected(motor: mujoco.MjsActuator, joint: mujoco.MjsJoint, gear: float) -> None:
    """Moves an actuator's own armature and damping to its joint, where MuJoCo would add them anyway."""
    joint.armature = joint.armature + gear**2 * motor.armature
    joint.damping = np.asarray(joint.damping) + gear**2 * np.asarray(motor.damping)
    motor.armature = 0.0
    motor.damping = np.zeros_like(motor.damping)
