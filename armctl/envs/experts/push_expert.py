"""PushExpert: puts the tool behind the object, and pushes it to the goal."""

from collections.abc import Callable

import numpy as np

from armctl.core.validation import Array
from armctl.envs.batch import Batch
from armctl.envs.experts.expert import CartesianExpert, Command
from armctl.envs.tasks.push import BEHIND, PushTask

_PUSH_SPEED = 0.15  # reaches per second
_SLOWING = 3.0  # 1/s, of the speed near the goal
_CLOSE = 0.005  # m
_BACK_OFF = 0.012  # m, from the object, before the tool lines up again
_DONE = 0.007  # m, between object and goal
_AGAIN = 0.014  # m
# How far the tool may be beside the line to the goal, relative to its distance from the object before it pushes: farther, it
# backs off and lines up again; or, beyond the second number, it moves over the object.
_MAX_STROKE_OFFSET = 0.25
_MAX_LINE_UP_OFFSET = 0.7
# The heading of a stroke leans back to the line. Without friction, the angle of the tool from the line through the object's
# center grows by (1 + distance / way left) of itself per distance of the tool from the center, and less by the lean.
_STEERING = 2.0
_MAX_STEERING = 0.7  # rad


class PushExpert(CartesianExpert):
    """Moves above where it begins, lowers the tool, and pushes in strokes along the line to the goal.

    A pushed disc is unstable: a tool beside the line through its center turns it away. So a stroke ends when the tool is too
    far beside the line, and the tool lines up again.
    """

    def __init__(self, batch: Batch, row: int):
        super().__init__(batch, row)
        task = batch.task
        assert isinstance(task, PushTask)
        self.table = task.table
        self._radius = task.radius
        self._distance = task.radius + task.table.tool.radius + BEHIND + task.table.reach_over(task.height)

    def begin(self) -> None:
        super().begin()
        self._phase = self._above

    def next(self) -> Command:
        return Command(self._phase())

    def _behind(self, height: float, distance: float) -> Array:
        """(3,) m, the place of the end of the tool at a distance behind the object."""
        way = (self.goal - self.object)[:2]
        direction = way / max(float(np.linalg.norm(way)), 1e-9)
        return self.above_table(self.object[:2] - distance * direction, height)

    def _go_before(self, phase: Callable[[], Array], place: Array) -> Array:
        """Moves to a place (3,) m; a phase begins when it is reached."""
        if self.is_at(place, _CLOSE):
            self._phase = phase
        return self.go(place)

    def _above(self) -> Array:
        return self._go_before(self._down, self._behind(self.table.lift, self._distance))

    def _down(self) -> Array:
        return self._go_before(self._push, self._behind(self.table.low, self._distance))

    def _up(self) -> Array:
        return self._go_before(self._above, self.above_table(self.position, self.table.lift))

    def _rest(self) -> Array:
        if np.linalg.norm(self.goal - self.object) > _AGAIN:
            self._phase = self._up
        return self.go(self._retreat)

    def _back_off(self) -> Array:
        return self._go_before(self._line_up, self._retreat)

    def _line_up(self) -> Array:
        along, beside = self._offsets()
        if along > 0.0 or np.linalg.norm(beside) > _MAX_LINE_UP_OFFSET * self._distance:
            self._phase = self._up
        return self._go_before(self._push, self._behind(self.table.low, self._distance))

    def _push(self) -> Array:
        way = (self.goal - self.object)[:2]
        left = float(np.linalg.norm(way))
        along, beside = self._offsets()
        offset = float(np.linalg.norm(beside))
        is_beside = offset > _MAX_STROKE_OFFSET * self._distance
        # Near the goal the line turns quickly with the object, so lining up again would hit the object from the side.
        if left < (_AGAIN if is_beside else _DONE):
            self._phase = self._rest
            self._retreat = self._away(_BACK_OFF)
            return self.go(self._retreat)
        if is_beside:
            self._phase = self._back_off
            self._retreat = self._away(self._distance - float(np.hypot(along, offset)))
            return self.go(self._retreat)
        steering = (_STEERING - along / left) * beside / max(-along, self._radius)
        steering *= min(1.0, _MAX_STEERING / max(float(np.linalg.norm(steering)), 1e-9))
        speed = min(_PUSH_SPEED, _SLOWING * left / self._reach)
        return self.go(self.above_table(self.position[:2] + way - left * steering, self.table.low), speed)

    def _away(self, way: float) -> Array:
        """(3,) m, a place of the end of the tool farther from the object by a way (m)."""
        offset = (self.position - self.object)[:2]
        return self.above_table(self.position[:2] + way * offset / float(np.linalg.norm(offset)), self.table.low)

    def _offsets(self) -> tuple[float, Array]:
        """m, how far the tool is beyond the object along the line to the goal, and (2,) beside this line."""
        way = (self.goal - self.object)[:2]
        direction = way / max(float(np.linalg.norm(way)), 1e-9)
        offset = self.position[:2] - self.object[:2]
        along = float(offset @ direction)
        return along, offset - along * direction
