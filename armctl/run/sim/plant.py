"""Plant: how the simulated arm differs from the model that controllers use."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.defaults import TIMESTEPS_S
from armctl.core.errors import InputError
from armctl.core.faces import face, show_arguments
from armctl.core.other_names import check_keywords
from armctl.core.validation import Array, IntArray, instance, number, shown, vector
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.brake import BRAKED_ARRAYS, brake
from armctl.model.mjmodel.edit import add_payload
from armctl.model.mjmodel.queries import actuator_name, is_on_joint
from armctl.model.mjmodel.spring_joints import spring_joints
from armctl.run.sim.drivetrain import Drivetrain, apply_drivetrain, drivetrain_of, finish_drivetrain, new_model, per_joint
from armctl.run.sim.plant_attribute import Kind, attributes_of, number_text, plant_attribute

# Runge-Kutta is stable up to steps of 2.8 time constants of the fastest damped joint; one time constant keeps it accurate.
_CONTINUOUS_STEP_S = 2e-4
# Noise of the encoder in comparisons: absolute encoders of robot joints resolve 17 to 20 bits, 5e-5 to 6e-6 rad.
ENCODER_NOISE_RAD = 1e-5
DIVERGED_SPEED = 1e4  # rad/s (m/s), of all joints together; above it a run counts as diverged
# What `apply_plant` changes, besides what MuJoCo derives from it.
# The places of bodies are those of the arm, whose geometry may be calibrated, and not of the file that it was loaded from.
_PLANT_ARRAYS = (
    "body_pos",
    "body_quat",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "dof_damping",
    "dof_dampingpoly",
)
_PLANT_OPTIONS = ("disableflags", "timestep", "integrator", "tolerance")


@dataclass(frozen=True, eq=False)
class Push:
    """An external force on the tip for a limited time.

    Attributes:
        start: s, when it begins.
        duration: s, how long it lasts.
        force: (3,) N, in world axes, at the tip.
        torque: (3,) N m, in world axes.
    """

    start: float
    duration: float
    force: ArrayLike = (0.0, 0.0, 0.0)
    torque: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", number("start", self.start, 0.0))
        object.__setattr__(self, "duration", number("duration", self.duration, 0.0))
        object.__setattr__(self, "force", vector("force", self.force, 3))
        object.__setattr__(self, "torque", vector("torque", self.torque, 3))

    def __str__(self) -> str:
        force = np.asarray(self.force)
        torque = np.asarray(self.torque)
        parts = [
            f"{number_text(force)} N" if force.any() else "",
            f"{number_text(torque)} N m" if torque.any() else "",
            f"from {number_text(self.start)} s for {number_text(self.duration)} s",
        ]
        return "push " + " ".join(part for part in parts if part)

    @property
    def wrench(self) -> Array:
        """(6,) N and N m, force first."""
        return np.concatenate([self.force, self.torque])

    def acts(self, t: float) -> bool:
        """Tells whether the push acts at a time.

        Args:
            t: s.
        """
        time = number("t", t)
        return self.start <= time < self.start + self.duration


@dataclass(frozen=True, eq=False)
class Plant:
    """How the simulated arm differs from the controller's model. By default it does not differ.

    `str(plant)` is its name, or else a list of all differences. `PLANT_ATTRIBUTES` is the table of its attributes.

    Attributes:
        payload: kg, of a load that is rigidly attached to the tip.
        payload_center: (3,) m, its center of mass in the tip frame.
        payload_inertia: kg m^2 about its center of mass, in the axes of the tip frame: (3,) moments or a (3, 3) matrix;
            zero for a point mass.
        mass_scale: Factor on the masses and inertias of all moving links.
        coulomb_friction: N m of dry friction added to the model's; a number for all joints or (n,).
        viscous_friction: N m s/rad of damping added to the model's; a number for all joints or (n,).
        friction: "coulomb" for dry friction as MuJoCo's constraint, or "lugre" for bristles that stick and slip (LuGre law);
            either way that of the model and `coulomb_friction`.
        stiction: Static friction over dry friction, with "lugre".
        motor: s, the time constant with which torques follow commands: inductance over resistance of a DC motor.
        elasticity: N m/rad, stiffness of a spring between each motor and its link; one number or (n,), 0 for rigid.
            The motor's inertia is the model's armature, and its friction that of the joint. Logs show the links, and a run
            starts with them where its motion does: a law that follows the motors yields first by what the springs carry.
        elastic_damping: Damping ratio of these springs, with the inertias on both sides.
        rotor_inertia: kg m^2 at the joint, of each motor with a spring or a gap; 0 for the model's armature.
        backlash: rad, the gap between each motor and its link; a number for all joints or (n,).
        encoder_side: Where joints are measured if they are elastic: "motor" or "link".
        delay: Ticks by which commands are delayed.
        jitter: Ticks by which commands are late at most besides the delay, at random.
        sensor_delay: Ticks by which measured positions and velocities are late, besides the delays of the file's sensors.
        encoder_bits: Bits in which an encoder counts a turn of the joint (a metre of a slide joint); 0 for exact positions.
        velocity: "differenced" for the difference of two measured positions over the tick, as in most arms, or "true" for the
            velocity of the simulation.
        encoder_noise: rad, standard deviation of the noise on measured positions.
        velocity_noise: rad/s, standard deviation of the noise of a velocity sensor. By default there is none, and the velocity
            is differenced from the measured positions: its noise is that of two positions divided by the tick.
        wrench_source: "flange" for the wrench that a flange sensor measures, or "torques" for one that is estimated from the
            motors' torques, the measured motion and the nominal model.
        force_noise: N, standard deviation of the noise on measured forces.
        moment_noise: N m, standard deviation of the noise on measured moments.
        wrench_delay: Ticks by which measured wrenches are delayed.
        pushes: External forces, each a `Push`.
        joint_torque: A function of the true positions q (n,) rad, velocities v (n,) rad/s and the time t, s, that returns an
            additional torque on the joints, (n,) N m, such as a friction of your own. It is called once a tick, and its torque
            is held for the tick; a run with it makes its ticks in Python. It acts on this plant only. No linear loop contains
            it: `margins` and `linearize` leave it out.
        continuous: Whether the arm moves almost continuously between ticks while the torque is held, as a real arm does
            (Runge-Kutta steps of at most 0.2 ms, less if damping is faster). A velocity that is differenced from positions
            is then half a tick late. Otherwise the model's integrator makes one step a tick, whose velocity is that difference.
        timestep: s, the tick: control period and, unless continuous, integration step; None for the model's.
        seed: The seed of the noise; every run of the same plant has the same noise.
        name: A short name for tables and files, such as "worn gears".
    """

    payload: float = plant_attribute(Kind.NUMBER, 0.0, unit="kg", low=0.0, phrase="payload {} kg", varies_in_episodes=True)
    payload_center: ArrayLike = plant_attribute(
        Kind.POINT, (0.0, 0.0, 0.0), unit="m", phrase="payload at {} m", only_with=("payload",)
    )
    payload_inertia: ArrayLike = plant_attribute(
        Kind.INERTIA, (0.0, 0.0, 0.0), unit="kg m^2", phrase="payload inertia {} kg m^2", only_with=("payload",)
    )
    mass_scale: float = plant_attribute(Kind.NUMBER, 1.0, low=1e-3, phrase="masses x {}", varies_in_episodes=True)
    coulomb_friction: ArrayLike = plant_attribute(
        Kind.PER_JOINT, 0.0, unit="N m", low=0.0, phrase="Coulomb friction {} N m", varies_in_episodes=True
    )
    viscous_friction: ArrayLike = plant_attribute(
        Kind.PER_JOINT, 0.0, unit="N m s/rad", low=0.0, phrase="viscous friction {} N m s/rad", varies_in_episodes=True
    )
    friction: str = plant_attribute(Kind.WORD, "coulomb", words=("coulomb", "lugre"), phrase="{} friction", is_factor=False)
    stiction: float = plant_attribute(Kind.NUMBER, 1.5, low=1.0, high=10.0, phrase="stiction {}", only_with=("friction",))
    motor: float = plant_attribute(Kind.NUMBER, 0.0, unit="s", low=0.0, high=1.0, phrase="motor lag {} ms", scale=1e3)
    elasticity: ArrayLike = plant_attribute(Kind.PER_JOINT, 0.0, unit="N m/rad", low=0.0, phrase="elasticity {} N m/rad")
    elastic_damping: float = plant_attribute(
        Kind.NUMBER, 0.01, low=0.0, high=1.0, phrase="damping ratio {} of the springs", only_with=("elasticity",)
    )
    rotor_inertia: ArrayLike = plant_attribute(
        Kind.PER_JOINT, 0.0, unit="kg m^2", low=0.0, phrase="rotors {} kg m^2", only_with=("elasticity", "backlash")
    )
    backlash: ArrayLike = plant_attribute(Kind.PER_JOINT, 0.0, unit="rad", low=0.0, phrase="backlash {} rad")
    encoder_side: str = plant_attribute(Kind.WORD, "motor", words=("motor", "link"), phrase="encoders at the {}")
    delay: int = plant_attribute(
        Kind.WHOLE_NUMBER, 0, unit="ticks", low=0, phrase="delay {}", disturbs_signals=True, varies_in_episodes=True
    )
    jitter: int = plant_attribute(
        Kind.WHOLE_NUMBER, 0, unit="ticks", low=0, high=1000, phrase="jitter {}", disturbs_signals=True
    )
    sensor_delay: int = plant_attribute(
        Kind.WHOLE_NUMBER, 0, unit="ticks", low=0, high=1000, phrase="sensor delay {}", disturbs_signals=True
    )
    encoder_bits: int = plant_attribute(
        Kind.WHOLE_NUMBER, 0, unit="bits", low=0, high=32, phrase="encoder of {} bits", disturbs_signals=True
    )
    velocity: str = plant_attribute(
        Kind.WORD, "differenced", words=("differenced", "true"), phrase="{} velocity", disturbs_signals=True
    )
    encoder_noise: float = plant_attribute(
        Kind.NUMBER, 0.0, unit="rad", low=0.0, phrase="encoder noise {} rad", disturbs_signals=True, varies_in_episodes=True
    )
    velocity_noise: float | None = plant_attribute(
        Kind.NUMBER, None, unit="rad/s", low=0.0, phrase="velocity noise {} rad/s", disturbs_signals=True
    )
    wrench_source: str = plant_attribute(Kind.WORD, "flange", words=("flange", "torques"), phrase="wrench estimated from {}")
    force_noise: float = plant_attribute(Kind.NUMBER, 0.0, unit="N", low=0.0, phrase="force noise {} N")
    moment_noise: float = plant_attribute(Kind.NUMBER, 0.0, unit="N m", low=0.0, phrase="moment noise {} N m")
    wrench_delay: int = plant_attribute(Kind.WHOLE_NUMBER, 0, unit="ticks", low=0, phrase="wrench delay {}")
    pushes: Push | Sequence[Push] = plant_attribute(Kind.OTHER, (), phrase="{}", disturbs_signals=True, is_factor=False)
    joint_torque: Callable[[Array, Array, float], ArrayLike] | None = plant_attribute(
        Kind.OTHER, None, phrase="joint torque by {}", disturbs_signals=True, is_factor=False
    )
    continuous: bool = plant_attribute(Kind.FLAG, False, phrase="continuous")
    timestep: float | None = plant_attribute(
        Kind.NUMBER, None, unit="s", low=TIMESTEPS_S[0], high=TIMESTEPS_S[1], phrase="tick {} ms", scale=1e3
    )
    seed: int = plant_attribute(
        Kind.WHOLE_NUMBER,
        0,
        low=0,
        phrase="seed {}",
        only_with=("encoder_noise", "velocity_noise", "force_noise", "moment_noise", "jitter"),
        is_factor=False,
    )
    name: str = plant_attribute(Kind.OTHER, "", is_factor=False)

    def __new__(cls, *args: object, **keywords: object) -> Self:
        """A plant, not yet constructed; a TypeError says which keyword it does not take."""
        check_keywords(cls, keywords)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name, attribute in PLANT_ATTRIBUTES.items():
            object.__setattr__(self, name, attribute.read(name, getattr(self, name)))
        object.__setattr__(self, "pushes", _pushes(self.pushes))
        if self.joint_torque is not None and not callable(self.joint_torque):
            raise InputError(f"joint_torque: expected a function of q, v and t, got {shown(self.joint_torque)}")
        instance("name", self.name, str, "'worn gears' is one")

    def __repr__(self) -> str:
        return face(self, **self._differences)

    def __str__(self) -> str:
        phrases = [
            attribute.describe(value)
            for attribute, value in ((PLANT_ATTRIBUTES[name], value) for name, value in self._differences.items())
            if attribute.phrase and (not attribute.only_with or not self._differences.keys().isdisjoint(attribute.only_with))
        ]
        return self.name or ", ".join(phrases) or "nominal"

    @cached_property
    def _differences(self) -> Mapping[str, object]:
        """The attributes that differ from their defaults, with their values."""
        values = vars(self)
        return {name: values[name] for name, attribute in PLANT_ATTRIBUTES.items() if attribute.differs(values[name])}

    @cached_property
    def key(self) -> tuple[object, ...]:
        """All differences as something hashable: two plants with equal keys behave identically."""
        return tuple((name, _hashable(value)) for name, value in self._differences.items())

    @property
    def has_signal_disturbances(self) -> bool:
        """Whether measurements or commands are disturbed during a run."""
        return self.differences_positions or any(PLANT_ATTRIBUTES[name].disturbs_signals for name in self._differences)

    @property
    def differences_positions(self) -> bool:
        """Whether the measured velocity is a difference of positions that differs from the true velocity."""
        in_steps = self.continuous or self.encoder_bits > 0
        return in_steps and self.velocity == "differenced" and self.velocity_noise is None

    def model(self, arm: Arm) -> mujoco.MjModel:
        """The MuJoCo model of this plant.

        Args:
            arm: The model of the controllers. The motors obey its limits.

        Returns:
            A new model. All joints of the robot outside the chain, such as a gripper's, are braked. Rotors, springs and
            friction that the plant adds come after the arm's own bodies, joints and actuators.

        Raises:
            ModelError: The arm was loaded as a compiled model, which cannot get further elements.
        """
        instance("arm", arm, Arm, "armctl.load(name) returns one")
        model = new_model(arm, self)
        apply_plant(model, mujoco.MjData(model), self, arm)
        brake(model, held_dofs(arm))
        return model


PLANT_ATTRIBUTES = attributes_of(Plant)
show_arguments(Plant)


def read_plant(plant: Plant | None) -> Plant:
    """A plant from what a caller gave; None is the nominal one."""
    plant = NOMINAL if plant is None else plant
    instance("plant", plant, Plant, "armctl.Plant(payload=1.0) is one")
    return plant


def with_tick(plant: Plant, dt: float) -> Plant:
    """A plant with a tick of so many seconds. InputError if it has another one, or for a tick out of bounds."""
    dt = number("dt", dt)
    if plant.timestep not in (None, dt):
        raise InputError(f"dt: {dt:g} s, but the plant has timestep={plant.timestep:g} s; give one of them")
    return replace(plant, timestep=dt)


class Brake:
    """Holds joints of a model where they are, and releases some of them."""

    def __init__(self, model: mujoco.MjModel, dofs: IntArray):
        self._model = model
        self._dofs = dofs
        self._released = np.zeros(0, dtype=np.int64)
        self._unbraked = {name: getattr(model, name).copy() for name in BRAKED_ARRAYS}
        self._tolerance = float(model.opt.tolerance)
        brake(model, dofs)

    def release(self, dofs: IntArray) -> bool:
        """Releases these joints besides those that are released; whether any of them was braked."""
        if np.isin(dofs, self._released).all():
            return False
        self._release_only(np.union1d(self._released, dofs))
        return True

    def engage(self) -> None:
        """Brakes all joints again."""
        if len(self._released):
            self._release_only(self._released[:0])

    def _release_only(self, dofs: IntArray) -> None:
        for name, values in self._unbraked.items():
            getattr(self._model, name)[:] = values
        self._model.opt.tolerance = self._tolerance
        self._released = dofs
        brake(self._model, np.setdiff1d(self._dofs, dofs))


def apply_plant(
    model: mujoco.MjModel, data: mujoco.MjData, plant: Plant, arm: Arm, drivetrain: Drivetrain | None = None
) -> None:
    """Gives a model by `new_model` the differences of a plant, instead of those that it has; no joint is braked then.

    A copy of a model with meshes takes longer than a run of a second, so a model is kept for the next plant; the state in its
    data is lost. A payload hangs at the arm's first tip. `drivetrain` is the drivetrain of the model, if the caller knows it.
    """
    for name in (*_PLANT_ARRAYS, *BRAKED_ARRAYS):
        values = getattr(arm.model, name)
        getattr(model, name)[: len(values)] = values
    for name in _PLANT_OPTIONS:
        setattr(model.opt, name, getattr(arm.model.opt, name))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    if plant.timestep is not None:
        model.opt.timestep = plant.timestep
    if plant.mass_scale != 1.0:
        model.body_mass *= plant.mass_scale
        model.body_inertia *= plant.mass_scale
    if plant.payload > 0.0:
        add_payload(
            model,
            arm.tip_body,
            arm.T_body_tip,
            plant.payload,
            np.asarray(plant.payload_center, float),
            np.asarray(plant.payload_inertia, float),
        )
    dofs = arm.dof_adr
    for what, column in (("coulomb_friction", model.dof_frictionloss), ("viscous_friction", model.dof_damping)):
        column[dofs] += per_joint(what, getattr(plant, what), arm)
    drivetrain = drivetrain_of(arm, plant) if drivetrain is None else drivetrain
    apply_drivetrain(model, plant, arm, drivetrain)
    mujoco.mj_setConst(model, data)
    if plant.continuous:
        damped = np.concatenate([dofs, drivetrain.motor_dof])
        rate = (model.dof_damping * model.dof_invweight0)[damped].max()  # 1/s, of the fastest damped joint
        step = _CONTINUOUS_STEP_S / max(1.0, _CONTINUOUS_STEP_S * rate)
        model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
        model.opt.timestep /= math.ceil(model.opt.timestep / step - 1e-9)
    finish_drivetrain(model, plant, drivetrain)
    _limit_motors(model, arm)
    _check_history(model)


def _limit_motors(model: mujoco.MjModel, arm: Arm) -> None:
    """Gives the motors of an arm in a model the limits of the arm, in place, where these are lower than those of its file."""
    own = arm.model
    motors = arm.actuation.motor_adr
    bound = np.minimum(arm.limits.tau_max / np.abs(arm.gear), own.actuator_forcerange[motors, 1])
    model.actuator_forcerange[motors, 0] = -bound
    model.actuator_forcerange[motors, 1] = bound
    model.actuator_ctrlrange[arm.ctrl_adr] = model.actuator_forcerange[motors]


def _check_history(model: mujoco.MjModel) -> None:
    """Refuses steps that are too short for the buffer of an actuator's delay: MuJoCo would shorten the delay."""
    is_late = model.actuator_delay > 0.0
    if not is_late.any():
        return
    step = model.opt.timestep
    is_short = is_late & (model.actuator_delay > (model.actuator_history[:, 0] + 1e-6) * step)
    for actuator in np.flatnonzero(is_short).tolist():
        needed = math.ceil(model.actuator_delay[actuator] / step - 1e-6)
        raise InputError(
            f"plant: the delay of the actuator {actuator_name(model, actuator)!r:.60} spans {needed} steps, and "
            f"its nsample is {model.actuator_history[actuator, 0]}; raise nsample in the file, or take longer steps"
        )


def held_dofs(arm: Arm) -> IntArray:
    """Addresses in `MjData.qvel` of the robot's joints outside the arm: fingers, other limbs, wheels.

    Free objects of the scene are not among them, nor the springs of the arm's elastic joints.
    """
    model = arm.model
    free = model.jnt_type[model.dof_jntid] == int(mujoco.mjtJoint.mjJNT_FREE)
    has_motor = np.zeros(model.nbody, bool)
    has_motor[model.body_rootid[[frame.body for frame in arm.tip_frames]]] = True
    for actuator in range(model.nactuator):
        if is_on_joint(model, actuator):
            has_motor[model.body_rootid[model.jnt_bodyid[model.actuator_trnid[actuator, 0]]]] = True
    of_robot = has_motor[model.body_rootid[model.dof_bodyid]]
    moved = arm.joint_map.joints
    springs = [joint for joint, motor_joint in spring_joints(model).items() if motor_joint in moved]
    own = np.concatenate([arm.joint_map.dof_adr, model.jnt_dofadr[springs]])
    return np.setdiff1d(np.flatnonzero(of_robot & ~free), own)


def _pushes(value: Push | Iterable[Push]) -> tuple[Push, ...]:
    if isinstance(value, Push):
        return (value,)
    pushes = tuple(value) if isinstance(value, Iterable) else (value,)
    for push in pushes:
        instance("pushes", push, Push, "armctl.Push(0.5, 0.1, force=[0, 20, 0]) is one")
    return pushes


def _hashable(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, tuple):
        return tuple((push.start, push.duration, push.wrench.tobytes()) for push in value)
    return value


NOMINAL = Plant()
WITH_ENCODER = Plant(encoder_noise=ENCODER_NOISE_RAD, name="encoder")
