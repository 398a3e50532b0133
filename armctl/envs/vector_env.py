"""ArmVectorEnv: many arms in one compiled step, as a vector environment of Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector.utils import batch_space

from armctl.core.errors import InputError
from armctl.core.validation import flag, integer, shown
from armctl.envs.batch import Batch, action_space, observation_space
from armctl.envs.tasks.task import RobotLike
from armctl.lab.study.factors import Range


class ArmVectorEnv(gymnasium.vector.VectorEnv):
    """Many arms that do one task, in one compiled step on several threads.

    Row k of a batch with seed s is, bit for bit, the single environment with seed s + k. An episode that ends is reset in the
    same step: the observation is that of the next episode, and `info["final_obs"]` has the last one of the old.

    Attributes:
        metadata: The autoreset mode and the rendering modes, in the form of Gymnasium.
    """

    metadata = {"render_modes": [], "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        robot: RobotLike = "panda",
        task: str = "Reach",
        action: str = "cartesian_delta",
        num_envs: int = 1,
        threads: int = 1,
        *,
        controller: str = "computed-torque",
        ticks: int = 25,
        horizon: int | None = None,
        contacts: bool | None = None,
        randomize: Mapping[str, Range] | None = None,
        reward: str = "dense",
        goal_conditioned: bool = False,
        load_options: Mapping[str, Any] | None = None,
        gate: bool = False,
    ):
        """Environments that wait for `reset`.

        Args:
            robot: What `armctl.load` takes, or, for Reach and Track, also an arm.
            task: "Reach", "ReachPast", "Track", "Push" or "PickPlace".
            action: "torque", "joint_delta", "joint_target", "cartesian_delta" or "cartesian_pose"; "joint_delta_smooth" and
                "cartesian_delta_smooth" also keep the jerk limits. Cartesian ones have a block of numbers for each of the arm's
                tips: 6, or 3 for its position where fewer than 6 joints move it.
            num_envs: How many.
            threads: On how many threads; the result is the same.
            controller: The name of a controller, for all actions but torques.
            ticks: Control periods of a step.
            horizon: Steps of an episode; left out, as many as the task needs.
            contacts: Whether contacts are simulated. Left out, they are, except in Reach and Track, which have no obstacles.
            randomize: A range for attributes of the plant and of the object, such as `{"payload": armctl.Range(0.0, 0.5)}`.
            reward: "dense" or "sparse".
            goal_conditioned: Whether an observation is a dictionary with the achieved and the desired goal.
            load_options: Keyword arguments of `armctl.load`, such as `{"tool": "robotiq_2f85"}`.
            gate: Whether an action passes only if the way of the joints until they rest is proved clear. Else the targets of
                the joints move a part of the way, or stay, and `info["refusal"]` says why. For Reach, ReachPast and Track, with
                joint_delta, joint_target and cartesian_delta.

        Raises:
            InputError: An argument is not possible, with the reason.
            UnknownNameError: There is no such robot, controller or attribute.
        """
        self.batch = Batch(
            robot,
            task,
            action,
            num_envs,
            threads=threads,
            controller=controller,
            ticks=ticks,
            horizon=horizon,
            contacts=contacts,
            randomize=randomize,
            reward=reward,
            load_options=load_options,
            gate=gate,
        )
        self._has_goals = flag("goal_conditioned", goal_conditioned)
        self.num_envs = len(self.batch.steps)
        self.render_mode = None
        self._is_closed = False
        self.single_action_space = action_space(self.batch)
        self.single_observation_space = observation_space(self.batch, self._has_goals)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._rngs = [np_random()[0] for _ in range(self.num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict]:
        """Starts all episodes.

        Args:
            seed: That of the first environment, the others follow; or one for each; None goes on with the old ones.
            options: "goal" and "start" of the episodes, for all environments, or one for each; a Region as the goal is one for
                all. Episodes that begin after these are drawn.

        Returns:
            The observations, and an empty dictionary.

        Raises:
            InputError: There are not as many seeds as environments, or one of them is not an integer of at least 0, or an
                option is unknown, of a wrong shape, or out of its bounds.
        """
        seeds: Sequence[int | None]
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = seed
        if isinstance(seeds, str) or not isinstance(seeds, Sequence):
            raise InputError(f"seed: expected an integer, or one for each environment, got {shown(seeds)}")
        if len(seeds) != self.num_envs:
            raise InputError(f"seed: {len(seeds)} seeds given for {self.num_envs} environments")
        for k, each in enumerate(seeds):
            if each is not None:
                self._rngs[k] = np_random(integer("seed", each, 0))[0]
        self.batch.reset(range(self.num_envs), self._rngs, options)
        return self._formed(self.batch.observe()), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all environments; ended episodes start again.

        Args:
            actions: (num_envs, k) in [-1, 1], of several tips one block after the other.

        Returns:
            Observations, rewards, terminations (never), truncations (at the horizon), and information: `is_success`,
            `distance` (m) and, if there is an obstacle, `touched` of each, and `final_obs` where an episode ended.

        Raises:
            InputError: The actions have another shape, one of them is not a number, or the environments are closed.
        """
        if self._is_closed:
            raise InputError("step: the environments are closed; make them again")
        batch = self.batch
        batch.step(actions)
        observations = batch.observe()
        rewards, found = batch.evaluate(observations)
        truncated = batch.ended
        information: dict[str, Any] = _with_masks(found, np.ones(self.num_envs, bool))
        if truncated.any():
            ended = np.flatnonzero(truncated)
            last = np.full(self.num_envs, None, dtype=object)
            for k in ended:
                last[k] = self._formed(observations[k])
            information |= {"final_obs": last, "_final_obs": truncated}
            information |= {"final_info": _with_masks(found, truncated), "_final_info": truncated}
            batch.reset(ended.tolist(), [self._rngs[k] for k in ended])
            observations = batch.observe()
        return self._formed(observations), rewards, np.zeros(self.num_envs, bool), truncated, information

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """The rewards of goals, for hindsight replay.

        Args:
            achieved_goal: (..., 3 K) m, where each of K tips, or the object, is.
            desired_goal: (..., 3 K) m.
            info: The information of the step, or of each step.

        Returns:
            (...,) rewards.

        Raises:
            InputError: The goals have another shape, or the information is of another kind.
        """
        return self.batch.reward(achieved_goal, desired_goal, info)

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the threads.

        Args:
            **kwargs: Not used.
        """
        self._is_closed = True
        self.batch.rows.close()

    def _formed(self, observations: Any) -> Any:
        return self.batch.observer.with_goals(observations) if self._has_goals else observations


def _with_masks(values: Mapping[str, Any], mask: Any) -> dict[str, Any]:
    """Information of all environments in the form of Gymnasium, with masks of the environments that have it."""
    return {**values, **{f"_{name}": mask for name in values}}
