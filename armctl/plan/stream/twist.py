"""A velocity of the tip as a short chunk of targets of the joints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.pose import computed_pose, rotation_from_vector
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.ik.differential import DifferentialIk

_STEP_S = 0.05  # between the targets
_STEPS = 4
MAX_TWIST = 100.0  # m/s, rad/s: no arm is as fast


class TwistTargets(NamedTuple):
    """Where the joints are while the tip has a velocity."""

    t: Array  # (K,) s from now
    q: Array  # (K, n) rad


def twist_targets(arm: Arm, ik: DifferentialIk, q: Array, linear: Array, angular: Array) -> TwistTargets:
    """The targets for a tip velocity, (3,) m/s and (3,) rad/s in world axes, from q (n,) on, for 0.2 s."""
    v = np.clip(linear, -MAX_TWIST, MAX_TWIST)
    w = np.clip(angular, -MAX_TWIST, MAX_TWIST)
    pose = arm.fk(q)
    times: Array = _STEP_S * np.arange(1.0, _STEPS + 1.0)
    targets = []
    for k in range(1, _STEPS + 1):
        turn = rotation_from_vector(w * k * _STEP_S)
        goal = computed_pose(pose.position + v * k * _STEP_S, turn @ pose.rotation)
        q = arm.limits.clamp(q + _STEP_S * ik.step(q, goal, _STEP_S))
        targets.append(q)
    return TwistTargets(times, np.array(targets))
