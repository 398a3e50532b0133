"""Laws of controllers without memory, as pure functions of JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from armctl._core import SINGULARITY_DAMPING
from armctl.control.computed_torque import ComputedTorque
from armctl.control.interface import MAX_PERIOD_S, checked_period
from armctl.control.operational_space import OperationalSpace
from armctl.control.pd import PD
from armctl.core.errors import InputError
from armctl.core.trajectory import TickReference, Trajectory, check_trajectory
from armctl.core.validation import flag, instance, integer, number
from armctl.envs.jax.arm_model import ArmModel, checked
from armctl.envs.jax.equations_of_motion import (
    cholesky_solve,
    dry_friction,
    inverse_dynamics,
    mass_matrix,
    tip_jacobian,
    tip_pose,
)

# Below this sine of half an angle, the rotation vector follows from a series: the next term is below 1e-16.
_SMALL_SINE = 1e-4


class Reference(NamedTuple):
    """Where the arm should be at a tick, or at each of many; a pytree. Its fields are those of a `Setpoint`.

    Attributes:
        q: (n,) or (ticks, n) rad.
        v: Likewise, rad/s.
        a: Likewise, rad/s^2.
        v_tick: Likewise, what a sampled velocity reads on the way, rad/s.
        a_tick: Likewise, the forward difference of v_tick, rad/s^2.
    """

    q: jax.Array
    v: jax.Array
    a: jax.Array
    v_tick: jax.Array
    a_tick: jax.Array


class PDGains(NamedTuple):
    """Gains of `pd`.

    Attributes:
        stiffness: (n,) N m/rad.
        damping: (n,) N m s/rad.
    """

    stiffness: jax.Array
    damping: jax.Array

    @classmethod
    def from_controller(cls, controller: PD, dt: float) -> PDGains:
        """The gains of a controller.

        Args:
            dt: s, the control period.

        Raises:
            InputError: It is no PD controller, or the control period is no number in [0, 1] s.
        """
        if type(controller) is not PD:
            raise InputError(f"controller: expected armctl.PD(arm), got a {type(controller).__name__:.80}")
        gains = controller.gains_at(checked_period(dt, False)[0])
        return cls(jnp.asarray(gains.stiffness), jnp.asarray(gains.damping))


class ComputedTorqueGains(NamedTuple):
    """Gains of `computed_torque`.

    Attributes:
        stiffness: (n,) 1/s^2.
        damping: (n,) 1/s.
        added_inertia: (n,) kg m^2, that the feedback adds to joints of negligible inertia.
    """

    stiffness: jax.Array
    damping: jax.Array
    added_inertia: jax.Array

    @classmethod
    def from_controller(cls, controller: ComputedTorque, dt: float) -> ComputedTorqueGains:
        """The gains of a controller.

        Args:
            controller: A computed torque controller in its discrete form.
            dt: s, the control period.

        Raises:
            InputError: It is no ComputedTorque, it has the textbook form, or the control period is no number in [0, 1] s.
        """
        if type(controller) is not ComputedTorque:
            raise InputError(f"controller: expected armctl.ComputedTorque(arm), got a {type(controller).__name__:.80}")
        if controller.form == "textbook":
            raise InputError("controller: armctl.jax needs ComputedTorque with form='discrete'")
        dt, _ = checked_period(dt, False)
        return cls(
            stiffness=jnp.full(controller.n, controller.bandwidth**2),
            damping=jnp.full(controller.n, 2 * controller.damping_ratio * controller.bandwidth),
            added_inertia=jnp.asarray(controller.added_inertia(dt)),
        )


class OperationalSpaceGains(NamedTuple):
    """Gains of `operational_space`.

    Attributes:
        stiffness: 1/s^2, of the tip.
        damping: 1/s.
        posture_stiffness: 1/s^2, of the joints in the null space.
        posture_damping: 1/s.
    """

    stiffness: jax.Array
    damping: jax.Array
    posture_stiffness: jax.Array
    posture_damping: jax.Array

    @classmethod
    def from_controller(cls, controller: OperationalSpace) -> OperationalSpaceGains:
        """The gains of a controller.

        Raises:
            InputError: It is no OperationalSpace.
        """
        instance("controller", controller, OperationalSpace, "armctl.OperationalSpace(arm) is one")
        ratio = 2.0 * controller.damping_ratio
        return cls(
            jnp.asarray(controller.bandwidth**2),
            jnp.asarray(ratio * controller.bandwidth),
            jnp.asarray(controller.posture_bandwidth**2),
            jnp.asarray(ratio * controller.posture_bandwidth),
        )


def tick_reference(trajectory: Trajectory, dt: float, ticks: int | None = None, continuous: bool = False) -> Reference:
    """A trajectory on the ticks of a controller.

    Args:
        trajectory: The motion; it stands still before 0 and after its duration.
        dt: s, the control period.
        ticks: How many ticks from t = 0 on; None for the whole motion.
        continuous: Whether the arm moves continuously between ticks.

    Returns:
        Rows for all ticks, over which `scan` goes.

    Raises:
        InputError: It is no trajectory, the control period is no number in [0, 1] s, or there is no tick.
    """
    check_trajectory(trajectory)
    period = number("dt", dt, 1e-6, MAX_PERIOD_S)
    count = round(trajectory.duration / period) + 1 if ticks is None else integer("ticks", ticks, 1)
    rows = TickReference.from_trajectory(trajectory, period, count, flag("continuous", continuous))
    return Reference(*(jnp.asarray(row) for row in rows))


@checked
def pd(gains: PDGains, q: jax.Array, v: jax.Array, reference: Reference) -> jax.Array:
    """The law of `armctl.PD`.

    Args:
        reference: That of one tick, (n,) each.

    Returns:
        (n,) N m.
    """
    return gains.stiffness * (reference.q - q) + gains.damping * (reference.v - v)


@checked
def computed_torque(model: ArmModel, gains: ComputedTorqueGains, q: jax.Array, v: jax.Array, reference: Reference) -> jax.Array:
    """The law of `armctl.ComputedTorque`, in its discrete form without integral action.

    Args:
        model: The arm as the controller knows it.
        reference: That of one tick, (n,) each.

    Returns:
        (n,) N m.
    """
    rate = reference.v_tick - v
    correction = gains.stiffness * (reference.q - q) + gains.damping * rate
    added = gains.damping * gains.added_inertia * rate
    held = (model.damping[:, 0] + gains.damping * gains.added_inertia) * jnp.sqrt(gains.stiffness) * (reference.q - q)
    return _tracking_torque(model, q, v, reference.a_tick + correction, reference) + added + held


@checked
def operational_space(
    model: ArmModel, gains: OperationalSpaceGains, q: jax.Array, v: jax.Array, reference: Reference
) -> jax.Array:
    """The law of `armctl.OperationalSpace`.

    Args:
        model: The arm as the controller knows it.
        reference: That of one tick, (n,) each.

    Returns:
        (n,) N m.
    """
    rate = reference.v_tick - v
    J = tip_jacobian(model, q)
    position, rotation = tip_pose(model, q)
    position_ref, rotation_ref = tip_pose(model, reference.q)
    with jax.default_matmul_precision("highest"):
        error = jnp.concatenate([position_ref - position, rotation_vector(rotation_ref @ rotation.T)])
        error_rate = tip_jacobian(model, reference.q) @ reference.v_tick - J @ v
        task = gains.stiffness * error + gains.damping * error_rate
        posture = gains.posture_stiffness * (reference.q - q) + gains.posture_damping * rate
        # The dynamically consistent inverse, as `control.task_space.consistent_inverse`.
        M_inv_Jt = cholesky_solve(mass_matrix(model, q), J.T)
        mobility = J @ M_inv_Jt
        damped = mobility + SINGULARITY_DAMPING**2 * jnp.trace(mobility) * jnp.eye(len(J), dtype=J.dtype)
        a = reference.a_tick + posture + M_inv_Jt @ jnp.linalg.solve(damped, task - J @ posture)
        # The velocity at which errors decay, for the damping of the joints.
        speed = jnp.sqrt(gains.posture_stiffness) * (reference.q - q)
        speed = speed + M_inv_Jt @ jnp.linalg.solve(damped, jnp.sqrt(gains.stiffness) * error - J @ speed)
    return _tracking_torque(model, q, v, a, reference) + model.damping[:, 0] * speed


def rotation_vector(R: jax.Array) -> jax.Array:
    """The rotation vector (3,) of a rotation matrix (3, 3), differentiable at the identity.

    By the quaternion: of four ways to compute it, the one that divides by its largest component is used (Shepperd, "Quaternion
    from rotation matrix", 1978).
    """
    x, y, z = jnp.diagonal(R)
    ways = jnp.stack(
        [
            jnp.stack([1.0 + x + y + z, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]),
            jnp.stack([R[2, 1] - R[1, 2], 1.0 + x - y - z, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]]),
            jnp.stack([R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1.0 - x + y - z, R[1, 2] + R[2, 1]]),
            jnp.stack([R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1.0 - x - y + z]),
        ]
    )
    quat = ways[jnp.argmax(jnp.diagonal(ways))]
    quat = jnp.where(quat[0] < 0.0, -quat, quat)
    quat = quat / jnp.sqrt(jnp.sum(quat * quat))
    w = quat[0]
    squared = jnp.sum(quat[1:] * quat[1:])
    is_small = squared < _SMALL_SINE**2
    # Both branches have finite derivatives, because `where` multiplies that of the other one by zero.
    sine = jnp.sqrt(jnp.where(is_small, 1.0, squared))
    w_safe = jnp.where(is_small, w, 1.0)
    scale = jnp.where(is_small, 2.0 / w_safe * (1.0 - squared / (3.0 * w_safe * w_safe)), 2.0 * jnp.arctan2(sine, w) / sine)
    return scale * quat[1:]


def _tracking_torque(model: ArmModel, q: jax.Array, v: jax.Array, a: jax.Array, reference: Reference) -> jax.Array:
    """Inverse dynamics, with damping and dry friction of the reference motion, as `feedforward` explains; (n,) N m."""
    tau = inverse_dynamics(model, q, v, a) + model.damping[:, 0] * (reference.v_tick - v)
    return tau + dry_friction(model, q, reference.v_tick, reference.a_tick) if model.has_dry_friction else tau
