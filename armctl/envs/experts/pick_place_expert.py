"""PickPlaceExpert: grasps the object and carries it to the goal."""

import numpy as np

from armctl.core.validation import Array
from armctl.envs.batch import Batch
from armctl.envs.experts.expert import CartesianExpert, Command
from armctl.envs.tasks.pick_place import PickPlace

_LOWERING_SPEED = 0.2  # reaches per second
_CARRYING_SPEED = 0.25
_CLOSE = 0.004  # m
_STILL = 2e-3  # change of the opening in a step, below which the gripper has closed
_MIN_CLOSING_TIME = 0.3  # s
_LOST = 0.5  # heights of the object, between it and where the gripper holds it


class PickPlaceExpert(CartesianExpert):
    """Moves above the object, lowers the open gripper, closes it, and carries the object to the goal."""

    def __init__(self, batch: Batch, row: int):
        super().__init__(batch, row)
        task = batch.task
        assert isinstance(task, PickPlace)
        self.table = task.table
        self._height = task.height
        self._grasp = task.grasp
        self._phase = self._above
        self._opening = 1.0
        self._closing_steps = 0
        self._last_opening = 1.0
        self._held_at = np.zeros(3)  # (3,) m, the object in the gripper when it closed, from the end of the tool

    def begin(self) -> None:
        super().begin()
        self._phase = self._above
        self._opening = 1.0

    def next(self) -> Command:
        return Command(self._phase(), self._opening)

    def _around_object(self, height: float) -> Array:
        """(3,) m, the place of the end of the tool at which the object is in the middle between the jaws."""
        return self.above_table(self.object - self.rotation @ self._grasp, height)

    def _above(self) -> Array:
        self._opening = 1.0
        place = self._around_object(self.table.lift)
        if self.is_at(place, _CLOSE):
            self._phase = self._down
        return self.go(place)

    def _down(self) -> Array:
        place = self._around_object(self.table.low)
        if self.is_at(place, _CLOSE):
            self._phase = self._close
            self._closing_steps = 0
            self._last_opening = 1.0
        return self.go(place, _LOWERING_SPEED)

    def _close(self) -> Array:
        self._opening = 0.0
        self._closing_steps += 1
        now = float(self.batch.rows.opening[self.row])
        is_still = abs(now - self._last_opening) < _STILL
        self._last_opening = now
        if is_still and self._closing_steps * self.batch.step_time > _MIN_CLOSING_TIME:
            self._phase = self._carry
            self._held_at = self.object - self.end
        return self.go(self.position)

    def _carry(self) -> Array:
        held_at = self.object - self.end
        if np.linalg.norm(held_at - self._held_at) > _LOST * self._height:
            self._phase = self._above
        return self.go(self.goal - held_at, _CARRYING_SPEED)
