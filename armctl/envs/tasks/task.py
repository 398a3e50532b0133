"""Task: the base of all tasks. A task has goals, draws episodes, and defines the point that is compared with the goal."""

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError
from armctl.core.limits import Limits
from armctl.core.target import TargetLike
from armctl.core.tip_targets import TipTargets
from armctl.core.validation import Array, BoolArray, instance
from armctl.envs.actions import target_limits
from armctl.envs.tasks.tool import Grip
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.model.loading.load import load
from armctl.model.loading.scene import SceneParts

_DISTANCE_WEIGHT = 5.0  # 1/m
_TOUCH_COST = 1.0
_START_SPREAD = 0.1  # rad (m), of all joints around the start
_MAX_DRAWS = 20
RobotLike = str | os.PathLike[str] | mujoco.MjSpec | Arm


class ArmSource:
    """A robot that can be loaded, or an arm that was loaded."""

    def __init__(self, robot: RobotLike, load_options: Mapping[str, Any] | None):
        """An arm, or what `armctl.load` takes, with the keyword arguments of `armctl.load` except its scene.

        InputError for another type, a scene among the options, or options for an arm that was loaded.
        """
        instance("robot", robot, (str, os.PathLike, mujoco.MjSpec, Arm), "'panda' or armctl.load('panda') is one")
        instance("load_options", load_options or {}, Mapping, "{'tool': 'robotiq_2f85'} is one")
        self._robot = robot
        self._options = dict(load_options or {})
        if "scene" in self._options:
            raise InputError("load_options: the scene belongs to the task; give other arguments of armctl.load, such as 'tool'")
        if self._options and isinstance(robot, Arm):
            raise InputError(f"load_options: {robot.name:.80} is loaded already; give its name or file instead")

    def load(self) -> Arm:
        return self._robot if isinstance(self._robot, Arm) else load(self._robot, **self._options)

    def load_among(self, scene: SceneParts, task: str) -> Arm:
        """The arm among the objects of a task; InputError if it was loaded already."""
        if isinstance(self._robot, Arm):
            raise InputError(
                f"robot: {task} puts objects around the robot, and {self._robot.name:.80} is loaded already; give its name or "
                "file, and load_options={'tool': ...} for arguments of armctl.load"
            )
        return load(self._robot, scene=scene, **self._options)


class Episode(NamedTuple):
    """How an episode starts."""

    q: Array  # (n,) rad, the configuration
    goal: int  # which of the task's goals it has
    object: Array | None = None  # (3,) m, where the loose object is; None without one
    obstacle: Array | None = None  # (3,) m, where the obstacle is; None without one


class Task(ABC):
    """A task of an arm. A subclass is one file and one row of `TASKS`.

    Its constructor takes an `ArmSource` and the ticks of a step, loads the arm in the scene of the task, and sets those of the
    attributes that do not belong to the class.
    """

    name: ClassVar[str]  # as in `armctl/Reach-v0`
    instruction: ClassVar[str]  # the task in words, for data sets
    min_duration: ClassVar[float] = 0.0  # s, of an episode, if fifty steps are shorter
    tolerance: ClassVar[float] = 0.02  # m from the goal that counts as success
    held_fraction: ClassVar[float] = 0.0  # of an episode, at its end, in which a policy that solves the task is at the goal
    object: ClassVar[str] = ""  # the name of the loose object to move to the goal; empty for the tip
    obstacle: ClassVar[str] = ""  # the name of the body to avoid; empty for none
    uses_gripper: ClassVar[bool] = False  # whether an action has a number for the gripper
    moves_goal: ClassVar[bool] = False  # whether the goal moves during an episode
    arm: Arm
    # Its gripper, if the task uses or closes it. It is open at the start of an episode if an action has a number for it, else
    # it is closed and braked.
    grip: Grip | None = None
    start_q: Array  # (n,) rad, around which episodes start
    # (k, s, 3 K) m, positions of each goal at the steps of an episode, for each of the K tips; the last one stays
    goals: Array

    @abstractmethod
    def __init__(self, source: ArmSource, ticks: int):
        """The task for a robot."""

    def draw(self, rng: np.random.Generator) -> Episode:
        """The start of an episode: around the start of the task, with one of its goals."""
        return Episode(self.start(rng), int(rng.integers(len(self.goals))))

    @property
    def points(self) -> Array:
        """(k, 3) m, the points that a camera must show."""
        return self.goals[:, 0].reshape(-1, 3)

    def targets(self, goal: Array) -> TargetLike | TipTargets:
        """A goal (3 K,) m for inverse kinematics: by tip, of an arm with several."""
        return dict(zip(self.arm.tips, goal.reshape(-1, 3), strict=True)) if self.arm.further_tips else goal

    def start(self, rng: np.random.Generator, spread: float = _START_SPREAD) -> Array:
        """(n,) rad, a configuration around the start."""
        q = self.start_q + rng.uniform(-spread, spread, self.arm.n)
        return np.clip(q, self._limits.q_min, self._limits.q_max)

    @cached_property
    def _limits(self) -> Limits:
        return target_limits(self.arm)

    def goals_at(self, numbers: NDArray[np.int64], steps: NDArray[np.int64]) -> Array:
        """(count, 3 K) m, the goals of episodes with these goal numbers (count,) after these steps (count,)."""
        return self.goals[numbers, np.minimum(steps, self.goals.shape[1] - 1)]

    def reward(
        self, achieved: NDArray[Any], desired: NDArray[Any], touched: NDArray[Any] | bool, *, is_sparse: bool
    ) -> tuple[NDArray[np.floating], BoolArray, NDArray[np.floating]]:
        """The reward (...,) of points achieved and desired (..., 3 K), whether that is a success, and the distance in m.

        Of several tips the distance is that of the farthest one.
        The reward is 1 at the goal, less 5 for each m of distance; or, if it is sparse, 0 at the goal and -1 elsewhere.
        A step in which the obstacle is touched costs 1 more.
        """
        way = np.subtract(achieved, desired, dtype=np.float64)
        ways = way.reshape(*way.shape[:-1], -1, 3)
        distance = np.sqrt(np.vecdot(ways, ways)).max(axis=-1)
        success = distance < self.tolerance
        reward = success - 1.0 if is_sparse else success - _DISTANCE_WEIGHT * distance
        if self.obstacle:
            reward = reward - _TOUCH_COST * np.asarray(touched)
        return reward, success, distance


def tip_positions(arm: Arm, q: Array) -> Array:
    """(T, 3 K) m, the K tips of an arm at joint positions (T, n) rad."""
    return np.concatenate([arm.fk_many(q, tip)[0] for tip in arm.tips], axis=1)


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
