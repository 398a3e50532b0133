"""Gains in physical units from a bandwidth: the same closed loop on a shoulder as on a wrist."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.validation import Array, number, vector
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

DEFAULT_BANDWIDTH = 20.0  # rad/s
GAIN_TICK = 2e-3  # s: gains that do not know the control period are made for it, and stable at twice of it
_POSES = 64
_GREATEST_ACCELERATION = 1000.0  # rad/s^2: a motor that could make more has almost no inertia to move
_DAMPING_PER_TICK = 0.25  # of a joint's velocity: bears a delay of two ticks; without one, 2 is the limit


def poses(arm: Arm) -> Array:
    """Where gains are sought: home and 64 poses of the arm, always the same ones.

    Args:
        arm: The arm.

    Returns:
        (65, n) rad.
    """
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    return np.vstack([arm.home, np.random.default_rng(0).uniform(low, high, (_POSES, arm.n))])


def joint_inertia(arm: Arm) -> Array:
    """The inertia that each joint's motor feels when all other joints are free to move: 1 / (M^-1)_ii, at `poses`.

    M_ii, the inertia with all other joints locked, would be up to 21 times too much where joint axes are parallel.

    Args:
        arm: The arm.

    Returns:
        (65, n) kg m^2.
    """
    dynamics = Dynamics(arm)
    return np.array([1 / np.diag(np.linalg.inv(dynamics.mass_matrix(q))) for q in poses(arm)])


def locked_inertia(dynamics: Dynamics) -> Array:
    """The most inertia that each joint's motor has to move: the greatest M_ii, all other joints locked, at `poses`.

    Args:
        dynamics: Of the arm.

    Returns:
        (n,) kg m^2.
    """
    return np.max([np.diag(dynamics.mass_matrix(q)) for q in poses(dynamics.arm)], axis=0)


def raised(arm: Arm, inertia: Array, least: Array, bandwidth: float, dt: float) -> Array:
    """Inertias to scale gains with: those of the joints, but a floor where a joint has almost no inertia.

    Gains in proportion to next to nothing give way to any friction or payload. The floor is what the joint's motor accelerates
    at 1000 rad/s^2. A held torque must not take more than a quarter of the joint's own speed in a tick, wherever the arm is:
    that is the ceiling.

    Args:
        arm: The arm.
        inertia: (n,) kg m^2, the inertia to start from.
        least: (n,) kg m^2, the least that the joints have anywhere.
        bandwidth: rad/s, of a critically damped loop.
        dt: s, the control period.

    Returns:
        (n,) kg m^2, at least `least`.
    """
    most = max(1.0, _DAMPING_PER_TICK / max(2 * bandwidth * dt, 1e-12))
    return np.clip(np.maximum(inertia, arm.limits.tau_max / _GREATEST_ACCELERATION), least, most * least)


def pd_gains(
    arm: Arm,
    bandwidth: float = DEFAULT_BANDWIDTH,
    damping_ratio: float = 1.0,
    stiffness: Array | None = None,
    damping: Array | None = None,
) -> tuple[Array, Array]:
    """Stiffness and damping of each joint, from a bandwidth unless given.

    Args:
        arm: The arm.
        bandwidth: rad/s, the natural frequency of each joint's closed loop.
        damping_ratio: 1 is critically damped.
        stiffness: (n,) N m/rad (the textbook's Kp), instead of bandwidth^2 x inertia.
        damping: (n,) N m s/rad (Kd), instead of 2 x damping_ratio x sqrt(stiffness x inertia).

    Returns:
        Stiffness and damping, each (n,).

    Raises:
        InputError: A gain is negative, not finite or of the wrong length.
    """
    felt = joint_inertia(arm)
    inertia = raised(arm, np.median(felt, axis=0), felt.min(axis=0), bandwidth, GAIN_TICK)
    if stiffness is None:
        stiffness = number("bandwidth", bandwidth, 0.0) ** 2 * inertia
    stiffness = gain("stiffness", stiffness, arm.n)
    if damping is None:
        damping = 2 * number("damping_ratio", damping_ratio, 0.0) * np.sqrt(stiffness * inertia)
    return stiffness, gain("damping", damping, arm.n)


def gain(what: str, value: ArrayLike, n: int) -> Array:
    """A caller's gains, checked.

    Args:
        what: The name of the argument, for the error.
        value: (n,) gains.
        n: How many there must be.

    Returns:
        (n,), read-only.

    Raises:
        InputError: A gain is negative, not finite, or there is another number of them.
    """
    checked = vector(what, value, n)
    number(f"least {what}", checked.min(), 0.0)
    return checked
