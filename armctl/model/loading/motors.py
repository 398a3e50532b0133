"""Turns the actuators of an arm into torque motors, in a specification or in a compiled model."""

import math
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, IntArray, shown
from armctl.model.mjmodel.dc_motor import TORQUE_COMMAND, DcMotor, is_dc_motor, set_current_controller, state_count
from armctl.model.mjmodel.queries import ACTUATOR_GROUPS, actuator_name
from armctl.model.mjmodel.transmissions import Transmission, Transmissions

_IDLE_FORCE = 1e-12  # range of an actuator that another one replaces; MuJoCo refuses an empty range
_SHORT_STEP_S = 5e-5
_SWITCHED_ON = "the model's options disable its actuators; armctl enables them"


def make_motors(
    spec: mujoco.MjSpec,
    analysis: Transmissions,
    transmissions: Sequence[Transmission],
    tau_max: Array,
    dc_motors: Sequence[DcMotor | None],
) -> list[str]:
    """Turns the actuators of an arm into torque motors within tau_max, in place; one sentence for what else was changed.

    Gears, names, armature, damping and delays stay. A DC motor stays one: its current controller makes the torque. `spec`
    is what `analysis.model` was compiled from.
    """
    joints = {j.id: j for j in spec.joints}
    motors = {a.id: a for a in spec.actuators}
    tendons = {t.id: t for t in spec.tendons}
    for tendon in _tendons_of(analysis.model, transmissions):
        tendons[tendon].actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # the range of the motor's force bounds the torque
    voltages = {each.actuator: each.voltage for each in dc_motors if each is not None}
    for transmission in transmissions:
        for coupled in transmission.coupled:
            joints[coupled].actgravcomp = False  # as a motor's torque it would count against the motor's limit
    for transmission, actuator, gear, bound in _motors_of(analysis, transmissions, tau_max):
        motor = motors[actuator]
        joint = joints[transmission.joint]  # takes the motor's armature and damping, which MuJoCo would add there anyway
        joint.armature = joint.armature + gear**2 * motor.armature
        joint.damping = np.asarray(joint.damping) + gear**2 * np.asarray(motor.damping)
        motor.armature = 0.0
        motor.damping = np.zeros_like(motor.damping)
        if actuator in voltages:
            set_current_controller(motor, voltages[actuator])
            motor.ctrlspec = TORQUE_COMMAND
        else:
            motor.set_to_motor()
        if motor.delay > 0.0:  # in shorter steps, a delay takes more samples
            motor.nsample = max(motor.nsample, math.ceil(motor.delay / _SHORT_STEP_S) + 1)
        motor.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor.actrange = (0.0, 0.0)
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange = (-bound, bound)
        motor.forcerange = (-bound, bound)
    groups = {motors[transmission.actuator].group for transmission in transmissions}
    return [_SWITCHED_ON] if _enable_actuators(spec.option, groups) else []


def adapt_keyframes(spec: mujoco.MjSpec, analysis: Transmissions, arms: Sequence[Sequence[Transmission]]) -> None:
    """Gives the keyframes the controls and states of the actuators after `make_motors` has changed those of all arms."""
    model = analysis.model
    motors = {a.id: a for a in spec.actuators}
    states: dict[int, list[float]] = {}
    controls: dict[int, list[float]] = {}
    for transmissions in arms:
        for _, actuator, _, _ in _motors_of(analysis, transmissions, np.ones(len(transmissions))):
            is_dc = motors[actuator].gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR
            states[actuator] = [0.0] * state_count(motors[actuator].dynprm) if is_dc else []
            controls[actuator] = [0.0]
    for key in spec.keys:
        key.act = _in_blocks(list(key.act), model.actuator_actadr, model.actuator_actnum, states)
        key.ctrl = _in_blocks(list(key.ctrl), model.actuator_ctrladr, model.actuator_ctrlnum, controls)


def make_motors_in_model(
    model: mujoco.MjModel,
    analysis: Transmissions,
    transmissions: Sequence[Transmission],
    tau_max: Array,
    dc_motors: Sequence[DcMotor | None],
) -> list[str]:
    """As `make_motors`, in a compiled model.

    ModelError if an actuator has an activation state, several controls or a plugin, which a compiled model cannot lose.
    """
    for transmission in transmissions:
        for joint in transmission.coupled:
            model.jnt_actgravcomp[joint] = 0
    model.tendon_actfrclimited[_tendons_of(model, transmissions)] = 0
    voltages = {each.actuator: each.voltage for each in dc_motors if each is not None}
    for transmission, actuator, gear, bound in _motors_of(analysis, transmissions, tau_max):
        if _has_memory(model, actuator):
            name = shown(actuator_name(model, actuator))
            raise ModelError(
                f"the actuator {name} has an activation state, several controls or a plugin, which a compiled MjModel "
                "cannot lose; give the MjSpec or the file"
            )
        dof = int(model.jnt_dofadr[transmission.joint])
        model.dof_armature[dof] += gear**2 * model.actuator_armature[actuator]
        model.dof_damping[dof] += gear**2 * model.actuator_damping[actuator]
        model.dof_dampingpoly[dof] += gear**2 * model.actuator_dampingpoly[actuator]
        model.actuator_armature[actuator] = 0.0
        model.actuator_damping[actuator] = 0.0
        model.actuator_dampingpoly[actuator] = 0.0
        if actuator in voltages:
            set_current_controller(model.actuator(actuator), voltages[actuator])
            model.actuator_ctrlspec[actuator] = TORQUE_COMMAND
        else:
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
    """Every actuator on the arm's joints that has a control, its gear to the leading joint, and the bound of its force.

    Besides the actuator that drives a joint, others may act on it, such as a damper: these become motors that stay idle.
    """
    for transmission, torque in zip(transmissions, tau_max, strict=True):
        for actuator in analysis.acting_on(set(transmission.coupled)):
            if not analysis.model.actuator_ctrlnum[actuator]:
                continue
            gear = abs(analysis.gear_of(actuator, transmission.coupled)) or 1.0
            bound = torque / gear if actuator == transmission.actuator else _IDLE_FORCE
            yield transmission, actuator, gear, bound


def _tendons_of(model: mujoco.MjModel, transmissions: Sequence[Transmission]) -> list[int]:
    """The tendons on which the motors of an arm pull."""
    motors = [transmission.actuator for transmission in transmissions]
    return [int(model.actuator_trnid[k, 0]) for k in motors if model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_TENDON]


def _has_memory(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator is more than a function of one control and the joint's present state."""
    own_states = state_count(model.actuator_dynprm[actuator]) if is_dc_motor(model, actuator) else 0
    has_state = model.actuator_actnum[actuator] != own_states
    return bool(has_state or model.actuator_plugin[actuator] >= 0 or model.actuator_ctrlnum[actuator] != 1)


def _in_blocks(values: list[float], first: IntArray, count: IntArray, changed: dict[int, list[float]]) -> list[float]:
    """A keyframe's numbers of all actuators, after some actuators have got others; empty if the keyframe has none."""
    if not values:
        return values
    blocks = [values[i : i + n] if n else [] for i, n in zip(first.tolist(), count.tolist(), strict=True)]
    return [x for actuator, block in enumerate(blocks) for x in changed.get(actuator, block)]


def _enable_actuators(option: mujoco.MjOption, groups: set[int]) -> bool:
    """Lets the actuators of some groups act; returns whether the options had disabled them."""
    flag = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    bits = sum(1 << group for group in groups if 0 <= group < ACTUATOR_GROUPS)
    disabled = bool(option.disableflags & flag or option.disableactuator & bits)
    option.disableflags &= ~flag
    option.disableactuator &= ~bits
    return disabled
