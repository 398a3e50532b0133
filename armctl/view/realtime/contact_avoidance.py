"""ContactAvoidance: whether the motions of an arm that follows live are free of contact."""

from collections.abc import Mapping

from armctl.core.validation import Array
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.plan.stream.committed_motion import LIVE_CLEARANCE_M
from armctl.plan.stream.refusal import contact_refusal
from armctl.run.execution.obstacles import Obstacles


class ContactAvoidance:
    """The obstacles as they were seen last, and how much clearance can be kept from them.

    `checker` is None while contacts are not avoided, and before the first look.
    """

    def __init__(self, obstacles: Obstacles):
        self.obstacles = obstacles
        self.is_on = True
        self.checker: CollisionChecker | None = None
        self._clearance = LIVE_CLEARANCE_M

    def look(self, held: Mapping[str, int]) -> None:
        """Looks where everything is now, with the bodies that a gripper holds, as for `Obstacles.checker`."""
        self.checker = self.obstacles.recent_checker(held) if self.is_on else None

    def set_clearance(self, q: Array) -> None:
        """Chooses the clearance of motions that begin at q, (n,) rad: half the distance there, if that is small."""
        if self.checker is None:
            return
        pair, distance = self.checker.nearest(q)
        if pair >= 0 and distance <= self._clearance:
            self._clearance = max(0.5 * distance, 0.0)
        else:
            self._clearance = min(LIVE_CLEARANCE_M, max(self._clearance, 0.5 * distance))

    def is_line_blocked(self, q: Array, goal: Array) -> bool:
        """Whether something is on the straight line of the joints to a goal, each (n,) rad."""
        return self.checker is not None and self.checker.line_hit(q, goal, self._clearance) is not None

    def refusal(self, pieces: Pieces) -> str:
        """What a motion would touch; empty if it is free."""
        refused = contact_refusal(self.checker, pieces, self._clearance)
        return "" if refused is None else refused.what
