"""Steps of DifferentialIk towards targets by tip, within limits of position, speed and acceleration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl._core import StepEnd
from armctl.core.tip_targets import TipTargets
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.ik.tree_problem import TreeTask, TreeTasks, read_tasks


class Posture(NamedTuple):
    """Where the joints go as far as the tips leave them free."""

    q: Array  # (n,) rad
    gain: float  # 1/s
    weight: float  # of it while tips are away from their targets


class TreeSteps:
    """What follows targets by tip, step by step. Tips that stay are held where they were when they began to stay."""

    def __init__(self, arm: Arm, posture: Posture, polygon: Array):
        self._arm = arm
        self.posture = posture
        self._polygon = polygon
        self._solvers: dict[tuple, TreeTasks] = {}  # by what the targets are, without their numbers
        self._held: dict[str, Array] = {}  # (12,) the poses of tips that stay
        self.v = np.zeros(arm.n)

    def step(self, q: Array, targets: TipTargets, dt: float, free_axis: str | None) -> tuple[Array, bool]:
        """The velocity (n,) for the next dt from q (n,) after the last one, and whether exact targets hold at its end."""
        tasks = read_tasks(self._arm, targets, free_axis)
        solver = self._solver(tasks)
        goals = np.array([task.numbers for task in tasks])
        self._hold(solver, q, tasks, goals)
        v = np.empty(self._arm.n)
        end = solver.core.step(goals, q, self.v, dt, *self.posture, v)
        self.v = v
        return v, end == StepEnd.SOLVED

    def _solver(self, tasks: list[TreeTask]) -> TreeTasks:
        kind = tuple(task[:-1] for task in tasks)
        solver = self._solvers.get(kind)
        if solver is None:
            solver = TreeTasks(self._arm, tasks, self._polygon)
            self._solvers[kind] = solver
        return solver

    def _hold(self, solver: TreeTasks, q: Array, tasks: list[TreeTask], goals: Array) -> None:
        """Writes where tips stay into the goals (T, 12)."""
        staying = {task.tip: row for row, task in enumerate(tasks) if task.stays}
        if staying.keys() != self._held.keys():
            frames = solver.frames(q)
            held = self._held
            self._held = {tip: held[tip] if tip in held else frames[row] for tip, row in staying.items()}
        for tip, row in staying.items():
            goals[row] = self._held[tip]
