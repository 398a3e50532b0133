"""Gains in physical units from a bandwidth: the same closed loop on a shoulder as on a wrist."""

from __future__ import annotations

import numpy as np

from armctl.arm import Arm
from armctl.arrays import Array, frozen, number, vector
from armctl.dynamics import Dynamics

DEFAULT_BANDWIDTH = 20.0  # rad/s
_POSES = 64


def joint_inertia(arm: Arm) -> Array:
    """The inertia that each joint's motor feels when all other joints are free to move: 1 / (M^-1)_ii.

    It is the least over home and 64 poses of the arm, so gains scaled with it are stable wherever the arm is. M_ii, the inertia
    with all other joints locked, would be up to 21 times too much where joint axes are parallel.

    Args:
        arm: The arm.

    Returns:
        (n,) kg m^2.
    """
    dynamics, rng = Dynamics(arm), np.random.default_rng(0)
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    poses = [arm.home, *rng.uniform(low, high, (_POSES, arm.n))]
    return frozen(np.min([1 / np.diag(np.linalg.inv(dynamics.mass_matrix(q))) for q in poses], axis=0))


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
    inertia = joint_inertia(arm)
    if stiffness is None:
        stiffness = number("bandwidth", bandwidth, 0.0) ** 2 * inertia
    stiffness = vector("stiffness", stiffness, arm.n)
    number("least stiffness", stiffness.min(), 0.0)
    if damping is None:
        damping = 2 * number("damping_ratio", damping_ratio, 0.0) * np.sqrt(stiffness * inertia)
    damping = vector("damping", damping, arm.n)
    number("least damping", damping.min(), 0.0)
    return stiffness, damping
