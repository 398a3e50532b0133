"""The plant `Plant(free_space=True)` as a pytree, its step, and closed loops as one scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from armctl.core.errors import InputError
from armctl.jax.arm_model import ArmModel, unpack
from armctl.jax.dynamics import forward_dynamics
from armctl.robot.arm import Arm, check_arm
from armctl.sim.plant import Plant, read_plant

Law = Callable[[jax.Array, jax.Array, Any], jax.Array]


class FreePlant(NamedTuple):
    """An arm that touches nothing; a pytree. `jax.tree.map(jnp.stack)` of several gives a batch for `vmap`.

    Attributes:
        model: Its dynamics.
        torque_min: (n,) N m, least torque of the motors.
        torque_max: (n,) N m, greatest torque of the motors.
    """

    model: ArmModel
    torque_min: jax.Array
    torque_max: jax.Array


class FollowedMotion(NamedTuple):
    """What `follow` records at every tick, before its step.

    Attributes:
        q: (ticks, n) rad.
        v: (ticks, n) rad/s.
        tau: (ticks, n) N m, within the torques of the motors.
    """

    q: jax.Array
    v: jax.Array
    tau: jax.Array


def free_plant(arm: Arm, plant: Plant | None = None) -> FreePlant:
    """The plant that `Simulation(arm, plant=Plant(free_space=True))` steps, which is compared with MuJoCo's steps here.

    Neither contacts nor joint limits act on it, and nothing checks for them.

    Args:
        arm: The arm.
        plant: How it differs from the arm's model: payload, masses, viscous friction, time step. None if it does not.

    Returns:
        The pytree.

    Raises:
        InputError: It is no arm; the plant has disturbances of signals; or the arm does not move freely, because of dry
            friction, springs, coupled joints, or an integrator that is not linear in the velocity.
    """
    from armctl.sim.free_space import FreeSpace

    check_arm(arm)
    plant = read_plant(plant)
    if plant.has_signal_disturbances:
        raise InputError("plant: delay, noise, ripple and pushes are no part of the free-space plant; put them into the law")
    model = plant.model(arm)
    free = FreeSpace(arm, model, mujoco.MjData(model))
    low, high = free.bounds
    return FreePlant(unpack(free.vector, arm.n), jnp.asarray(low), jnp.asarray(high))


def free_step(
    plant: FreePlant, q: jax.Array, v: jax.Array, tau: jax.Array, applied: jax.Array | float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """One step of MuJoCo without constraints.

    Args:
        plant: The plant.
        q: (n,) rad.
        v: (n,) rad/s.
        tau: (n,) N m, of the motors, which keep within their limits.
        applied: (n,) N m of other torques on the joints.

    Returns:
        q and v after the step.
    """
    clipped = jnp.clip(tau, plant.torque_min, plant.torque_max)
    dt = plant.model.period
    v = v + dt * forward_dynamics(plant.model, q, v, clipped + applied)
    return q + dt * v, v


def follow(plant: FreePlant, law: Law, q: jax.Array, v: jax.Array, reference: Any) -> FollowedMotion:
    """Simulates a closed loop along a reference.

    Args:
        plant: The plant.
        law: A function of q, v and the reference of a tick that returns a torque, all (n,).
        q: (n,) rad, at the start.
        v: (n,) rad/s, at the start.
        reference: From `tick_reference`, (ticks, n) each; or any other pytree with a row for each tick, for a law that takes
            such rows.

    Returns:
        State and torque at every tick.
    """

    def tick(state: tuple[jax.Array, jax.Array], row: Any) -> tuple[tuple[jax.Array, jax.Array], FollowedMotion]:
        tau = jnp.clip(law(*state, row), plant.torque_min, plant.torque_max)
        return free_step(plant, *state, tau), FollowedMotion(*state, tau)

    # Reverse mode then computes the intermediate results of a tick again; to store those of all ticks is 50 times as slow.
    return jax.lax.scan(jax.checkpoint(tick, prevent_cse=False), (q, v), reference)[1]
