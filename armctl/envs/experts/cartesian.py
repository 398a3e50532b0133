"""CartesianExpert: moves the tip along straight lines over a table, with the tool down."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array
from armctl.envs.batch import Batch
from armctl.envs.experts.interface import Expert, max_turns
from armctl.envs.tasks.table import Table
from armctl.ik.problem import ik_chain
from armctl.ik.solve import solve_ik

_SPEED = 0.4  # reaches per second
_ACCELERATION = 1.0  # reaches per second squared
_SPEED_SHARE = 0.5  # of the speed limits of the joints
_MAX_LAG = 0.02  # rad (m), of the reference of a joint behind its target
_MAX_TURN = 0.5  # rad, of a joint in a step: more is another branch of the kinematics


class CartesianExpert(Expert):
    """A policy that commands positions of the end of the tool."""

    table: Table
    position: Array  # (3,) m, the commanded position

    def __init__(self, batch: Batch, row: int):
        super().__init__(batch, row)
        self._reach = ik_chain(self.arm).reach
        self._max_turns = max_turns(batch, _MAX_LAG, _SPEED_SHARE)

    def begin(self) -> None:
        self.position = self.end
        self._q = self.arm.limits.clamp(self.batch.rows.q[self.row])
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
