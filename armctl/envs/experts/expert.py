"""Expert: a scripted policy that solves a task through the actions of an environment."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from armctl.core.errors import InputError
from armctl.core.pose import rotation_vector
from armctl.core.validation import Array
from armctl.envs.batch import Batch
from armctl.envs.tasks.tabletop import Tabletop
from armctl.plan.ik.problem import ik_chain
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

ACTIONS = ("joint_target", "joint_delta", "cartesian_delta")
_SPEED = 0.4  # reaches per second
_ACCELERATION = 1.0  # reaches per second squared
_SPEED_SHARE = 0.5  # of the speed limits of the joints
_MAX_LAG = 0.02  # rad (m), of the reference of a joint behind its target
_MAX_TURN = 0.5  # rad, of a joint in a step: more is another branch of the kinematics


class Command(NamedTuple):
    """What an expert wants at the end of the next step."""

    q: Array  # (n,) rad, the targets of the joints
    opening: float = 1.0  # of the gripper, from closed (0) to open (1)


class Expert(ABC):
    """A scripted policy of one row of a batch. A subclass is one file and one row of `EXPERTS`."""

    def __init__(self, batch: Batch, row: int):
        """A policy that waits for the start of an episode; InputError if the actions are not those of experts."""
        self.batch = batch
        self.row = row  # which row
        self.arm = batch.arm
        if batch.action not in ACTIONS:
            raise InputError(f"action: experts act by {', '.join(ACTIONS)}, and the environment takes {batch.action}")

    @abstractmethod
    def begin(self) -> None:
        """Looks at the start of an episode."""

    @abstractmethod
    def next(self) -> Command:
        """The reference of the joints for the next step."""

    def act(self) -> Array:
        if self.batch.steps[self.row] == 0:
            self.begin()
        command = self.next()
        action = within_step(self.batch, action_towards(self.batch, self.batch.rows.target[self.row], command.q))
        if not self.batch.task.uses_gripper:
            return action
        return np.append(action, 2.0 * command.opening - 1.0)


def action_towards(batch: Batch, target: Array, q: Array) -> Array:
    """(k,) the action that moves joint targets (n,) to q (n,); beyond [-1, 1] where one step is not enough."""
    rows = batch.rows
    low, high, speed = rows.limits[:3]
    if batch.action == "joint_target":
        return 2.0 * (q - low) / (high - low) - 1.0
    if batch.action == "joint_delta":
        return (q - target) / (rows.mode.joint_scale * batch.step_time * speed)
    parts = []
    for tip, size in zip(batch.arm.tips, rows.tip_sizes, strict=True):
        wanted = batch.arm.fk(q, tip)
        now = batch.arm.fk(target, tip)
        parts.append((wanted.position - now.position) / rows.mode.position_scale)
        if size == 6:
            parts.append(rotation_vector(wanted.rotation @ now.rotation.T) / rows.mode.rotation_scale)
    return np.concatenate(parts)


def within_step(batch: Batch, action: Array) -> Array:
    """An action within [-1, 1]; deltas keep their direction."""
    if batch.action == "joint_target":
        return np.clip(action, -1.0, 1.0)
    if batch.action == "joint_delta":
        return _shortened(action)
    return np.concatenate([_shortened(part) for part in action.reshape(-1, 3)])  # positions and rotations of the tips


def _shortened(action: Array) -> Array:
    return action / max(1.0, float(np.abs(action).max(initial=0.0)))


def max_turns(batch: Batch, max_lag: float, speed_share: float = 1.0) -> Array:
    """(n,) rad, how far targets may move in a step so that the references stay within `max_lag` (rad) of them.

    The reference of a joint lags behind its target by v^2 / 2a, from where it could stop. The lags differ between the
    joints, so the arm leaves its path where they are large. `speed_share` is that of the speed limits.
    """
    _, _, speed, acceleration, _ = batch.rows.limits
    return np.minimum(speed_share * speed, np.sqrt(2.0 * max_lag * acceleration)) * batch.step_time


def next_time(batch: Batch, motion: JointTrajectory, most: Array, time: float, target: Array) -> float:
    """s, on a motion at the end of a step: one action comes there, and no joint moves by more than `most` (n,) rad."""
    turns = np.abs(motion(time + batch.step_time).q - motion(time).q)
    share = min(1.0, float(np.min(most / np.maximum(turns, 1e-9))))
    if batch.action != "joint_target":
        action = action_towards(batch, target, motion(time + share * batch.step_time).q)
        share /= max(1.0, float(np.abs(action).max()))
    return time + share * batch.step_time


class CartesianExpert(Expert):
    """A policy that commands positions of the end of the tool."""

    table: Tabletop
    position: Array  # (3,) m, the commanded position

    def __init__(self, batch: Batch, row: int):
        super().__init__(batch, row)
        self._reach = ik_chain(self.arm).reach
        self._max_turns = max_turns(batch, _MAX_LAG, _SPEED_SHARE)

    def begin(self) -> None:
        self._q = self.arm.limits.clamp(self.batch.rows.q[self.row])
        self.start_here()

    def start_here(self) -> None:
        """Begins to command positions where the end of the tool is now."""
        self.position = self.end
        self._speed = 0.0

    @property
    def rotation(self) -> Array:
        """(3, 3) of the tip."""
        return self.batch.rows.tip[self.row, 3:].reshape(3, 3)

    @property
    def end(self) -> Array:
        """(3,) m, where the end of the tool is."""
        return self.batch.rows.tip[self.row, :3] + self.rotation @ self.table.tool.end

    @property
    def object(self) -> Array:
        """(3,) m, where the object is."""
        return self.batch.rows.object[self.row, :3].copy()

    @property
    def goal(self) -> Array:
        """(3,) m, its goal."""
        return self.batch.goal[self.row].copy()

    def above_table(self, point: Array, height: float) -> Array:
        """(3,) m, a place of the end of the tool over a point, at a height above the table."""
        return np.array([point[0], point[1], self.table.center[2] + height])

    def go(self, goal: Array, speed: float = _SPEED) -> Array:
        """Moves the commanded position towards a goal (3,) m, with at most a speed in reaches per second.

        Returns the configuration (n,); the last one if there is none for the position.
        """
        way = goal - self.position
        distance = float(np.linalg.norm(way))
        acceleration = _ACCELERATION * self._reach
        step_time = self.batch.step_time
        fastest = min(speed * self._reach, np.sqrt(2.0 * acceleration * distance), self._speed + acceleration * step_time)
        moved = min(fastest * step_time, distance)
        position = self.position + (way * (moved / distance) if distance > 0.0 else 0.0)
        result = solve_ik(self.arm, self.table.pose(position), self._q, free_axis=self.table.tool.axis)
        turns = result.q - self._q
        if result.ok and np.abs(turns).max() < _MAX_TURN:
            share = min(1.0, float(np.min(self._max_turns / np.maximum(np.abs(turns), 1e-9))))
            self.position = self.position + share * (position - self.position)
            self._q = self._q + share * turns
            self._speed = share * moved / step_time
        return self._q

    def is_at(self, goal: Array, tolerance: float) -> bool:
        """Whether the commanded position and the end of the tool are at a goal (3,) m."""
        return bool(max(np.linalg.norm(goal - self.position), np.linalg.norm(goal - self.end)) < tolerance)
