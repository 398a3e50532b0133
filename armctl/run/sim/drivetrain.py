"""Drivetrain: what a plant has between its motors and its links, built from MuJoCo's own elements.

A rotor is a body of its own that turns about the axis of its motor and is coupled to its joint by a fixed tendon: elasticity is
the tendon's stiffness, backlash its dead band or its range. So the rotor's energy is that of its spin only, an assumption of
M. W. Spong, "Modeling and control of elastic joint robots" (1987). The lag of a motor is the winding of a `dcmotor`, and LuGre
friction that of a `dcmotor` without an input.
"""

import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, ModelError
from armctl.core.validation import Array, IntArray
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.dc_motor import TORQUE_COMMAND, current_for, current_state, set_friction, set_time_constant
from armctl.model.mjmodel.queries import is_on_joint, joint_name
from armctl.model.mjmodel.sensor_timing import SensorTiming, sensor_timing
from armctl.model.mjmodel.spring_joints import settle_springs, spring_joints

_ROTOR_MASS = 1e-6  # kg, and kg m^2: what turns is the armature of the rotor's joint
_STRIBECK_SPEED = 0.05  # rad/s, of harmonic drives about: Armstrong-Helouvry, Control of Machines with Friction (1991)
_BRISTLE_DEFLECTION = 2e-4  # rad, at which a joint breaks away
_MAX_BRISTLE_RATE = 0.5  # of the bristles' frequency times the time step
_MAX_SPRING_RATE = 1.0  # of a spring's frequency times the time step; semi-implicit steps are stable up to 2

Structure = tuple[tuple[bool, ...], bool, bool]
_models: WeakKeyDictionary[Arm, tuple[Structure, mujoco.MjModel]] = WeakKeyDictionary()


class DrivetrainAttributes(Protocol):
    """The attributes of a plant that a drivetrain is made from; `Plant` explains them."""

    @property
    def elasticity(self) -> ArrayLike: ...
    @property
    def elastic_damping(self) -> float: ...
    @property
    def rotor_inertia(self) -> ArrayLike: ...
    @property
    def backlash(self) -> ArrayLike: ...
    @property
    def friction(self) -> str: ...
    @property
    def stiction(self) -> float: ...
    @property
    def motor(self) -> float: ...


@dataclass(frozen=True, eq=False)
class Drivetrain:
    """Where the motors and the links of an arm are in a plant's model."""

    actuation: Actuation  # its joints
    rotors: tuple[int, ...]  # the joints of the rotors that the plant adds
    springs: tuple[int, ...]  # the spring joints of elastic joints of the file
    owners: IntArray  # which of the n joints each rotor, or else each spring, belongs to
    spring_qpos: IntArray  # addresses of `springs` in `MjData.qpos`
    spring_dof: IntArray  # the same in `MjData.qvel`
    sensors: SensorTiming  # when the file's sensors measure the joints
    motor_qpos: IntArray  # (n,) addresses of the motors in `MjData.qpos`
    motor_dof: IntArray  # (n,) in `MjData.qvel`

    @property
    def extra_joints(self) -> list[int]:
        """The joints of a plant that are none of the arm's."""
        return [*self.rotors, *self.springs]

    def link_positions(self, qpos: Array) -> Array:
        """(..., n) positions of the links from `MjData.qpos`, (..., nq): springs of the file add to motors."""
        result = qpos.take(self.actuation.qpos_adr, axis=-1)
        if self.springs:
            result[..., self.owners] += qpos.take(self.spring_qpos, axis=-1)
        return result

    def link_speeds(self, qvel: Array) -> Array:
        """(n,) speeds of the links from `MjData.qvel`."""
        result = qvel[self.actuation.dof_adr]
        if self.springs:
            result[self.owners] += qvel[self.spring_dof]
        return result

    def deflection(self, data: mujoco.MjData) -> Array:
        """(2, n) positions and speeds of the motors minus those of the links."""
        if not self.rotors and not self.springs:
            return np.zeros((2, self.actuation.n))
        motors = np.array([data.qpos[self.motor_qpos], data.qvel[self.motor_dof]])
        return motors - [self.link_positions(data.qpos), self.link_speeds(data.qvel)]

    @cached_property
    def addresses(self) -> dict[str, Any]:
        """The joints and motors as the compiled core takes them, (n,) each; -1 for none."""
        actuation = self.actuation
        found = {
            "qpos_addresses": actuation.qpos_adr,
            "dof_addresses": actuation.dof_adr,
            "ctrl_addresses": actuation.ctrl_adr,
            "motor_addresses": actuation.motor_adr,
            "gear": actuation.gear,
        }
        if self.springs:
            spring_qpos, spring_dof = np.full((2, actuation.n), -1, np.int64)
            spring_qpos[self.owners] = self.spring_qpos
            spring_dof[self.owners] = self.spring_dof
            found |= {"spring_qpos_addresses": spring_qpos, "spring_dof_addresses": spring_dof}
        if self.rotors:
            found |= {"rotor_qpos_addresses": self.motor_qpos, "rotor_dof_addresses": self.motor_dof}
        return {name: np.ascontiguousarray(each, np.float64 if name == "gear" else np.int64) for name, each in found.items()}

    def settle(self, model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        """Puts motors, windings and delayed commands where held links leave them, in place; the holding torque, (n,) N m."""
        if self.springs:
            settle_springs(model, data, list(self.springs), self.motor_qpos[self.owners])
        moving = data.qvel.copy()
        if self.rotors:
            self._settle_rotors(model, data)
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        missing = data.qfrc_bias - data.qfrc_passive
        holding = self.actuation.joint_map.reduced(missing, data.qpos[self.actuation.qpos_adr])
        if self.rotors:
            holding[self.owners] = missing[self.motor_dof[self.owners]]
            moving[self.motor_dof[self.owners]] = moving[self.actuation.dof_adr[self.owners]]
        data.qvel[:] = moving
        self.set_commands(model, data, holding[None])
        if not model.na:
            return holding
        for motor, force in zip(self.actuation.motor_adr.tolist(), holding / self.actuation.gear, strict=True):
            address = current_state(model, motor)
            if address >= 0:
                data.act[address] = current_for(model, motor, force)
        return holding

    def set_commands(self, model: mujoco.MjModel, data: mujoco.MjData, torques: Array, substeps: int = 1) -> None:
        """Gives delayed actuators the commands of the ticks before, (ticks, n) N m, the last one first; the oldest lasts."""
        delays = model.actuator_delay[self.actuation.motor_adr].tolist()
        for i, motor in enumerate(self.actuation.motor_adr.tolist()):
            if not delays[i] > 0.0:
                continue
            ages = np.arange(int(model.actuator_history[motor, 0]), 0, -1)
            ticks = np.minimum((ages - 1) // substeps, len(torques) - 1)
            values = torques[ticks, i] / self.actuation.gear[i]
            mujoco.mj_initCtrlHistory(model, data, motor, data.time - ages * model.opt.timestep, values)

    def _settle_rotors(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        links = self.actuation.qpos_adr[self.owners]
        dofs = self.actuation.dof_adr[self.owners]
        data.qpos[self.motor_qpos[self.owners]] = data.qpos[links]
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        load = data.qfrc_bias[dofs] - data.qfrc_passive[dofs]
        tendons = model.ntendon - len(self.rotors) + np.arange(len(self.rotors))
        stiffness = model.tendon_stiffness[tendons]
        gap = np.where(stiffness > 0.0, model.tendon_lengthspring[tendons, 1], model.tendon_range[tendons, 1])
        stretch = np.divide(load, stiffness, out=np.zeros_like(load), where=stiffness > 0.0) + np.sign(load) * gap
        data.qpos[self.motor_qpos[self.owners]] += stretch


def new_model(arm: Arm, plant: DrivetrainAttributes) -> mujoco.MjModel:
    """A model of a plant, without its values: a copy of the arm's model, with rotors, friction and windings if it has any."""
    structure = structure_of(arm, plant)
    if not any(structure[0]) and not structure[1] and not structure[2]:
        return copy.copy(arm.model)
    known = _models.get(arm)
    if known is None or known[0] != structure:
        if arm.recipe is None:
            raise ModelError(f"{arm.name:.60}: a compiled MjModel cannot get rotors or windings; load the MjSpec or the file")
        if any(structure[0]) and spring_joints(arm.model):
            raise InputError(f"elasticity: the file of {arm.name:.60} has elastic joints already")
        model = arm.recipe.model(lambda spec: _add_elements(spec, arm, structure))
        if model.njnt != arm.model.njnt + sum(structure[0]) or model.names[:1] != arm.model.names[:1]:
            raise ModelError(f"{arm.name:.60}: its file has changed; load it again")
        known = (structure, model)
        _models[arm] = known
    return copy.copy(known[1])


def structure_of(arm: Arm, plant: DrivetrainAttributes) -> Structure:
    """What a plant adds to a model: which joints get a rotor, whether there are bristles, and windings."""
    has_rotor = (per_joint("elasticity", plant.elasticity, arm) > 0.0) | (per_joint("backlash", plant.backlash, arm) > 0.0)
    return tuple(has_rotor.tolist()), plant.friction == "lugre", plant.motor > 0.0


def drivetrain_of(arm: Arm, plant: DrivetrainAttributes) -> Drivetrain:
    """The drivetrain in the models by `new_model`: rotors come after all joints of the arm's model."""
    model = arm.model
    actuation = arm.actuation
    has_rotor = np.array(structure_of(arm, plant)[0])
    rotors = np.arange(has_rotor.sum())
    before = spring_joints(model)
    moved = {int(address): i for i, address in enumerate(actuation.qpos_adr)}
    springs = {
        joint: moved[int(model.jnt_qposadr[motor])] for joint, motor in before.items() if int(model.jnt_qposadr[motor]) in moved
    }
    owners = {joint: moved[int(address)] for joint, address in enumerate(model.jnt_qposadr) if int(address) in moved} | springs
    motors = {motor: i for i, motor in enumerate(actuation.motor_adr.tolist())}
    motor_qpos = actuation.qpos_adr.copy()
    motor_dof = actuation.dof_adr.copy()
    motor_qpos[has_rotor] = model.nq + rotors
    motor_dof[has_rotor] = model.nv + rotors
    return Drivetrain(
        actuation=actuation,
        rotors=tuple((model.njnt + rotors).tolist()),
        springs=tuple(springs),
        spring_qpos=model.jnt_qposadr[list(springs)],
        spring_dof=model.jnt_dofadr[list(springs)],
        owners=np.flatnonzero(has_rotor) if has_rotor.any() else np.array(list(springs.values()), dtype=np.int64),
        sensors=sensor_timing(model, owners, motors, actuation.n),
        motor_qpos=motor_qpos,
        motor_dof=motor_dof,
    )


def apply_drivetrain(model: mujoco.MjModel, plant: DrivetrainAttributes, arm: Arm, drivetrain: Drivetrain) -> None:
    """Gives a model by `new_model` the rotors' inertias, the springs and gaps of a plant, in place; before `mj_setConst`."""
    if not drivetrain.rotors:
        return
    dofs = drivetrain.actuation.dof_adr[drivetrain.owners]
    rotors = drivetrain.motor_dof[drivetrain.owners]
    given = per_joint("rotor_inertia", plant.rotor_inertia, arm)[drivetrain.owners]
    inertia = np.where(given > 0.0, given, model.dof_armature[dofs])
    if not (inertia > 0.0).all():
        name = drivetrain.actuation.joint_names[drivetrain.owners[int(inertia.argmin())]]
        raise InputError(f"elasticity: {name:.60} has no rotor inertia in the model; give rotor_inertia, kg m^2 at the joint")
    model.dof_armature[rotors] = inertia
    model.dof_armature[dofs] = 0.0
    for friction in (model.dof_frictionloss, model.dof_damping, model.dof_dampingpoly):  # of the motor and its gear
        friction[rotors] = friction[dofs]
        friction[dofs] = 0.0
    tendons = model.ntendon - len(rotors) + np.arange(len(rotors))
    stiffness = per_joint("elasticity", plant.elasticity, arm)[drivetrain.owners]
    gap = 0.5 * per_joint("backlash", plant.backlash, arm)[drivetrain.owners]
    is_spring = stiffness > 0.0
    both = np.column_stack([-gap, gap])
    model.tendon_stiffness[tendons] = stiffness
    model.tendon_lengthspring[tendons] = np.where(is_spring[:, None], both, 0.0)
    model.tendon_limited[tendons] = ~is_spring
    model.tendon_range[tendons] = np.where(is_spring[:, None], 0.0, both)
    model.tendon_solref_lim[tendons] = (2 * model.opt.timestep, 1.0)


def finish_drivetrain(model: mujoco.MjModel, plant: DrivetrainAttributes, drivetrain: Drivetrain) -> None:
    """Gives a model what follows from its inertias, in place: damping of the springs, friction, windings."""
    if drivetrain.rotors:
        dofs = drivetrain.actuation.dof_adr[drivetrain.owners]
        tendons = model.ntendon - len(dofs) + np.arange(len(dofs))
        stiffness = model.tendon_stiffness[tendons]
        mobility = model.dof_invweight0[dofs] + 1 / model.dof_armature[drivetrain.motor_dof[drivetrain.owners]]
        model.tendon_damping[tendons] = 2 * plant.elastic_damping * np.sqrt(stiffness / mobility)
        rate = np.sqrt(stiffness * mobility)
        worst = int(rate.argmax())
        if rate[worst] * model.opt.timestep > _MAX_SPRING_RATE:
            name = drivetrain.actuation.joint_names[drivetrain.owners[worst]]
            bound = stiffness[worst] * (_MAX_SPRING_RATE / (rate[worst] * model.opt.timestep)) ** 2
            raise InputError(
                f"elasticity: {stiffness[worst]:.4g} N m/rad of {name:.60} is too stiff for steps of "
                f"{1e3 * model.opt.timestep:.3g} ms, at most {bound:.3g}; lower it, or take continuous=True or a shorter step"
            )
    if plant.friction == "lugre":
        for k, dof in enumerate(drivetrain.motor_dof.tolist()):
            coulomb = float(model.dof_frictionloss[dof])
            inertia = 1 / float(model.dof_invweight0[dof])
            most = inertia * (_MAX_BRISTLE_RATE / model.opt.timestep) ** 2
            stiffness = min(plant.stiction * coulomb / _BRISTLE_DEFLECTION, most)
            damping = np.sqrt(stiffness * inertia)
            actuator = model.nactuator - drivetrain.actuation.n + k
            set_friction(model, actuator, stiffness, damping, coulomb, plant.stiction * coulomb, _STRIBECK_SPEED)
            model.dof_frictionloss[dof] = 0.0
    if plant.motor > 0.0:
        for motor in drivetrain.actuation.motor_adr.tolist():
            set_time_constant(model.actuator(motor), plant.motor)


def per_joint(name: str, value: object, arm: Arm) -> Array:
    """A checked attribute of one number, or of one for each of the n joints of an arm, as (n,)."""
    values = np.asarray(value, dtype=np.float64)
    if values.size not in (1, arm.n):
        raise InputError(f"{name}: expected 1 or {arm.n} numbers, got {values.size} ({arm.name:.80})")
    return np.full(arm.n, values)


def _add_elements(spec: mujoco.MjSpec, arm: Arm, structure: Structure) -> None:
    """Adds rotors, bristles and windings to a specification, in place; every number before stays what it was."""
    has_rotor, has_bristles, has_windings = structure
    motors = list(spec.actuators)  # new elements invalidate the numbers of others, but not their order
    flags = iter(has_rotor)
    targets = []
    for index, actuator in zip(arm.joint_map.leaders.tolist(), arm.actuation.motor_adr.tolist(), strict=True):
        target = joint_name(arm.model, arm.joint_map.joints[index])
        joint = spec.joint(target)
        motor = motors[actuator]
        if next(flags):
            if not (is_on_joint(arm.model, actuator) and motor.target == target):
                raise ModelError(f"elasticity: {target:.60} is moved through a tendon or an equality, and can get no rotor")
            target = f"rotor of {joint.name}"
            _add_rotor(spec, joint, target)
            motor.target = target
        if has_windings and motor.gaintype != mujoco.mjtGain.mjGAIN_DCMOTOR:
            motor.set_to_dcmotor([1.0, 1.0], 1.0, inductance=[0.0, 1.0], ctrlspec=TORQUE_COMMAND)
        elif has_windings:
            set_time_constant(motor, motor.dynprm[0] or 1.0)
        targets.append(target)
    for target in targets if has_bristles else []:
        friction = spec.add_actuator(name=f"friction of {target}", target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        passive = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
        friction.set_to_dcmotor([0.0, 0.0], 1.0, lugre=[1.0, 1.0, 1.0, 1.0, 1.0], ctrlspec=passive)


def _add_rotor(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, name: str) -> None:
    rotor = spec.worldbody.add_body(name=name, gravcomp=1.0)
    rotor.explicitinertial = True
    rotor.mass = _ROTOR_MASS
    rotor.inertia = [_ROTOR_MASS] * 3
    rotor.ipos = [0.0, 0.0, 0.0]
    rotor.add_joint(name=name, type=joint.type, axis=[0.0, 0.0, 1.0])
    gear = spec.add_tendon(name=f"gear of {joint.name}", stiffness=1.0, damping=1.0, springlength=[0.0, 0.0])
    gear.wrap_joint(joint.name, -1.0)
    gear.wrap_joint(name, 1.0)
