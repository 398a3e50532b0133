"""Gains in physical units from a bandwidth: the same closed loop for joints of large and of small inertia."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, ModelError
from armctl.core.validation import Array, number, vector
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

DEFAULT_BANDWIDTH = 20.0  # rad/s
# Gains that do not depend on the control period are designed for this one; they are stable at twice of it.
DESIGN_PERIOD_S = 2e-3
SAMPLED_CONFIGURATIONS = 64
# rad/s^2. A motor that could accelerate its joint faster than this has a joint of negligible inertia.
MAX_MOTOR_ACCELERATION = 1000.0
# Damping x dt / inertia. Without delay the bound would be 2; a joint alone is stable with a delay of two periods at this one.
# An arm with light wrists bears less: `armctl.margins` measures it.
MAX_DAMPING_PER_PERIOD = 0.25

MAX_BANDWIDTH = 1e6  # rad/s, and the bound of damping ratios: a thousand times what any control period can use


def sample_configurations(arm: Arm) -> Array:
    """Home and 64 random configurations, always the same ones, (65, n) rad: gains are designed for all of them."""
    home = arm.limits.clamp(arm.home)
    return np.vstack([arm.home, arm.limits.random(home, SAMPLED_CONFIGURATIONS, np.random.default_rng(0))])


def effective_inertia(arm: Arm) -> Array:
    """The inertia that each motor accelerates if the other joints are free, 1 / (M^-1)_ii, (65, n) kg m^2.

    M_ii, the inertia with the other joints locked, is up to 21 times larger where joint axes are parallel.

    Args:
        arm: The arm; evaluated at `sample_configurations`.

    Raises:
        ModelError: A mass matrix is numerically singular.
    """
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    matrices = np.array([dynamics.mass_matrix(q) for q in sample_configurations(arm)])
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        raise ModelError(
            f"{arm.name}: the mass matrix is singular, so no gains follow from it; check the masses and inertias of the model"
        ) from None
    return 1 / np.diagonal(inverses, axis1=1, axis2=2)


def max_locked_inertia(arm: Arm) -> Array:
    """The largest inertia of each joint if the other joints are locked, max M_ii over `sample_configurations`, (n,) kg m^2."""
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    return np.max([np.diag(dynamics.mass_matrix(q)) for q in sample_configurations(arm)], axis=0)


def floored_inertia(arm: Arm, inertia: Array, min_inertia: Array, bandwidth: float, dt: float) -> Array:
    """Joint inertias for gain scaling, with a lower bound for joints of negligible inertia, (n,) kg m^2.

    Gains in proportion to a negligible inertia would yield to any friction or payload. The lower bound is the inertia that the
    joint's motor accelerates at 1000 rad/s^2. It is itself bounded, because the sampled damping must not remove more than a
    quarter of the joint's velocity in one control period in any configuration.

    Args:
        arm: The arm.
        inertia: (n,) kg m^2, the inertia to start from.
        min_inertia: (n,) kg m^2, the smallest inertia of the joints in any configuration; the result is at least this.
        bandwidth: rad/s, of a critically damped loop.
        dt: s, the control period.
    """
    max_factor = max(1.0, MAX_DAMPING_PER_PERIOD / max(2 * bandwidth * dt, 1e-12))
    floor = arm.limits.tau_max / MAX_MOTOR_ACCELERATION
    return np.clip(np.maximum(inertia, floor), min_inertia, max_factor * min_inertia)


def pd_gains(
    arm: Arm,
    bandwidth: float = DEFAULT_BANDWIDTH,
    damping_ratio: float = 1.0,
    stiffness: ArrayLike | None = None,
    damping: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Stiffness and damping of each joint, from a bandwidth unless given.

    Args:
        arm: The arm.
        bandwidth: rad/s, the natural frequency of each joint's closed loop.
        damping_ratio: 1 is critically damped.
        stiffness: (n,) or one number for all joints, N m/rad (Kp), instead of bandwidth^2 x inertia.
        damping: (n,) or one number for all joints, N m s/rad (Kd), instead of 2 x damping_ratio x sqrt(stiffness x inertia).

    Returns:
        Stiffness and damping, each (n,).

    Raises:
        InputError: A gain is negative, not finite or of the wrong length.
    """
    check_arm(arm)
    bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
    damping_ratio = number("damping_ratio", damping_ratio, 0.0, MAX_BANDWIDTH)
    inertia = effective_inertia(arm)
    scale = floored_inertia(arm, np.median(inertia, axis=0), inertia.min(axis=0), bandwidth, DESIGN_PERIOD_S)
    stiffness = gain("stiffness", bandwidth * bandwidth * scale if stiffness is None else stiffness, arm.n)
    damping = gain("damping", 2 * damping_ratio * np.sqrt(stiffness * scale) if damping is None else damping, arm.n)
    return stiffness, damping


def gain(name: str, value: ArrayLike, n: int) -> Array:
    """Validated gains, (n,), read-only; one number applies to all n.

    Raises:
        InputError: A gain is negative, not finite or not a number, or there are not n of them.
    """
    is_one_number = np.isscalar(value) or getattr(value, "ndim", None) == 0
    gains = vector(name, np.full(n, number(name, cast(float, value))) if is_one_number else value, n)
    if (gains < 0.0).any():
        raise InputError(f"{name}: every value must be at least 0, got {gains.min():g}")
    return gains
