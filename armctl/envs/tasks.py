"""Tasks: what the arm shall do, from which the goals of episodes, rewards and success follow."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from armctl.collision.checkers import collision_checker
from armctl.core.errors import InputError
from armctl.core.validation import Array, BoolArray
from armctl.robot.arm import Arm

_START_SPREAD = 0.1  # rad (m), of all joints around home
_GOAL_SPREAD = 0.5
_GOALS = 2048
_MAX_DRAWS = 20
_DISTANCE_WEIGHT = 5.0  # 1/m


class Reach:
    """The tip shall be at a point, which is new in each episode.

    Goals are tips of configurations around home at which nothing touches, so the arm can reach each of them.

    Attributes:
        tolerance: m from the goal that counts as success.
        goal_q: (goals, n) rad, configurations whose tips are the goals.
        goals: (goals, 3) m.
    """

    name: ClassVar[str] = "Reach"
    tolerance: ClassVar[float] = 0.02

    def __init__(self, arm: Arm, low: Array, high: Array):
        """Goals for an arm.

        Args:
            arm: The arm.
            low: (n,) rad, least positions.
            high: (n,) rad, greatest positions.

        Raises:
            InputError: The arm touches something at nearly all configurations around home.
        """
        rng = np.random.default_rng(0)
        checker = collision_checker(arm)
        self.goal_q = np.zeros((0, arm.n))
        for _ in range(_MAX_DRAWS):
            drawn = np.clip(arm.home + rng.uniform(-_GOAL_SPREAD, _GOAL_SPREAD, (_GOALS, arm.n)), low, high)
            self.goal_q = np.concatenate([self.goal_q, [q for q in drawn if not checker.at(q)]])[:_GOALS]
            if len(self.goal_q) == _GOALS:
                break
        else:
            raise InputError(f"robot: {arm.name:.80} touches something near home nearly everywhere; give it another home")
        self.goals = arm.fk_many(self.goal_q)[0]
        self._home = np.clip(arm.home, low, high)
        self._low = low
        self._high = high

    def draw(self, rng: np.random.Generator) -> tuple[Array, int]:
        """The start (n,) rad of an episode, and the index of its goal."""
        start = self._home + rng.uniform(-_START_SPREAD, _START_SPREAD, len(self._home))
        return np.clip(start, self._low, self._high), int(rng.integers(len(self.goals)))


def reward_of(distance: NDArray[np.floating], success: BoolArray, *, is_sparse: bool) -> NDArray[np.floating]:
    """The reward: 0 at the goal and -1 elsewhere if it is sparse; else 1 at the goal, less 5 for each m of distance."""
    if is_sparse:
        return success - 1.0
    return success - _DISTANCE_WEIGHT * distance
