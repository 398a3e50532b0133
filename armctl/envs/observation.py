"""Observations: which numbers an environment observes, and where they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armctl.core.validation import Array
from armctl.envs.rows import Rows
from armctl.envs.tasks.interface import Task

Observations = NDArray[np.float32]


class Observer:
    """Makes observations of all rows.

    An observation has the positions and velocities of the joints, how far their targets are, the tip, what belongs to the task
    (opening of the gripper; object, its vertical axis, its velocity, and the vector to it from the tip; obstacle and the vector
    to it; velocity of the goal), the goal, and the vector from the controlled point to the goal.
    """

    def __init__(self, task: Task, rows: Rows):
        """Observations of a task."""
        n = task.arm.n
        widths = {"q": n, "v": n, "to_target": n, "tip": 3}
        if task.uses_gripper:
            widths["opening"] = 1
        if task.object:
            widths |= {"object": 3, "object_axis": 3, "object_velocity": 3, "tip_to_object": 3}
        if task.obstacle:
            widths |= {"obstacle": 3, "tip_to_obstacle": 3}
        if task.moves_goal:
            widths["goal_velocity"] = 3
        widths |= {"goal": 3, "to_goal": 3}
        ends = np.cumsum(list(widths.values())).tolist()
        # Where each quantity is
        self.columns = {name: slice(end - width, end) for (name, width), end in zip(widths.items(), ends, strict=True)}
        self.size: int = ends[-1]  # the numbers of an observation
        self._achieved = self.columns["object" if task.object else "tip"]
        self._rows = rows
        self._numbers = np.zeros((rows.count, self.size))
        self._parts = {name: self._numbers[:, columns] for name, columns in self.columns.items()}

    def observe(self, goal: Array, goal_velocity: Array, obstacle: Array) -> Observations:
        """(count, size) the observations now, as a new array, with goals, their velocities and obstacles (count, 3) each."""
        rows = self._rows
        parts = self._parts
        tip = rows.tip[:, :3]
        measured = rows.signals.measured(rows.q)
        parts["q"][:] = measured
        parts["v"][:] = rows.v
        np.subtract(rows.target, measured, out=parts["to_target"])
        parts["tip"][:] = tip
        if "opening" in parts:
            parts["opening"][:, 0] = rows.opening
        if "object" in parts:
            parts["object"][:] = rows.object[:, :3]
            parts["object_axis"][:] = _vertical_axis(rows.object[:, 3:7])
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
        """(..., 3) m, the controlled point."""
        return observations[..., self._achieved]

    def desired(self, observations: Observations) -> Observations:
        """(..., 3) m, the goals."""
        return observations[..., self.columns["goal"]]

    def with_goals(self, observations: Observations) -> dict[str, Observations]:
        """Observations (..., size) as a dictionary, with what is achieved and what is desired."""
        return {
            "observation": observations,
            "achieved_goal": self.achieved(observations),
            "desired_goal": self.desired(observations),
        }


def _vertical_axis(quat: Array) -> Array:
    """(count, 3) the z axes of quaternions (count, 4)."""
    w, x, y, z = quat.T
    return np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)
