"""Batch: several episodes of one task at once, which the single environment and the vector environment share."""

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError, UnknownNameError, few_names
from armctl.core.pose import matrix_from_quat
from armctl.core.region import Region
from armctl.core.validation import Array, BoolArray, as_array, choice, flag, instance, integer, matrix, shown, vector
from armctl.envs.actions import ACTION_MODES
from armctl.envs.batch_simulation import BatchSimulation
from armctl.envs.randomization import Randomization
from armctl.envs.step_gate import StepGate
from armctl.envs.tasks import TASKS
from armctl.envs.tasks.task import ArmSource, RobotLike, Task
from armctl.lab.study.factors import Range
from armctl.model.collision.checkers import collision_checker
from armctl.plan.ik.solve import solve_ik

REWARDS = ("dense", "sparse")
_MAX_ACTION = 10.0  # a policy that is not trained exceeds 1; larger numbers have another unit
OPTIONS = ("goal", "start")  # of `reset`
_MIN_HORIZON = 50
_REGION_DRAWS = 20  # members of a region that are tried as goals
Observations = NDArray[np.float32]


class ObservationBuilder:
    """Makes observations of all rows.

    An observation has the positions and velocities of the joints, how far their targets are, the tip, what belongs to the task
    (opening of the gripper; object, its vertical axis, its velocity, and the vector to it from the tip; obstacle and the vector
    to it; velocity of the goal), the goal, and the vector from the controlled point to the goal. Of K tips each has its goal.
    """

    def __init__(self, task: Task, rows: BatchSimulation):
        n = task.arm.n
        points = task.goals.shape[-1]
        widths = {"q": n, "v": n, "to_target": n, "tip": points}
        if task.uses_gripper:
            widths["opening"] = 1
        if task.object:
            widths |= {"object": 3, "object_axis": 3, "object_velocity": 3, "tip_to_object": 3}
        if task.obstacle:
            widths |= {"obstacle": 3, "tip_to_obstacle": 3}
        if task.moves_goal:
            widths["goal_velocity"] = points
        widths |= {"goal": points, "to_goal": points}
        ends = np.cumsum(list(widths.values())).tolist()
        # Where each quantity is
        self.columns = {name: slice(end - width, end) for (name, width), end in zip(widths.items(), ends, strict=True)}
        self.size: int = ends[-1]  # the numbers of an observation
        self._achieved = self.columns["object" if task.object else "tip"]
        self._rows = rows
        self._numbers = np.zeros((rows.count, self.size))
        self._parts = {name: self._numbers[:, columns] for name, columns in self.columns.items()}

    def observe(self, goal: Array, goal_velocity: Array, obstacle: Array) -> Observations:
        """(count, size) the observations now, as a new array; goals and velocities are (count, 3 K), obstacles (count, 3)."""
        rows = self._rows
        parts = self._parts
        tip = rows.tip_positions
        measured = rows.signals.measured(rows.q)
        parts["q"][:] = measured
        parts["v"][:] = rows.v
        np.subtract(rows.target, measured, out=parts["to_target"])
        parts["tip"][:] = tip
        if "opening" in parts:
            parts["opening"][:, 0] = rows.opening
        if "object" in parts:
            parts["object"][:] = rows.object[:, :3]
            parts["object_axis"][:] = matrix_from_quat(rows.object[:, 3:7].T)[:, 2].T
            parts["object_velocity"][:] = rows.object[:, 7:10]
            np.subtract(rows.object[:, :3], tip, out=parts["tip_to_object"])
        if "obstacle" in parts:
            parts["obstacle"][:] = obstacle
            np.subtract(obstacle, tip, out=parts["tip_to_obstacle"])
        if "goal_velocity" in parts:
            parts["goal_velocity"][:] = goal_velocity
        parts["goal"][:] = goal
        np.subtract(goal, rows.object[:, :3] if "object" in parts else tip, out=parts["to_goal"])
        return self._numbers.astype(np.float32)

    def achieved(self, observations: Observations) -> Observations:
        """(..., 3 K) m, the controlled points."""
        return observations[..., self._achieved]

    def desired(self, observations: Observations) -> Observations:
        """(..., 3 K) m, the goals."""
        return observations[..., self.columns["goal"]]

    def with_goals(self, observations: Observations) -> dict[str, Observations]:
        """Observations (..., size) as a dictionary, with what is achieved and what is desired."""
        return {
            "observation": observations,
            "achieved_goal": self.achieved(observations),
            "desired_goal": self.desired(observations),
        }


class Batch:
    """Several episodes of one task."""

    def __init__(
        self,
        robot: RobotLike,
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
        gate: bool = False,
    ):
        """Episodes that wait for `reset`; the arguments are those of `ArmVectorEnv`."""
        mode = ACTION_MODES[choice("action", action, ACTION_MODES)]
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
        self.rows = BatchSimulation(
            self.task,
            mode,
            controller,
            count,
            ticks=ticks,
            threads=threads,
            has_contacts=has_contacts,
            randomization=self._randomization,
        )
        # The name of each number of an action
        self.action_names = [*mode.names(self.arm), *(["gripper"] if self.task.uses_gripper else [])]
        # Between the actions and the joints; None if all actions pass
        self.gate = StepGate(self.task, self.rows) if flag("gate", gate) else None
        self.observer = ObservationBuilder(self.task, self.rows)  # what is observed
        points = self.task.goals.shape[-1]
        self.goal = np.zeros((count, points))  # (count, 3 K) m, the goal of each episode, for each of K tips
        self.goal_number = np.zeros(count, np.int64)  # (count,) which of the task's goals it is
        self.obstacle = np.zeros((count, 3))  # (count, 3) m, the obstacle of each episode
        self.was_touched = np.zeros(count, bool)  # (count,) whether the obstacle was touched in this episode
        self.steps = np.zeros(count, np.int64)  # (count,) steps since the start of each episode
        self._goal_velocity = np.zeros_like(self.goal)
        self._own_goal = np.zeros_like(self.goal)  # the goal that a caller set, ...
        self._has_own_goal = np.zeros(count, bool)  # ... in these episodes

    def reset(self, which: Iterable[int], rngs: Iterable[np.random.Generator], options: object = None) -> None:
        """Starts new episodes; everything of each is drawn from its generator, except what the options of Gymnasium set."""
        chosen = []
        goal, start = self._read(options)
        for row, rng in zip(which, rngs, strict=True):
            episode = self.task.draw(rng)
            if start is not None:
                episode = episode._replace(q=start[row])
            plant = self._randomization.draw_plant(rng)
            factors = self._randomization.draw_object(rng)
            self.rows.reset(row, episode, plant, factors, rng)
            self.goal_number[row] = episode.goal
            if isinstance(goal, Region):
                self._own_goal[row] = self._drawn_from(goal, rng)
            if episode.obstacle is not None:
                self.obstacle[row] = episode.obstacle
            if self.gate is not None:
                self.gate.reset(row, episode.obstacle)
            chosen.append(row)
        self._has_own_goal[chosen] = goal is not None
        if isinstance(goal, np.ndarray):
            self._own_goal[chosen] = goal[chosen]
        self.steps[chosen] = 0
        self.was_touched[chosen] = False
        self.rows.find_tips(chosen)
        self._move_goals()

    def step(self, actions: Any) -> None:
        """Steps all episodes by actions (count, k) in [-1, 1]; InputError if they are something else."""
        given = self.checked_shape(actions, self.rows.action.shape)
        if given.dtype.kind not in "fiub" or np.isnan(given).any():
            raise InputError(f"action: expected numbers in [-1, 1], got {shown(actions)}")
        if np.abs(given).max() > _MAX_ACTION:
            raise InputError(
                f"action: {np.abs(given).max():g} is far outside [-1, 1]; degrees? The numbers of an action are shares of the "
                "range that its mode has, and those between 1 and 10 count as 1"
            )
        self.rows.action[:] = given
        if self.gate is not None:
            self.gate.admit()
        self.rows.step()
        self.steps += 1
        if self.task.moves_goal:
            self._move_goals()
        if self.task.obstacle:
            self.was_touched |= self.rows.touched > 0

    def checked_shape(self, action: Any, shape: tuple[int, ...]) -> NDArray[Any]:
        """An action, or several, as an array; InputError if it has another shape."""
        given = as_array("action", action)
        if given.shape != shape:
            sizes = zip(self.rows.tip_sizes, self.arm.tips, strict=True)
            has_blocks = self.arm.further_tips and self.rows.mode.is_cartesian
            blocks = f"; it has {few_names([f'{size} numbers for {tip}' for size, tip in sizes])}" if has_blocks else ""
            raise InputError(f"action: expected shape {shape}, got {given.shape}{blocks}")
        return given

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
        if self.gate is not None:
            information["refusal"] = np.array(self.gate.refusals)
        return reward, information

    def reward(self, achieved: Any, desired: Any, info: Any) -> NDArray[np.floating]:
        """Rewards of goals (..., 3 K) that were achieved and desired, for hindsight replay.

        `info` says whether the obstacle was touched: the dictionary of a step, or one for each goal. InputError if it
        does not fit.
        """
        goals = (as_array("achieved_goal", achieved), as_array("desired_goal", desired))
        for name, goal in zip(("achieved_goal", "desired_goal"), goals, strict=True):
            if goal.dtype.kind not in "fiu" or goal.shape[-1:] != self.goal.shape[-1:]:
                of_tips = "three of each tip, " if self.goal.shape[-1] > 3 else ""
                raise InputError(f"{name}: expected {of_tips}(..., {self.goal.shape[-1]}) m, got {shown(goal)}")
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

    def _read(self, options: object) -> tuple[Array | Region | None, Array | None]:
        """The goals (count, 3 K) m and starts (count, n) rad that the options of `reset` set, each None if they do not.

        Goals may also be a region, of which each episode draws one.
        """
        if options is None:
            return None, None
        instance("options", options, Mapping, '{"goal": [0.4, 0.1, 0.3]} is one')
        assert isinstance(options, Mapping)
        for name in options:
            if name not in OPTIONS:
                raise InputError(f"options: {shown(name)} is not known; expected {' or '.join(OPTIONS)}")
        goal: Array | Region | None = None
        if "goal" in options:
            if self.task.moves_goal:
                raise InputError(f"options: goal: that of {self.task.name} moves along a path; it cannot be set")
            goal = options["goal"]
            if not isinstance(goal, Region):
                goal = self._goals(goal)
            elif self.goal.shape[-1] != 3:
                raise InputError("options: goal: a Region is for one tip; give points by tip")
            if isinstance(goal, np.ndarray) and not self.task.object:
                self._require_reachable(goal)
        start = None
        if "start" in options:
            start = self._of_each_row("options: start", options["start"], self.arm.n)
            start = np.array([self.arm.checked("options: start", q) for q in start])
            if not (self.task.object or self.task.obstacle):  # what moves in a scene is elsewhere in each episode
                self._require_free(start)
        return goal, start

    def _goals(self, given: Any) -> Array:
        """(count, 3 K) m, goals as numbers, or by tip."""
        if not isinstance(given, Mapping):
            return self._of_each_row("options: goal", given, self.goal.shape[-1])
        tips = self.arm.tips
        for tip in given:
            if tip not in tips:
                raise UnknownNameError.from_known(f"tip of {self.arm.name:.60}", tip, tips)
        missing = [tip for tip in tips if tip not in given]
        if missing:
            raise InputError(f"options: goal: each tip needs one, and there is none for {few_names(missing)}")
        return np.concatenate([self._of_each_row("options: goal", given[tip], 3) for tip in tips], axis=1)

    def _of_each_row(self, what: str, value: Any, size: int) -> Array:
        """(count, size) numbers of an option, given for each episode or once for all."""
        count = len(self.steps)
        if as_array(what, value).ndim < 2:
            return np.broadcast_to(vector(what, value, size), (count, size))
        rows = matrix(what, value, size)
        if len(rows) != count:
            raise InputError(f"{what}: {len(rows)} rows given for {count} environments")
        return rows

    def _drawn_from(self, region: Region, rng: np.random.Generator) -> Array:
        """(3,) m, where a random member of a region is that the tip reaches, or an object is brought to."""
        for member in region.sample(_REGION_DRAWS, seed=int(rng.integers(2**31))):
            if self.task.object or solve_ik(self.arm, member.position).ok:
                return member.position
        raise InputError(
            f"options: goal: the tip reaches none of {_REGION_DRAWS} random positions of the region; bring it nearer"
        )

    def _require_reachable(self, goals: Array) -> None:
        for goal in np.unique(goals, axis=0):
            found = solve_ik(self.arm, self.task.targets(goal))
            if not found.ok:
                raise InputError(f"options: goal: {shown(goal.tolist())} m: {found.reason}")

    def _require_free(self, starts: Array) -> None:
        checker = collision_checker(self.arm)
        for start in np.unique(starts, axis=0):
            contact = checker.at(start)
            if contact:
                raise InputError(f"options: start: {shown(start.tolist())}: {contact}; choose one where nothing touches")

    def _move_goals(self) -> None:
        self.goal[:] = self.task.goals_at(self.goal_number, self.steps)
        np.copyto(self.goal, self._own_goal, where=self._has_own_goal[:, None])
        if self.task.moves_goal:
            ahead = self.task.goals_at(self.goal_number, self.steps + 1)
            np.divide(ahead - self.goal, self.step_time, out=self._goal_velocity)


def action_space(batch: Batch) -> gymnasium.spaces.Box:
    """The actions of one environment: numbers in [-1, 1]."""
    return gymnasium.spaces.Box(-1.0, 1.0, (batch.rows.action.shape[1],), np.float32)


def observation_space(batch: Batch, has_goals: bool) -> gymnasium.spaces.Space[Any]:
    """The observations of one environment, a vector or a dictionary with goals."""
    box = gymnasium.spaces.Box(-np.inf, np.inf, (batch.observer.size,), np.float32)
    if not has_goals:
        return box
    goal = gymnasium.spaces.Box(-np.inf, np.inf, batch.goal.shape[-1:], np.float32)
    return gymnasium.spaces.Dict({"observation": box, "achieved_goal": goal, "desired_goal": goal})
