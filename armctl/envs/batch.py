"""Batch: several episodes of one task at once, which the single environment and the vector environment share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError
from armctl.core.validation import BoolArray, as_array, choice, flag, integer, shown
from armctl.envs.actions import read_mode
from armctl.envs.observation import Observations, Observer
from armctl.envs.randomization import Randomization
from armctl.envs.rows import Rows
from armctl.envs.source import ArmSource, Robot
from armctl.envs.tasks import TASKS
from armctl.study.factors import Range

REWARDS = ("dense", "sparse")
_MIN_HORIZON = 50


class Batch:
    """Several episodes of one task."""

    def __init__(
        self,
        robot: Robot,
        task: str,
        action: str,
        count: int,
        *,
        threads: int = 1,
        controller: str = "computed-torque",
        ticks: int = 25,
        horizon: int | None = None,
        contacts: bool | None = None,
        randomize: Mapping[str, Range] | None = None,
        reward: str = "dense",
        load_options: Mapping[str, Any] | None = None,
    ):
        """Episodes that wait for `reset`; the arguments are those of `ArmVectorEnv`."""
        mode = read_mode(action)
        task_class = TASKS[choice("task", task, TASKS)]
        needs_contacts = bool(task_class.object or task_class.obstacle)
        has_contacts = needs_contacts if contacts is None else flag("contacts", contacts)
        if needs_contacts and not has_contacts:
            raise InputError(f"contacts: {task} is about contacts, so they must be simulated; leave the argument out")
        count = integer("num_envs", count, 1)
        threads = min(integer("threads", threads, 1), count)
        ticks = integer("ticks", ticks, 1)
        self.action = action  # the name of what the actions mean
        self._is_sparse = choice("reward", reward, REWARDS) == "sparse"
        self.task = task_class(ArmSource(robot, load_options), ticks)
        self.arm = self.task.arm
        self._randomization = Randomization.read(randomize, has_object=bool(self.task.object))
        self.step_time = ticks * self.arm.dt  # s, of a step
        shortest = max(_MIN_HORIZON, int(np.ceil(self.task.min_duration / self.step_time)))
        self.horizon = shortest if horizon is None else integer("horizon", horizon, 1)  # steps of an episode
        self.rows = Rows(
            self.task,
            mode,
            controller,
            count,
            ticks=ticks,
            threads=threads,
            has_contacts=has_contacts,
            randomization=self._randomization,
        )
        self.observer = Observer(self.task, self.rows)  # what is observed
        self.goal = np.zeros((count, 3))  # (count, 3) m, the goal of each episode
        self.goal_number = np.zeros(count, np.int64)  # (count,) which of the task's goals it is
        self.obstacle = np.zeros((count, 3))  # (count, 3) m, the obstacle of each episode
        self.was_touched = np.zeros(count, bool)  # (count,) whether the obstacle was touched in this episode
        self.steps = np.zeros(count, np.int64)  # (count,) steps since the start of each episode
        self._goal_velocity = np.zeros((count, 3))

    def reset(self, which: Iterable[int], rngs: Iterable[np.random.Generator]) -> None:
        """Starts new episodes; everything of each is drawn from its generator."""
        chosen = []
        for row, rng in zip(which, rngs, strict=True):
            episode = self.task.draw(rng)
            plant = self._randomization.draw_plant(rng)
            factors = self._randomization.draw_object(rng)
            self.rows.reset(row, episode, plant, factors, rng)
            self.goal_number[row] = episode.goal
            if episode.obstacle is not None:
                self.obstacle[row] = episode.obstacle
            chosen.append(row)
        self.steps[chosen] = 0
        self.was_touched[chosen] = False
        self.rows.find_tips(chosen)
        self._move_goals()

    def step(self, actions: Any) -> None:
        """Steps all episodes by actions (count, k) in [-1, 1]; InputError if they are something else."""
        given = as_array("action", actions)
        if given.shape != self.rows.action.shape:
            raise InputError(f"action: expected shape {self.rows.action.shape}, got {given.shape}")
        if given.dtype.kind not in "fiub" or np.isnan(given).any():
            raise InputError(f"action: expected numbers in [-1, 1], got {shown(actions)}")
        self.rows.action[:] = given
        self.rows.step()
        self.steps += 1
        if self.task.moves_goal:
            self._move_goals()
        if self.task.obstacle:
            self.was_touched |= self.rows.touched > 0

    def observe(self) -> Observations:
        """(count, size) the observations now, as a new array."""
        return self.observer.observe(self.goal, self._goal_velocity, self.obstacle)

    def evaluate(self, observations: Observations) -> tuple[NDArray[np.floating], dict[str, NDArray[Any]]]:
        """The rewards (count,) of observations after a step, and the information about it."""
        touched = self.rows.touched > 0 if self.task.obstacle else False
        reward, success, distance = self.task.reward(
            self.observer.achieved(observations), self.observer.desired(observations), touched, is_sparse=self._is_sparse
        )
        information: dict[str, NDArray[Any]] = {"is_success": success, "distance": distance}
        if self.task.obstacle:
            information = {"is_success": success & ~self.was_touched, "distance": distance, "touched": np.asarray(touched)}
        return reward, information

    def reward(self, achieved: Any, desired: Any, info: Any) -> NDArray[np.floating]:
        """Rewards of goals (..., 3) that were achieved and desired, for hindsight replay.

        `info` says whether the obstacle was touched: the dictionary of a step, or one for each goal. InputError if it
        does not fit.
        """
        goals = (as_array("achieved_goal", achieved), as_array("desired_goal", desired))
        for name, goal in zip(("achieved_goal", "desired_goal"), goals, strict=True):
            if goal.dtype.kind not in "fiu" or goal.shape[-1:] != (3,):
                raise InputError(f"{name}: expected (..., 3) m, got {shown(goal)}")
        try:
            touched: Any = False
            if isinstance(info, Mapping):
                touched = np.asarray(info.get("touched", False), dtype=bool)
            elif info is not None:
                touched = np.array([each.get("touched", False) for each in info], dtype=bool)
            return self.task.reward(*goals, touched, is_sparse=self._is_sparse)[0]
        except (AttributeError, TypeError, ValueError):
            raise InputError(
                f"info: {shown(info)} does not fit goals of shapes {goals[0].shape} and {goals[1].shape}; expected the "
                "dictionary of a step, or one for each goal"
            ) from None

    @property
    def ended(self) -> BoolArray:
        """(count,) which episodes have reached their last step."""
        return self.steps >= self.horizon

    def _move_goals(self) -> None:
        """Puts the goals where they are after these steps."""
        self.goal[:] = self.task.goals_at(self.goal_number, self.steps)
        if self.task.moves_goal:
            ahead = self.task.goals_at(self.goal_number, self.steps + 1)
            np.divide(ahead - self.goal, self.step_time, out=self._goal_velocity)
