"""Expert: a scripted policy that solves a task through the actions of an environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from armctl.core.errors import InputError
from armctl.core.pose import rotation_vector
from armctl.core.validation import Array
from armctl.envs.batch import Batch

ACTIONS = ("joint_target", "joint_delta", "cartesian_delta")


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
    wanted = batch.arm.fk(q)
    now = batch.arm.fk(target)
    way = (wanted.position - now.position) / rows.mode.position_scale
    if rows.mode.size(batch.arm) == 3:
        return way
    return np.concatenate([way, rotation_vector(wanted.rotation @ now.rotation.T) / rows.mode.rotation_scale])


def within_step(batch: Batch, action: Array) -> Array:
    """An action within [-1, 1]; deltas keep their direction."""
    if batch.action == "joint_target":
        return np.clip(action, -1.0, 1.0)
    if batch.action == "joint_delta":
        return _shortened(action)
    return np.concatenate([_shortened(part) for part in (action[:3], action[3:])])


def _shortened(action: Array) -> Array:
    return action / max(1.0, float(np.abs(action).max(initial=0.0)))


def max_turns(batch: Batch, max_lag: float, speed_share: float = 1.0) -> Array:
    """(n,) rad, how far targets may move in a step so that the references stay within `max_lag` (rad) of them.

    The reference of a joint lags behind its target by v^2 / 2a, from where it could stop. The lags differ between the
    joints, so the arm leaves its path where they are large. `speed_share` is that of the speed limits.
    """
    _, _, speed, acceleration, _ = batch.rows.limits
    return np.minimum(speed_share * speed, np.sqrt(2.0 * max_lag * acceleration)) * batch.step_time
