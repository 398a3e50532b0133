"""Configurations around home at which an arm touches nothing."""

from __future__ import annotations

import numpy as np

from armctl.collision.checkers import collision_checker
from armctl.core.errors import InputError
from armctl.core.validation import Array
from armctl.envs.actions import target_limits
from armctl.robot.arm import Arm

_MAX_DRAWS = 20


def free_configurations(arm: Arm, count: int, spread: float) -> Array:
    """(count, n) rad, random configurations within a spread around home at which nothing touches, always the same.

    InputError if the arm touches something at nearly all of them.
    """
    rng = np.random.default_rng(0)
    checker = collision_checker(arm)
    limits = target_limits(arm)
    found = np.zeros((0, arm.n))
    for _ in range(_MAX_DRAWS):
        drawn = np.clip(arm.home + rng.uniform(-spread, spread, (count, arm.n)), limits.q_min, limits.q_max)
        found = np.concatenate([found, [q for q in drawn if not checker.at(q)]])[:count]
        if len(found) == count:
            return found
    raise InputError(f"robot: {arm.name:.80} touches something near home nearly everywhere; give it another home")
