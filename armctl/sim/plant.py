"""Plant: how the simulated arm differs from the model that controllers use."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, IntArray, choice, instance, integer, number, shown, vector
from armctl.mjmodel.couplings import dofs_of_equality, dofs_of_tendon
from armctl.mjmodel.edit import add_point_mass
from armctl.robot.arm import Arm

# Runge-Kutta is stable up to steps of 2.8 time constants of the fastest damped joint; one time constant keeps it accurate.
_CONTINUOUS_STEP_S = 2e-4
# Armature of a braked joint: forces of the arm then move it by less than the rounding error.
_BRAKE_INERTIA = 1e8  # kg m^2 (kg for a slide joint)
WRENCH_SOURCES = ("flange", "torques")
_BRAKED_ARRAYS = (
    "dof_armature",
    "dof_frictionloss",
    "jnt_limited",
    "tendon_limited",
    "tendon_frictionloss",
    "eq_active0",
)
# What `apply_plant` changes, besides what MuJoCo derives from it.
_PLANT_ARRAYS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_damping")
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
            f"{_text(force)} N" if force.any() else "",
            f"{_text(torque)} N m" if torque.any() else "",
            f"from {_text(self.start)} s for {_text(self.duration)} s",
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

        Returns:
            Whether it acts.

        Raises:
            InputError: The time is not a finite number.
        """
        time = number("t", t)
        return self.start <= time < self.start + self.duration


@dataclass(frozen=True, eq=False)
class Plant:
    """How the simulated arm differs from the controller's model. By default it does not differ.

    `str(plant)` is its name, or else a list of all differences.

    Attributes:
        payload: kg, a point mass at the tip.
        payload_center: (3,) m, the position of that mass in the tip frame.
        mass_scale: Factor on the masses and inertias of all moving links.
        coulomb_friction: N m of dry friction added to the model's; a number for all joints or (n,).
        viscous_friction: N m s/rad of damping added to the model's; a number for all joints or (n,).
        delay: Ticks by which commands are delayed.
        encoder_noise: rad, standard deviation of the noise on measured positions.
        velocity_noise: rad/s, standard deviation of the noise of a velocity sensor. By default there is none, and the velocity
            is differenced from the measured positions: its noise is that of two positions divided by the tick.
        wrench_source: "flange" for the wrench that a flange sensor measures, or "torques" for one that is estimated from the
            motors' torques, the measured motion and the nominal model.
        force_noise: N, standard deviation of the noise on measured forces.
        moment_noise: N m, standard deviation of the noise on measured moments.
        wrench_delay: Ticks by which measured wrenches are delayed.
        torque_ripple: Amplitude of the torque's variation with the joint angle, as a fraction of the torque.
        pushes: External forces, each a `Push`.
        continuous: Whether the arm moves almost continuously between ticks while the torque is held, as a real arm does
            (Runge-Kutta steps of at most 0.2 ms, less if damping is faster). Otherwise the model's integrator makes one step
            a tick.
        free_space: Whether the arm touches nothing, which makes its simulation several times as fast: the steps are those of
            `mj_step` without collision detection. Every run is checked, and fails if the arm touched something. Arms with dry
            friction, springs or coupled joints are refused.
        timestep: s, the tick: control period and, unless continuous, integration step; None for the model's.
        seed: The seed of the noise; every run of the same plant has the same noise.
        name: A short name for tables and files, such as "worn gears".
    """

    payload: float = 0.0
    payload_center: ArrayLike = (0.0, 0.0, 0.0)
    mass_scale: float = 1.0
    coulomb_friction: ArrayLike = 0.0
    viscous_friction: ArrayLike = 0.0
    delay: int = 0
    encoder_noise: float = 0.0
    velocity_noise: float | None = None
    wrench_source: str = "flange"
    force_noise: float = 0.0
    moment_noise: float = 0.0
    wrench_delay: int = 0
    torque_ripple: float = 0.0
    pushes: Push | Sequence[Push] = ()
    continuous: bool = False
    free_space: bool = False
    timestep: float | None = None
    seed: int = 0
    name: str = ""

    def __post_init__(self) -> None:
        checked: dict[str, object] = {
            what: number(what, getattr(self, what), 0.0)
            for what in ("payload", "encoder_noise", "force_noise", "moment_noise", "torque_ripple")
        }
        if self.velocity_noise is not None:
            checked["velocity_noise"] = number("velocity_noise", self.velocity_noise, 0.0)
        checked["mass_scale"] = number("mass_scale", self.mass_scale, 1e-3)
        checked["payload_center"] = vector("payload_center", self.payload_center, 3)
        checked["coulomb_friction"] = _friction("coulomb_friction", self.coulomb_friction)
        checked["viscous_friction"] = _friction("viscous_friction", self.viscous_friction)
        checked["delay"] = integer("delay", self.delay, 0)
        checked["wrench_source"] = choice("wrench_source", self.wrench_source, WRENCH_SOURCES)
        checked["wrench_delay"] = integer("wrench_delay", self.wrench_delay, 0)
        checked["pushes"] = _pushes(self.pushes)
        instance("continuous", self.continuous, bool, "True or False is one")
        instance("free_space", self.free_space, bool, "True or False is one")
        if self.timestep is not None:
            checked["timestep"] = number("timestep", self.timestep, 1e-6, 0.1)
        checked["seed"] = integer("seed", self.seed, 0)
        instance("name", self.name, str, "'worn gears' is one")
        for what, value in checked.items():
            object.__setattr__(self, what, value)

    def __str__(self) -> str:
        return self.name or ", ".join(self._differences()) or "nominal"

    def _differences(self) -> list[str]:
        """All differences from the model, one phrase each."""
        center = np.asarray(self.payload_center)
        coulomb = np.asarray(self.coulomb_friction)
        viscous = np.asarray(self.viscous_friction)
        found = []
        if self.payload:
            found.append(f"payload {_text(self.payload)} kg" + (f" at {_text(center)} m" if center.any() else ""))
        if self.mass_scale != 1.0:
            found.append(f"masses x {_text(self.mass_scale)}")
        if coulomb.any():
            found.append(f"Coulomb friction {_text(coulomb)} N m")
        if viscous.any():
            found.append(f"viscous friction {_text(viscous)} N m s/rad")
        if self.delay:
            found.append(f"delay {self.delay}")
        if self.encoder_noise:
            found.append(f"encoder noise {_text(self.encoder_noise)} rad")
        if self.velocity_noise or (self.encoder_noise and self.velocity_noise is not None):
            found.append(f"velocity noise {_text(self.velocity_noise)} rad/s")
        if self.wrench_source != "flange":
            found.append("wrench estimated from torques")
        if self.force_noise:
            found.append(f"force noise {_text(self.force_noise)} N")
        if self.moment_noise:
            found.append(f"moment noise {_text(self.moment_noise)} N m")
        if self.wrench_delay:
            found.append(f"wrench delay {self.wrench_delay}")
        if self.seed and (self.encoder_noise or self.velocity_noise or self.force_noise or self.moment_noise):
            found.append(f"seed {self.seed}")
        if self.torque_ripple:
            found.append(f"ripple {_text(self.torque_ripple)}")
        found += [str(push) for push in _pushes(self.pushes)]
        if self.continuous:
            found.append("continuous")
        if self.free_space:
            found.append("free space")
        if self.timestep is not None:
            found.append(f"tick {_text(1e3 * self.timestep)} ms")
        return found

    @property
    def key(self) -> tuple[object, ...]:
        """All values as something hashable: two plants with equal keys behave identically."""
        arrays = (self.payload_center, self.coulomb_friction, self.viscous_friction)
        pushes = tuple((push.start, push.duration, push.wrench.tobytes()) for push in _pushes(self.pushes))
        return (
            self.payload,
            self.mass_scale,
            self.delay,
            self.encoder_noise,
            self.velocity_noise,
            self.wrench_source,
            self.force_noise,
            self.moment_noise,
            self.wrench_delay,
            self.torque_ripple,
            self.continuous,
            self.free_space,
            self.timestep,
            self.seed,
            self.name,
            pushes,
            *(np.asarray(each).tobytes() for each in arrays),
        )

    @property
    def has_signal_disturbances(self) -> bool:
        """Whether measurements or commands are disturbed during a run."""
        return bool(self.delay or self.encoder_noise or self.velocity_noise or self.torque_ripple or self.pushes)

    def model(self, arm: Arm) -> mujoco.MjModel:
        """The MuJoCo model of this plant.

        Args:
            arm: The model of the controllers.

        Returns:
            A new model. All joints of the robot outside the chain, such as a gripper's, are braked.

        Raises:
            InputError: It is no arm, or friction is given for another number of joints.
        """
        instance("arm", arm, Arm, "armctl.load(name) returns one")
        model = copy.copy(arm.model)
        apply_plant(model, mujoco.MjData(model), self, [arm])
        brake(model, held_dofs(arm))
        return model


def read_plant(plant: Plant | None) -> Plant:
    """A plant from what a caller gave; None is the nominal one.

    Raises:
        InputError: It is no Plant.
    """
    plant = NOMINAL if plant is None else plant
    instance("plant", plant, Plant, "armctl.Plant(payload=1.0) is one")
    return plant


class Brake:
    """Holds joints of a model where they are, and releases some of them."""

    def __init__(self, model: mujoco.MjModel, dofs: IntArray):
        self._model = model
        self._dofs = dofs
        self._unbraked = {name: getattr(model, name).copy() for name in _BRAKED_ARRAYS}
        self._tolerance = float(model.opt.tolerance)
        brake(model, dofs)

    def release_only(self, dofs: IntArray) -> None:
        """Releases these joints and brakes all others."""
        for name, values in self._unbraked.items():
            getattr(self._model, name)[:] = values
        self._model.opt.tolerance = self._tolerance
        brake(self._model, np.setdiff1d(self._dofs, dofs))


def apply_plant(model: mujoco.MjModel, data: mujoco.MjData, plant: Plant, arms: Sequence[Arm]) -> None:
    """Gives a copy of the arms' model the differences of a plant, instead of those that it has; no joint is braked then.

    A copy of a model with meshes takes longer than a run of a second, so a model is kept for the next plant.

    Args:
        model: The copy.
        data: Any state of it; it is lost.
        plant: The plant.
        arms: The arms. A payload hangs at the first one's tip.
    """
    for name in (*_PLANT_ARRAYS, *_BRAKED_ARRAYS):
        getattr(model, name)[:] = getattr(arms[0].model, name)
    for name in _PLANT_OPTIONS:
        setattr(model.opt, name, getattr(arms[0].model.opt, name))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    if plant.timestep is not None:
        model.opt.timestep = plant.timestep
    if plant.mass_scale != 1.0:
        model.body_mass *= plant.mass_scale
        model.body_inertia *= plant.mass_scale
    if plant.payload > 0.0:
        center = arms[0].T_body_tip.transform(plant.payload_center)
        add_point_mass(model, arms[0].tip_body, plant.payload, center)
    dofs = np.concatenate([arm.dof_adr for arm in arms])
    for what, column in (("coulomb_friction", model.dof_frictionloss), ("viscous_friction", model.dof_damping)):
        added = np.asarray(getattr(plant, what))
        if len(added) not in (1, len(dofs)):
            names = ", ".join(arm.name for arm in arms)
            raise InputError(f"{what}: expected 1 or {len(dofs)} numbers, got {len(added)} ({names:.80})")
        column[dofs] += added
    mujoco.mj_setConst(model, data)
    if plant.continuous:
        rate = (model.dof_damping * model.dof_invweight0)[dofs].max()  # 1/s, of the fastest damped joint
        step = _CONTINUOUS_STEP_S / max(1.0, _CONTINUOUS_STEP_S * rate)
        model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
        model.opt.timestep /= math.ceil(model.opt.timestep / step - 1e-9)


def held_dofs(*arms: Arm) -> IntArray:
    """Addresses in `MjData.qvel` of the robot's joints that belong to none of the arms: fingers, other limbs, wheels.

    Free objects of the scene are not among them.
    """
    model = arms[0].model
    free = model.jnt_type[model.dof_jntid] == int(mujoco.mjtJoint.mjJNT_FREE)
    has_motor = np.zeros(model.nbody, bool)
    for arm in arms:
        has_motor[model.body_rootid[arm.tip_body]] = True
    on_joint = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] in on_joint:
            has_motor[model.body_rootid[model.jnt_bodyid[model.actuator_trnid[actuator, 0]]]] = True
    of_robot = has_motor[model.body_rootid[model.dof_bodyid]]
    own = np.concatenate([arm.joint_map.dof_adr for arm in arms])
    return np.setdiff1d(np.flatnonzero(of_robot & ~free), own)


def brake(model: mujoco.MjModel, dofs: IntArray) -> None:
    """Brakes joints in place: a large armature, and no constraint that acts on braked joints alone.

    MuJoCo's solver takes its tolerance relative to the mean inertia of all joints, so the tolerance is scaled back.
    """
    held = np.zeros(model.nv, bool)
    held[dofs] = True
    inertia = model.dof_M0 + model.dof_armature
    model.opt.tolerance *= inertia.mean() / (inertia + _BRAKE_INERTIA * held).mean()
    model.dof_armature[held] = _BRAKE_INERTIA
    model.dof_frictionloss[held] = 0.0
    model.jnt_limited[held[model.jnt_dofadr]] = 0
    for tendon in range(model.ntendon):
        if held[dofs_of_tendon(model, tendon)].all():
            model.tendon_limited[tendon] = 0
            model.tendon_frictionloss[tendon] = 0.0
    for equality in range(model.neq):
        if held[dofs_of_equality(model, equality)].all():
            model.eq_active0[equality] = 0


def _friction(what: str, value: ArrayLike) -> Array:
    """Friction as a vector of one number or one for each joint."""
    values = vector(what, [value] if np.ndim(value) == 0 else value)  # type: ignore[list-item]
    if not len(values):
        raise InputError(f"{what}: expected one number, or one for each joint, got none")
    if values.min() < 0.0:
        raise InputError(f"{what}: every value must be at least 0, got {values.min():g}")
    return values


def _pushes(value: Push | Iterable[Push]) -> tuple[Push, ...]:
    """One push or several as a tuple."""
    if isinstance(value, Push):
        return (value,)
    pushes = tuple(value) if isinstance(value, Iterable) else (value,)
    for push in pushes:
        if not isinstance(push, Push):
            raise InputError(f"pushes: expected Push, got {shown(push)}; armctl.Push(0.5, 0.1, force=[0, 20, 0]) is one")
    return pushes


def _text(value: float | Array) -> str:
    """Numbers in the fewest digits that identify them."""
    texts = [f"{x:g}" if float(f"{x:g}") == x else repr(x) for x in np.ravel(value).tolist()]
    return texts[0] if len(texts) == 1 else f"[{' '.join(texts)}]"


NOMINAL = Plant()
