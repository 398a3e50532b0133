"""ArmModel: the dynamics of an arm as a pytree."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from armctl.core import validation
from armctl.core.validation import flag, number
from armctl.robot import dynamics_kernel as kernel
from armctl.robot.arm import Arm, check_arm

_MAX_PERIOD_S = 1.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ArmModel:
    """The m joints of an arm's chain and the n driven ones among them, for one control period; a pytree.

    Every joint turns about, or slides along, the z axis of its own frame. The attributes up to `is_rubbing` are static: they
    decide what is compiled. The others are arrays, so `vmap` can map over arms that differ in them.

    Attributes:
        parents: Of each joint, the joint before it; -1 for the base.
        slides: Whether each joint is a slide.
        chain_length: The joints from the base to the tip.
        period: s, the control period in which damping is implicit; 0 for continuous time.
        half_period: s, from the start of the control period to where a plant that moves continuously is evaluated.
        is_plain: Whether no joint follows another, so m = n.
        is_lifted: Whether gravity compensation lifts a link.
        is_sprung: Whether a joint has a spring.
        is_coriolis_implicit: Whether Coriolis torques are implicit in the velocity.
        is_nonlinear_implicit: Whether any force but linear damping is implicit in the velocity.
        is_rubbing: Whether a joint has dry friction.
        rotation: (m, 3, 3), of the joint's frame in its parent's frame at position zero.
        translation: (m, 3) m, likewise.
        mass: (m,) kg.
        center: (m, 3) m, the center of mass in the joint's frame.
        inertia: (m, 3, 3) kg m^2, about the center of mass, in the axes of the joint's frame.
        lifted_mass: (m,) kg that gravity compensation lifts.
        lifted_moment: (m, 3) kg m, its first moment in the joint's frame.
        spring: (m, 3), linear, quadratic and cubic stiffness.
        spring_rest: (m,) rad, where the spring is at rest.
        ratio: (m, n), movement of a joint per movement of a driven one.
        offset: (m,) rad, position of a joint where the driven ones are at zero.
        armature: (n,) kg m^2.
        damping: (n, 3), linear, quadratic and cubic.
        implicit_damping: (n,) N m s/rad, the part of linear damping that is implicit in the velocity.
        friction: (n, 3), dry friction: loss, gain, rate.
        gravity: (3,) m/s^2.
        tip_rotation: (3, 3), of the tip in the frame of the last joint of the chain.
        tip_translation: (3,) m, likewise.
    """

    parents: tuple[int, ...] = field(metadata={"static": True})
    slides: tuple[bool, ...] = field(metadata={"static": True})
    chain_length: int = field(metadata={"static": True})
    period: float = field(metadata={"static": True})
    half_period: float = field(metadata={"static": True})
    is_plain: bool = field(metadata={"static": True})
    is_lifted: bool = field(metadata={"static": True})
    is_sprung: bool = field(metadata={"static": True})
    is_coriolis_implicit: bool = field(metadata={"static": True})
    is_nonlinear_implicit: bool = field(metadata={"static": True})
    is_rubbing: bool = field(metadata={"static": True})
    rotation: jax.Array
    translation: jax.Array
    mass: jax.Array
    center: jax.Array
    inertia: jax.Array
    lifted_mass: jax.Array
    lifted_moment: jax.Array
    spring: jax.Array
    spring_rest: jax.Array
    ratio: jax.Array
    offset: jax.Array
    armature: jax.Array
    damping: jax.Array
    implicit_damping: jax.Array
    friction: jax.Array
    gravity: jax.Array
    tip_rotation: jax.Array
    tip_translation: jax.Array


def arm_model(arm: Arm, dt: float | None = None, continuous: bool = False) -> ArmModel:
    """The dynamics of an arm as controllers know it.

    Args:
        arm: The arm.
        dt: s, the control period; 0 for continuous time, None for that of the arm's model.
        continuous: Whether the arm moves continuously during the control period; if not, the period is one step of MuJoCo.

    Returns:
        The pytree.

    Raises:
        InputError: It is no arm, or the control period is no number in [0, 1] s.
    """
    check_arm(arm)
    period = number("dt", arm.dt if dt is None else dt, 0.0, _MAX_PERIOD_S)
    return unpack(arm.packed_dynamics.vector(period, flag("continuous", continuous)), arm.n)


def unpack(vector: validation.Array, n: int) -> ArmModel:
    """The pytree of a vector of `PackedDynamics` for n driven joints."""
    m = int(vector[kernel.JOINTS])
    joints_end = kernel.HEADER + m * kernel.JOINT_COLUMNS
    drives_end = joints_end + n * kernel.DRIVE_COLUMNS
    joints = vector[kernel.HEADER : joints_end].reshape(m, kernel.JOINT_COLUMNS)
    drives = vector[joints_end:drives_end].reshape(n, kernel.DRIVE_COLUMNS)
    xx, yy, zz, xy, xz, yz = joints[:, kernel.INERTIA : kernel.INERTIA + 6].T
    inertia = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(m, 3, 3)
    return ArmModel(
        parents=tuple(joints[:, kernel.PARENT].astype(int).tolist()),
        slides=tuple((joints[:, kernel.IS_SLIDE] != 0.0).tolist()),
        chain_length=int(vector[kernel.CHAIN_LENGTH]),
        period=float(vector[kernel.STEP]),
        half_period=float(vector[kernel.HALF_STEP]),
        is_plain=bool(vector[kernel.IS_PLAIN]),
        is_lifted=bool(vector[kernel.HAS_LIFT]),
        is_sprung=bool(vector[kernel.HAS_SPRINGS]),
        is_coriolis_implicit=bool(vector[kernel.IMPLICIT_CORIOLIS]),
        is_nonlinear_implicit=bool(vector[kernel.IMPLICIT_NONLINEAR]),
        is_rubbing=bool(vector[kernel.HAS_FRICTION]),
        rotation=jnp.asarray(joints[:, kernel.PLACEMENT : kernel.PLACEMENT + 9].reshape(m, 3, 3)),
        translation=jnp.asarray(joints[:, kernel.PLACEMENT + 9 : kernel.PLACEMENT + 12]),
        mass=jnp.asarray(joints[:, kernel.MASS]),
        center=jnp.asarray(joints[:, kernel.CENTER : kernel.CENTER + 3]),
        inertia=jnp.asarray(inertia),
        lifted_mass=jnp.asarray(joints[:, kernel.LIFTED_MASS]),
        lifted_moment=jnp.asarray(joints[:, kernel.LIFTED_MOMENT : kernel.LIFTED_MOMENT + 3]),
        spring=jnp.asarray(joints[:, kernel.STIFFNESS : kernel.STIFFNESS + 3]),
        spring_rest=jnp.asarray(joints[:, kernel.SPRING_REST]),
        ratio=jnp.asarray(vector[drives_end:].reshape(m, n)),
        offset=jnp.asarray(joints[:, kernel.OFFSET]),
        armature=jnp.asarray(drives[:, kernel.ARMATURE]),
        damping=jnp.asarray(drives[:, kernel.DAMPING : kernel.DAMPING + 3]),
        implicit_damping=jnp.asarray(drives[:, kernel.IMPLICIT_DAMPING]),
        friction=jnp.asarray(drives[:, kernel.FRICTION_LOSS : kernel.FRICTION_RATE + 1]),
        gravity=jnp.asarray(vector[kernel.GRAVITY : kernel.GRAVITY + 3]),
        tip_rotation=jnp.asarray(vector[kernel.TIP : kernel.TIP + 9].reshape(3, 3)),
        tip_translation=jnp.asarray(vector[kernel.TIP + 9 : kernel.TIP + 12]),
    )
