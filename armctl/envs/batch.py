"""Batch: several episodes of one task at once, which the single environment and the vector environment share."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError
from armctl.core.validation import BoolArray, choice, flag, instance, integer
from armctl.envs.actions import read_mode
from armctl.envs.plants import draw_plant, read_ranges
from armctl.envs.rows import Rows
from armctl.envs.tasks import Reach, reward_of
from armctl.loading.load import load
from armctl.robot.arm import Arm
from armctl.study.factors import Range

TASKS = {"Reach": Reach}
REWARDS = ("dense", "sparse")
Observations = NDArray[np.float32]


class Batch:
    """Several episodes of one task. An observation is [q, v, target - q, tip, goal, goal - tip], in rad, rad/s and m.

    Attributes:
        arm: The arm.
        task: The task.
        rows: The simulated arms.
        horizon: Steps of an episode.
        goal: (count, 3) m, the goal of each episode.
        goal_number: (count,) which of the task's goals it is.
        steps: (count,) steps since the start of each episode.
    """

    def __init__(
        self,
        robot: str | os.PathLike[str] | Arm,
        task: str,
        action: str,
        count: int,
        *,
        threads: int = 1,
        controller: str = "computed-torque",
        ticks: int = 25,
        horizon: int = 50,
        free_space: bool = True,
        randomize: Mapping[str, Range] | None = None,
        reward: str = "dense",
    ):
        """Episodes that wait for `reset`; the arguments are those of `ArmVectorEnv`."""
        instance("robot", robot, (str, os.PathLike, Arm), "'panda' or armctl.load('panda') is one")
        self.arm = robot if isinstance(robot, Arm) else load(robot)
        mode = read_mode(action)
        free_space = flag("free_space", free_space)
        count = integer("num_envs", count, 1)
        threads = min(integer("threads", threads, 1), count)
        self._ranges = read_ranges(randomize, free_space)
        self._is_sparse = choice("reward", reward, REWARDS) == "sparse"
        self.horizon = integer("horizon", horizon, 1)
        self.rows = Rows(self.arm, mode, controller, count, integer("ticks", ticks, 1), threads, free_space)
        self.task = TASKS[choice("task", task, TASKS)](self.arm, self.rows.limits[0], self.rows.limits[1])
        self.goal = np.zeros((count, 3))
        self.goal_number = np.zeros(count, np.int64)
        self.steps = np.zeros(count, np.int64)
        n = self.arm.n
        self._observation = np.zeros((count, 3 * n + 9))
        self._parts = [self._observation[:, at : at + n] for at in (0, n, 2 * n)]
        self._parts += [self._observation[:, at : at + 3] for at in (3 * n, 3 * n + 3, 3 * n + 6)]

    @property
    def observation_size(self) -> int:
        """The numbers of an observation."""
        return self._observation.shape[1]

    def reset(self, which: Iterable[int], rngs: Iterable[np.random.Generator]) -> None:
        """Starts new episodes.

        Args:
            which: The rows.
            rngs: For each of them, what everything is drawn from.
        """
        chosen = []
        for row, rng in zip(which, rngs, strict=True):
            start, goal = self.task.draw(rng)
            self.rows.reset(row, start, draw_plant(self._ranges, rng))
            self.goal_number[row] = goal
            chosen.append(row)
        self.goal[chosen] = self.task.goals[self.goal_number[chosen]]
        self.steps[chosen] = 0
        self.rows.find_tips(chosen)

    def step(self, actions: Any) -> None:
        """Steps all episodes.

        Args:
            actions: (count, k) in [-1, 1].

        Raises:
            InputError: The actions have another shape.
        """
        given = np.asarray(actions)
        if given.shape != self.rows.action.shape:
            raise InputError(f"action: expected shape {self.rows.action.shape}, got {given.shape}")
        self.rows.action[:] = given
        self.rows.step()
        self.steps += 1

    def observe(self) -> Observations:
        """(count, size) the observations now, as a new array."""
        rows = self.rows
        tip = rows.tip[:, :3]
        q, v, way, place, goal, rest = self._parts
        q[:] = rows.q
        v[:] = rows.v
        np.subtract(rows.target, rows.q, out=way)
        place[:] = tip
        goal[:] = self.goal
        np.subtract(self.goal, tip, out=rest)
        return self._observation.astype(np.float32)

    def evaluate(self, observations: Observations) -> tuple[NDArray[np.floating], BoolArray, NDArray[np.floating]]:
        """Reward, success and distance (m) of observations, as their goals would give them."""
        at = 3 * self.arm.n
        return self.reward(observations[:, at : at + 3], observations[:, at + 3 : at + 6])

    def reward(
        self, achieved: NDArray[Any], desired: NDArray[Any]
    ) -> tuple[NDArray[np.floating], BoolArray, NDArray[np.floating]]:
        """Reward, success and distance (m) of tips (..., 3) at goals (..., 3)."""
        distance = np.linalg.norm(np.subtract(achieved, desired, dtype=np.float64), axis=-1)
        success = distance < self.task.tolerance
        return reward_of(distance, success, is_sparse=self._is_sparse), success, distance
