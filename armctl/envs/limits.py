"""Limits of the joints of an environment: all finite, and a little within those of the arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array
from armctl.robot.arm import Arm

_DEFAULT_SPEED = 2.0  # rad/s (m/s), of a joint without a limit
_DEFAULT_ACCELERATION = 10.0
_DEFAULT_RANGE = 2.0 * np.pi  # rad (m) to both sides, of a joint without limits
_MARGIN = 1e-3  # of the range of a joint, between the stops and the targets


class JointLimits(NamedTuple):
    """Finite limits, each (n,).

    Attributes:
        low: rad, the least targets.
        high: rad, the greatest targets.
        speed: rad/s.
        acceleration: rad/s^2.
        torque: N m.
    """

    low: Array
    high: Array
    speed: Array
    acceleration: Array
    torque: Array


def joint_limits(arm: Arm) -> JointLimits:
    """The limits of an arm's joints in an environment."""
    limits = arm.limits
    low = np.where(np.isfinite(limits.q_min), limits.q_min, arm.home - _DEFAULT_RANGE)
    high = np.where(np.isfinite(limits.q_max), limits.q_max, arm.home + _DEFAULT_RANGE)
    margin = _MARGIN * (high - low)
    return JointLimits(
        low=low + margin,
        high=high - margin,
        speed=np.where(np.isfinite(limits.v_max), limits.v_max, _DEFAULT_SPEED),
        acceleration=np.where(np.isfinite(limits.a_max), limits.a_max, _DEFAULT_ACCELERATION),
        torque=limits.tau_max,
    )
