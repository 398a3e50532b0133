"""ArmModel: the dynamics of an arm as a pytree."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from typing import ParamSpec, TypeVar, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from armctl.control.interface import MAX_PERIOD_S
from armctl.core.errors import InputError
from armctl.core.validation import flag, instance, number, shown
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.core_model import model_arrays

_P = ParamSpec("_P")
_R = TypeVar("_R")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ArmModel:
    """The m joints of an arm's chain and the n driven ones among them, for one control period; a pytree.

    Every joint turns about, or slides along, the z axis of its own frame. The attributes up to `has_dry_friction` are static:
    they decide what is compiled. The others are arrays, so `vmap` can map over arms that differ in them.

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
        has_dry_friction: Whether a joint has dry friction.
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
    has_dry_friction: bool = field(metadata={"static": True})
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
        dt: s, the control period; 0 for continuous time, None for that of the arm's model.
        continuous: Whether the arm moves continuously during the control period; if not, the period is one step of MuJoCo.

    Raises:
        InputError: It is no arm, or the control period is no number in [0, 1] s.
    """
    check_arm(arm)
    period = number("dt", arm.dt if dt is None else dt, 0.0, MAX_PERIOD_S)
    is_continuous = flag("continuous", continuous)
    arm.joint_map.require_no_loops()
    arrays = model_arrays(arm.model, arm.pinocchio_model)
    m, n = arrays["ratio"].shape
    is_plain = m == n
    is_nonlinear = bool(arrays["damping"][:, 1:].any())
    is_coriolis_implicit = arrays["implicit_coriolis"] and is_plain
    xx, yy, zz, xy, xz, yz = arrays["inertias"].T
    inertia = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(m, 3, 3)
    return ArmModel(
        parents=tuple(arrays["parents"].tolist()),
        slides=tuple((arrays["slides"] != 0).tolist()),
        chain_length=arrays["chain_length"],
        period=0.0 if is_continuous else period,
        half_period=0.5 * period if is_continuous else 0.0,
        is_plain=is_plain,
        is_lifted=bool(arrays["lifted_masses"].any() or arrays["lifted_moments"].any()),
        is_sprung=bool(arrays["stiffness"].any()),
        is_coriolis_implicit=is_coriolis_implicit,
        is_nonlinear_implicit=is_coriolis_implicit or (arrays["implicit_damping"] and is_nonlinear),
        has_dry_friction=bool(arrays["friction_loss"].any()),
        rotation=jnp.asarray(arrays["rotations"]),
        translation=jnp.asarray(arrays["translations"]),
        mass=jnp.asarray(arrays["masses"]),
        center=jnp.asarray(arrays["centers"]),
        inertia=jnp.asarray(inertia),
        lifted_mass=jnp.asarray(arrays["lifted_masses"]),
        lifted_moment=jnp.asarray(arrays["lifted_moments"]),
        spring=jnp.asarray(arrays["stiffness"]),
        spring_rest=jnp.asarray(arrays["spring_rest"]),
        ratio=jnp.asarray(arrays["ratio"]),
        offset=jnp.asarray(arrays["offsets"]),
        armature=jnp.asarray(arrays["armature"]),
        damping=jnp.asarray(arrays["damping"]),
        implicit_damping=jnp.asarray(arrays["damping"][:, 0] * arrays["implicit_damping"]),
        friction=jnp.asarray(np.column_stack([arrays["friction_loss"], arrays["friction_gain"], arrays["friction_rate"]])),
        gravity=jnp.asarray(arrays["gravity"]),
        tip_rotation=jnp.asarray(arrays["tip_rotation"]),
        tip_translation=jnp.asarray(arrays["tip_translation"]),
    )


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that raises InputError for arguments of other types than its annotations, and for arrays not as long as q."""
    kinds = get_type_hints(function)
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = signature.bind(*args, **kwargs).arguments
        arrays = {}
        for name, value in given.items():
            if kinds[name] is jax.Array:
                arrays[name] = value
                continue
            instance(name, value, kinds[name], f"armctl.jax has a function or {kinds[name].__name__}.of that makes one")
            if isinstance(value, tuple):  # gains, or a reference
                arrays |= {f"{name}.{field}": each for field, each in zip(kinds[name]._fields, value, strict=True)}
        for name, value in arrays.items():
            is_text = isinstance(value, np.ndarray) and value.dtype.kind not in "fiu"
            if is_text or not isinstance(value, jax.Array | np.ndarray | np.number | float | int):
                raise InputError(f"{name}: {shown(value)} is not an array of numbers; jax.numpy.asarray makes one")
        shape = given["model"].armature.shape if "model" in given else np.shape(given["q"])
        for name, value in arrays.items():
            is_one_gain = name.startswith("gains.") and np.shape(value) == ()
            if np.shape(value) != shape and not is_one_gain:
                raise InputError(f"{name}: expected an array of shape {shape}, got one of shape {np.shape(value)}")
        return function(*args, **kwargs)

    return call
