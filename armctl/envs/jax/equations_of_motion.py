"""Equations of motion of an `ArmModel`, as pure functions of JAX.

The recursions of `armctl/cpp/dynamics.hpp` become sums over the joints before a link and the links behind a joint, of spatial
velocities, accelerations and forces (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 2) in world axes. Only the
frames of the joints follow from each other in a loop, so a program is short, compiles fast, and has few steps on a GPU. The
mass matrix is the sum over the links of J^T m J, not of composite inertias, which lose digits in float32 far from the base.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np

from armctl.envs.jax.arm_model import ArmModel, checked

# Without it, GPUs and TPUs multiply float32 matrices with fewer bits.
_einsum = partial(jnp.einsum, precision="highest")
_matmul = partial(jnp.matmul, precision="highest")


class Placed(NamedTuple):
    """The joints and links of an arm at a configuration, in world axes; points are relative to the first joint's origin."""

    rotation: jax.Array  # (m, 3, 3), of the joints' frames
    angular: jax.Array  # (m, 3), angular velocity per velocity of each joint: its axis, or zero for a slide
    linear: jax.Array  # (m, 3), velocity, per velocity of each joint, of a body that it moves, at the first joint's origin
    center: jax.Array  # (m, 3) m, the centers of mass
    inertia: jax.Array  # (m, 3, 3) kg m^2, about the centers of mass
    position: jax.Array  # (m,) rad, of all joints


@checked
def mass_matrix(model: ArmModel, q: jax.Array) -> jax.Array:
    """The mass matrix with armature.

    Returns:
        (n, n) kg m^2.
    """
    return _mass_matrix(model, place(model, q))


@checked
def inverse_dynamics(model: ArmModel, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """The torque that changes the velocity by a dt over the coming control period, without dry friction.

    Args:
        model: The arm, whose `period` is dt.

    Returns:
        (n,) N m.
    """
    half = model.half_period
    if half != 0.0:
        return _smooth_torque(model, place(model, q + half * v), v + half * a, a)
    placed = place(model, q)
    tau = _smooth_torque(model, placed, v, a)
    if model.period != 0.0:
        tau = tau + model.period * (model.implicit_damping * a + _implicit_change(model, placed, v, a))
    return tau


@checked
def forward_dynamics(model: ArmModel, q: jax.Array, v: jax.Array, tau: jax.Array) -> jax.Array:
    """The acceleration that a torque causes, without dry friction: the inverse of `inverse_dynamics`.

    In discrete time this is the change of the velocity over the coming step / dt, where no force but linear damping is implicit
    in the velocity and the arm does not move continuously.

    Returns:
        (n,) rad/s^2.
    """
    placed = place(model, q)
    M = _mass_matrix(model, placed) + model.period * jnp.diag(model.implicit_damping)
    return cholesky_solve(M, tau - _smooth_torque(model, placed, v, jnp.zeros_like(v)))


@checked
def gravity(model: ArmModel, q: jax.Array) -> jax.Array:
    """The torque that holds the arm at rest, with gravity compensation and springs.

    Returns:
        (n,) N m.
    """
    still = jnp.zeros_like(q)
    return _smooth_torque(model, place(model, q), still, still)


def dry_friction(model: ArmModel, q: jax.Array, v_ref: jax.Array, a_ref: jax.Array) -> jax.Array:
    """The torque against dry friction on a reference motion, (n,) N m.

    In a discrete step, friction acts on the acceleration before implicit forces.
    """
    loss, gain, rate = model.friction.T
    half = model.half_period
    a_before = a_ref
    if half == 0.0 and model.period != 0.0:
        placed = place(model, q)
        implicit = model.implicit_damping * a_ref + _implicit_change(model, placed, v_ref, a_ref)
        a_before = a_ref + cholesky_solve(_mass_matrix(model, placed), model.period * implicit)
    return jnp.clip(gain * (a_before + rate * (v_ref + half * a_ref)), -loss, loss)


@checked
def tip_pose(model: ArmModel, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The tip in the world.

    Returns:
        Its position (3,) m, and its rotation matrix (3, 3).
    """
    rotations, origins = _frames(model, _all_positions(model, q))
    return _tip(model, rotations[model.chain_length - 1], origins[model.chain_length - 1])


@checked
def tip_jacobian(model: ArmModel, q: jax.Array) -> jax.Array:
    """The Jacobian of the tip.

    Returns:
        (6, n), linear part first, world axes, at the tip.
    """
    rotations, origins = _frames(model, _all_positions(model, q))
    position, _ = _tip(model, rotations[model.chain_length - 1], origins[model.chain_length - 1])
    angular, linear = _twists(model, rotations, origins - position)
    in_chain = (np.arange(len(model.parents)) < model.chain_length)[:, None]
    J = jnp.where(in_chain, jnp.concatenate([linear, angular], axis=1), 0.0).T
    return J if model.is_plain else _matmul(J, model.ratio)


def place(model: ArmModel, q: jax.Array) -> Placed:
    """The joints and links at q (n,)."""
    position = _all_positions(model, q)
    rotation, origin = _frames(model, position)
    origin = origin - origin[0]
    angular, linear = _twists(model, rotation, origin)
    return Placed(
        rotation=rotation,
        angular=angular,
        linear=linear,
        center=origin + _turned(rotation, model.center),
        inertia=_matmul(_matmul(rotation, model.inertia), rotation.mT),
        position=position,
    )


def cholesky_solve(M: jax.Array, b: jax.Array) -> jax.Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(M, lower=True), b)


def _moves(model: ArmModel) -> np.ndarray:
    """(m, m), [i, j] is True if joint j moves link i."""
    moves = np.eye(len(model.parents), dtype=bool)
    for i, parent in enumerate(model.parents):
        if parent >= 0:
            moves[i] |= moves[parent]
    return moves


def _turned(rotation: jax.Array, vectors: jax.Array) -> jax.Array:
    """Vectors (m, 3), each multiplied by its matrix (m, 3, 3)."""
    return _einsum("ixy,iy->ix", rotation, vectors)


def _all_positions(model: ArmModel, q: jax.Array) -> jax.Array:
    """(m,), those of all joints from those of the driven ones (n,)."""
    return q if model.is_plain else _matmul(model.ratio, q) + model.offset


def _all_rates(model: ArmModel, v: jax.Array) -> jax.Array:
    """(m,), velocities or accelerations of all joints from those of the driven ones (n,)."""
    return v if model.is_plain else _matmul(model.ratio, v)


def _frames(model: ArmModel, position: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rotations (m, 3, 3) and origins (m, 3) of the joints' frames in the world."""
    slides = np.array(model.slides)
    angle = jnp.where(slides, 0.0, position)
    cos = jnp.cos(angle)
    sin = jnp.sin(angle)
    zero = jnp.zeros_like(angle)
    turn = jnp.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
    local_rotation = _matmul(model.rotation, turn)
    local_origin = model.translation + jnp.where(slides, position, 0.0)[:, None] * model.rotation[:, :, 2]
    rotations: list[jax.Array] = []
    origins: list[jax.Array] = []
    for j, parent in enumerate(model.parents):
        if parent < 0:
            rotations.append(local_rotation[j])
            origins.append(local_origin[j])
        else:
            rotations.append(_matmul(rotations[parent], local_rotation[j]))
            origins.append(origins[parent] + _matmul(rotations[parent], local_origin[j]))
    return jnp.stack(rotations), jnp.stack(origins)


def _twists(model: ArmModel, rotation: jax.Array, origin: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Angular velocity (m, 3), and velocity (m, 3) at the point from which origins count, per velocity of each joint."""
    slides = np.array(model.slides)[:, None]
    axis = rotation[:, :, 2]
    return jnp.where(slides, 0.0, axis), jnp.where(slides, axis, jnp.cross(origin, axis))


def _tip(model: ArmModel, rotation: jax.Array, origin: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position and rotation of the tip, from the frame of the last joint of the chain."""
    return origin + _matmul(rotation, model.tip_translation), _matmul(rotation, model.tip_rotation)


def _mass_matrix(model: ArmModel, placed: Placed) -> jax.Array:
    moves = _moves(model)[:, :, None]
    linear = jnp.where(moves, placed.linear + jnp.cross(placed.angular, placed.center[:, None]), 0.0)
    angular = jnp.where(moves, placed.angular, 0.0)
    M = _einsum("ijx,ikx->jk", model.mass[:, None, None] * linear, linear)
    M = M + _einsum("ijx,ikx->jk", _matmul(angular, placed.inertia), angular)
    if not model.is_plain:
        M = _matmul(_matmul(model.ratio.T, M), model.ratio)
    return M + jnp.diag(model.armature)


def _smooth_torque(model: ArmModel, placed: Placed, v: jax.Array, a: jax.Array) -> jax.Array:
    """The torque (n,) N m in continuous time, without dry friction."""
    torques = _newton_euler(model, placed, _all_rates(model, v), _all_rates(model, a), model.gravity)
    if model.is_sprung:
        x = placed.position - model.spring_rest
        torques = torques + x * (model.spring[:, 0] + x * (model.spring[:, 1] + x * model.spring[:, 2]))
    tau = torques if model.is_plain else _matmul(model.ratio.T, torques)
    speed = jnp.abs(v)
    damping = model.damping[:, 0] + speed * (model.damping[:, 1] + speed * model.damping[:, 2])
    return tau + model.armature * a + damping * v


def _newton_euler(model: ArmModel, placed: Placed, v: jax.Array, a: jax.Array, fall: jax.Array) -> jax.Array:
    """The torques (m,) of all joints that move the links at the rates (m,) of all joints, against gravity."""
    moves = jnp.asarray(_moves(model), v.dtype)
    turning = placed.angular * v[:, None]
    shifting = placed.linear * v[:, None]
    omega = _matmul(moves, turning)
    velocity = _matmul(moves, shifting)
    # Spatial accelerations are sums over the joints before a link; a joint's twist changes as its link moves.
    alpha = _matmul(moves, placed.angular * a[:, None] + jnp.cross(omega, turning))
    change = jnp.cross(omega, shifting) + jnp.cross(velocity, turning)
    acceleration = _matmul(moves, placed.linear * a[:, None] + change)
    center = placed.center
    at_center = acceleration + jnp.cross(alpha, center) + jnp.cross(omega, velocity + jnp.cross(omega, center))
    force = model.mass[:, None] * (at_center - fall)
    moment = _turned(placed.inertia, alpha) + jnp.cross(omega, _turned(placed.inertia, omega))
    if model.is_lifted:
        # The lift acts at the center of the lifted mass; the moment is about the link's center of mass.
        force = force + model.lifted_mass[:, None] * fall
        offset = model.lifted_moment - model.lifted_mass[:, None] * model.center
        moment = moment + jnp.cross(_turned(placed.rotation, offset), fall)
    carried = _matmul(moves.T, jnp.concatenate([force, moment + jnp.cross(center, force)], axis=1))
    return jnp.sum(placed.linear * carried[:, :3] + placed.angular * carried[:, 3:], axis=1)


def _implicit_change(model: ArmModel, placed: Placed, v: jax.Array, a: jax.Array) -> jax.Array:
    """Rate at which implicit forces other than linear damping change during a step, d(force)/dv a, (n,)."""
    if not model.is_nonlinear_implicit:
        return jnp.zeros_like(a)
    change = (2.0 * model.damping[:, 1] * jnp.abs(v) + 3.0 * model.damping[:, 2] * v * v) * a
    if model.is_coriolis_implicit:
        still = jnp.zeros_like(a)

        def coriolis(velocity: jax.Array) -> jax.Array:
            return _newton_euler(model, placed, velocity, still, jnp.zeros_like(model.gravity))

        change = change + jax.jvp(coriolis, (v,), (a,))[1]
    return change
