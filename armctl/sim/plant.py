"""Plant: how the real thing differs from the model that controllers use."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, IntArray, number, vector
from armctl.mjmodel.couplings import dofs_of_equality, dofs_of_tendon
from armctl.mjmodel.edit import add_point_mass
from armctl.robot.arm import Arm

_CONTINUOUS_STEP = 2e-4  # s, less where damping stops a joint faster: Runge-Kutta bears 2.8 times of that
_BRAKE = 1e8  # kg m^2 (kg): the armature of a joint that is held; it then moves less than rounding does


@dataclass(frozen=True, eq=False)
class Push:
    """A force from outside on the tip, for a while.

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
        number("start", self.start, 0.0)
        number("duration", self.duration, 0.0)
        object.__setattr__(self, "force", vector("force", self.force, 3))
        object.__setattr__(self, "torque", vector("torque", self.torque, 3))

    @property
    def wrench(self) -> Array:
        """(6,) N and N m, force first."""
        return np.concatenate([self.force, self.torque])

    def acts(self, t: float) -> bool:
        """Whether it acts at a time.

        Args:
            t: s.

        Returns:
            True if it does.
        """
        return self.start <= t < self.start + self.duration


@dataclass(frozen=True, eq=False)
class Plant:
    """The simulated reality, as it departs from the model. The default departs in nothing.

    Attributes:
        payload: kg, a point mass held at the tip.
        payload_center: (3,) m, where it is, in the tip's frame.
        mass_scale: Factor on the masses and inertias of all moving links.
        coulomb_friction: N m of dry friction besides the model's, on each joint or (n,) for each.
        viscous_friction: N m s/rad of damping besides the model's, on each joint or (n,) for each.
        delay: Ticks by which a command comes late.
        encoder_noise: rad, standard deviation of the noise on measured positions.
        velocity_noise: rad/s, standard deviation of the noise on measured velocities.
        torque_ripple: Share of the torque by which it swings as a joint turns.
        pushes: Forces from outside, each a `Push`.
        continuous: Whether the arm moves on nearly continuously between ticks, the torque held, as a real one does (Runge-Kutta
            steps of at most 0.2 ms, less where damping is faster). Otherwise the model's own integrator makes one step a tick.
        timestep: s, the tick: control period and, unless continuous, step; None for the model's.
        rng: Seed of the noise: an integer gives every run the same; a generator goes on.
    """

    payload: float = 0.0
    payload_center: ArrayLike = (0.0, 0.0, 0.0)
    mass_scale: float = 1.0
    coulomb_friction: ArrayLike = 0.0
    viscous_friction: ArrayLike = 0.0
    delay: int = 0
    encoder_noise: float = 0.0
    velocity_noise: float = 0.0
    torque_ripple: float = 0.0
    pushes: tuple[Push, ...] = ()
    continuous: bool = False
    timestep: float | None = None
    rng: int | np.random.Generator = 0

    def __post_init__(self) -> None:
        for what in ("payload", "encoder_noise", "velocity_noise", "torque_ripple"):
            number(what, getattr(self, what), 0.0)
        number("mass_scale", self.mass_scale, 1e-3)
        object.__setattr__(self, "payload_center", vector("payload_center", self.payload_center, 3))
        for what in ("coulomb_friction", "viscous_friction"):
            checked = vector(what, np.atleast_1d(np.asarray(getattr(self, what), dtype=object)))
            number(f"least {what}", checked.min(), 0.0)
            object.__setattr__(self, what, checked)
        if self.delay != int(number("delay", self.delay, 0)):
            raise InputError(f"delay: {self.delay:g} given, a whole number of ticks wanted")
        object.__setattr__(self, "delay", int(self.delay))
        object.__setattr__(self, "pushes", (self.pushes,) if isinstance(self.pushes, Push) else tuple(self.pushes))
        if self.timestep is not None:
            number("timestep", self.timestep, 1e-6, 0.1)

    def __str__(self) -> str:
        """What differs, as tables say it; "nominal" if nothing does."""
        parts = [
            self.payload and f"payload {self.payload:g} kg",
            self.mass_scale != 1.0 and f"masses x {self.mass_scale:g}",
            (np.any(self.coulomb_friction) or np.any(self.viscous_friction)) and "friction",
            self.delay and f"delay {self.delay}",
            (self.encoder_noise or self.velocity_noise) and "noise",
            self.torque_ripple and f"ripple {self.torque_ripple:g}",
            self.pushes and f"{len(self.pushes)} pushes",
            self.continuous and "continuous",
        ]
        return ", ".join(part for part in parts if part) or "nominal"

    @property
    def disturbs(self) -> bool:
        """Whether it does anything to signals while it runs."""
        return bool(self.delay or self.encoder_noise or self.velocity_noise or self.torque_ripple or self.pushes)

    def model(self, arm: Arm, loose: IntArray | None = None) -> mujoco.MjModel:
        """The MuJoCo model of this plant.

        Args:
            arm: The arm as controllers know it.
            loose: Addresses in `MjData.qvel` of joints outside the chain that are not braked, such as a gripper's.

        Returns:
            A model of one's own, with all other joints outside the chain braked.

        Raises:
            InputError: Friction is given for another number of joints.
        """
        model = copy.copy(arm.model)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if self.timestep is not None:
            model.opt.timestep = self.timestep
        if self.mass_scale != 1.0:
            model.body_mass *= self.mass_scale
            model.body_inertia *= self.mass_scale
        if self.payload > 0.0:
            add_point_mass(model, arm.tip_body, self.payload, arm.T_body_tip.transform(self.payload_center))
        for what, column in (("coulomb_friction", model.dof_frictionloss), ("viscous_friction", model.dof_damping)):
            added = np.asarray(getattr(self, what))
            if len(added) not in (1, arm.n):
                raise InputError(f"{what}: {len(added)} numbers given, 1 or {arm.n} wanted for {arm.name}")
            column[arm.dof_adr] += added
        mujoco.mj_setConst(model, mujoco.MjData(model))
        if self.continuous:
            rate = (model.dof_damping * model.dof_invweight0)[arm.dof_adr].max()  # 1/s, at which damping stops a joint
            step = _CONTINUOUS_STEP / max(1.0, _CONTINUOUS_STEP * rate)
            model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
            model.opt.timestep /= math.ceil(model.opt.timestep / step - 1e-9)
        brake(model, held_dofs(arm) if loose is None else np.setdiff1d(held_dofs(arm), loose))
        return model


NOMINAL = Plant()


def held_dofs(arm: Arm) -> IntArray:
    """The degrees of freedom of the robot that are not the arm's: fingers, other limbs, wheels.

    Args:
        arm: The arm.

    Returns:
        Their addresses in `MjData.qvel`. Free objects of the scene are not among them.
    """
    model = arm.model
    free = model.jnt_type[model.dof_jntid] == int(mujoco.mjtJoint.mjJNT_FREE)
    has_motor = np.zeros(model.nbody, bool)
    has_motor[model.body_rootid[arm.tip_body]] = True
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
            has_motor[model.body_rootid[model.jnt_bodyid[model.actuator_trnid[actuator, 0]]]] = True
    of_robot = has_motor[model.body_rootid[model.dof_bodyid]]
    return np.setdiff1d(np.flatnonzero(of_robot & ~free), arm.joint_map.dof_adr)


def brake(model: mujoco.MjModel, dofs: IntArray) -> None:
    """Holds joints where they are, in place: so much armature that no force moves them, and no constraint among them.

    MuJoCo's solver takes its tolerance relative to the mean inertia of all joints, so that is scaled back to what it was.

    Args:
        model: The model to change.
        dofs: Addresses of the joints in `MjData.qvel`.
    """
    held = np.zeros(model.nv, bool)
    held[dofs] = True
    inertia = model.dof_M0 + model.dof_armature
    model.opt.tolerance *= inertia.mean() / (inertia + _BRAKE * held).mean()
    model.dof_armature[held] = _BRAKE
    model.dof_frictionloss[held] = 0.0
    model.jnt_limited[held[model.jnt_dofadr]] = 0
    for tendon in range(model.ntendon):
        if held[dofs_of_tendon(model, tendon)].all():
            model.tendon_limited[tendon] = 0
            model.tendon_frictionloss[tendon] = 0.0
    for equality in range(model.neq):
        if held[dofs_of_equality(model, equality)].all():
            model.eq_active0[equality] = 0
