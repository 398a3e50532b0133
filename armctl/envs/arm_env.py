"""ArmEnv: one arm as an environment of Gymnasium, which is a batch of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium

from armctl.core.validation import flag, integer
from armctl.envs.batch import Batch, action_space, observation_space
from armctl.envs.pictures import Screen
from armctl.envs.tasks.task import RobotLike
from armctl.report.render.depth_camera import Camera, CameraImage, camera_names


class ArmEnv(gymnasium.Env):
    """One arm that does a task.

    Attributes:
        batch: The episode, a batch of one.
        screen: What draws pictures; None without a render mode and cameras.
        compute_reward: Only where observations have goals: a function of achieved goals and desired goals, (..., 3 K) m of K
            tips, and the information of the step or of each step, that returns (...,) rewards for hindsight replay.
        metadata: The rendering modes, in the form of Gymnasium.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        robot: RobotLike = "panda",
        task: str = "Reach",
        action: str = "cartesian_delta",
        *,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        cameras: Sequence[str | Camera] = (),
        goal_conditioned: bool = False,
        **options: Any,
    ):
        """An environment that waits for `reset`.

        Args:
            robot: An arm, or what `armctl.load` takes.
            task: "Reach", "ReachPast", "Track", "Push" or "PickPlace".
            action: "torque", "joint_delta", "joint_target", "cartesian_delta" or "cartesian_pose"; "joint_delta_smooth" and
                "cartesian_delta_smooth" also keep the jerk limits. Cartesian ones have a block of numbers for each of the arm's
                tips: 6, or 3 for its position where fewer than 6 joints move it.
            render_mode: "rgb_array" for pictures, "human" for the viewer's page.
            width: Pixels of a picture.
            height: Pixels of a picture.
            cameras: Names of cameras of the model, and `armctl.Camera` with names of their own, such as one at the wrist: what
                `see` and `save_demonstrations` take pictures with.
            goal_conditioned: Whether an observation is a dictionary with the achieved and the desired goal.
            **options: Further arguments of `ArmVectorEnv`.

        Raises:
            InputError: An argument is not possible, with the reason.
            UnknownNameError: There is no such robot, controller or attribute.
        """
        self.batch = Batch(robot, task, action, 1, **options)
        self._has_goals = flag("goal_conditioned", goal_conditioned)
        self.action_space = action_space(self.batch)
        self.observation_space = observation_space(self.batch, self._has_goals)
        # stable-baselines3 takes every environment with this attribute for one with goals.
        if self._has_goals:
            self.compute_reward = self.batch.reward
        self.render_mode = render_mode
        needs_screen = render_mode is not None or len(camera_names(cameras)) > 0
        mode = "rgb_array" if render_mode is None else render_mode
        self.screen = Screen(self.batch, mode, width, height, cameras) if needs_screen else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: What decides everything random from now on; None goes on with the old one.
            options: A dictionary with `goal`, (3,) m, of several tips by name, or a Region of which one position is drawn, or
                `start`, (n,) rad, or both; what is left out is drawn.

        Returns:
            The observation, and an empty dictionary.

        Raises:
            InputError: The seed is not an integer of at least 0, an option is not known, the tip cannot reach the goal, or the
                goal of the task moves.
            LimitError: A start outside the limits.
            UnknownNameError: A goal for a tip that the robot does not have.
        """
        super().reset(seed=None if seed is None else integer("seed", seed, 0))
        self.batch.reset((0,), (self.np_random,), options)
        observation = self.batch.observe()[0]
        self._show()
        return self._formed(observation), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Steps the environment.

        Args:
            action: (k,) in [-1, 1], of several tips one block after the other.

        Returns:
            Observation, reward, termination (never), truncation (at the horizon), and information: `is_success`,
            `distance` (m) and, if there is an obstacle, `touched`.

        Raises:
            InputError: The action has another shape, or one of its entries is not a number.
        """
        batch = self.batch
        batch.step(batch.checked_shape(action, batch.rows.action.shape[1:])[None])
        observation = batch.observe()
        rewards, found = batch.evaluate(observation)
        self._show()
        information = {name: values[0].item() for name, values in found.items()}
        truncated = bool(batch.ended[0])
        return self._formed(observation[0]), float(rewards[0]), False, truncated, information

    def render(self) -> Any:
        """The state now as a picture.

        Returns:
            (height, width, 3) if the mode is "rgb_array", else None.
        """
        return self.screen.picture() if self.screen is not None and self.render_mode == "rgb_array" else None

    def see(self) -> dict[str, CameraImage]:
        """What the cameras see now.

        Returns:
            Colour, depth and points of each of `cameras`, by its name.

        Raises:
            NotInstalledError: OpenGL is missing.
        """
        return {} if self.screen is None else {name: self.screen.see(name) for name in self.screen.cameras}

    def close(self) -> None:
        """Closes the page or the renderer."""
        self.batch.rows.close()
        if self.screen is not None:
            self.screen.close()
            self.screen = None

    def _show(self) -> None:
        if self.screen is not None and self.render_mode == "human":
            self.screen.show()

    def _formed(self, observation: Any) -> Any:
        return self.batch.observer.with_goals(observation) if self._has_goals else observation
