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
    """What an expert wants at the end of the next step.

    Attributes:
        q: (n,) rad, the targets of the joints.
        opening: Of the gripper, from closed (0) to open (1).
    """

    q: Array
    opening: float = 1.0


class Expert(ABC):
    """A scripted policy of one row of a batch. A subclass is one file and one row of `EXPERTS`.

    Attributes:
        batch: The batch.
        row: Which row.
        arm: The arm.
    """

    def __init__(self, batch: Batch, row: int):
        """A policy that waits for the start of an episode.

        Args:
            batch: The batch.
            row: Which row.

        Raises:
            InputError: The actions of the batch are not those of experts.
        """
        self.batch = batch
        self.row = row
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
        """The action of the next step."""
        if self.batch.steps[self.row] == 0:
            self.begin()
        command = self.next()
        action = _action(self.batch, self.row, command.q)
        if not self.batch.task.uses_gripper:
            return action
        return np.append(action, 2.0 * command.opening - 1.0)


def _action(batch: Batch, row: int, q: Array) -> Array:
    """(k,) the action that moves the targets of the joints to q (n,), as far as one step can."""
    rows = batch.rows
    low, high, speed = rows.limits[:3]
    if batch.action == "joint_target":
        return np.clip(2.0 * (q - low) / (high - low) - 1.0, -1.0, 1.0)
    target = rows.target[row]
    if batch.action == "joint_delta":
        return _shortened((q - target) / (rows.mode.joint_scale * batch.step_time * speed))
    wanted = batch.arm.fk(q)
    now = batch.arm.fk(target)
    way = (wanted.position - now.position) / rows.mode.position_scale
    if rows.mode.size(batch.arm) == 3:
        return _shortened(way)
    turn = rotation_vector(wanted.rotation @ now.rotation.T) / rows.mode.rotation_scale
    return np.concatenate([_shortened(way), _shortened(turn)])


def _shortened(action: Array) -> Array:
    """An action within [-1, 1], in the same direction."""
    return action / max(1.0, float(np.abs(action).max()))
