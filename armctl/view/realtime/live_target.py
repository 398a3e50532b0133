"""What a target that is moved live needs: a way between its places, and the end of a swing about it."""

import numpy as np

from armctl.core.pose import Pose, computed_pose, rotation_from_vector, rotation_vector
from armctl.core.validation import Array

# Differential IK may swing about the nearest pose to an orientation out of reach. It gets nowhere if, in so many seconds, the
# joints get less far than a share of their way.
_SWING_S = 0.5
_SWING_SHARE = 0.1
_MAX_GLIDE_S = 0.4  # a browser that draws slowly sends the places of a dragged target this rarely


class TargetGlide:
    """The way from one held target to the next one, which takes the time between the two."""

    def __init__(self, start: Pose):
        self._start = start
        self._elapsed = 0.0  # s since the target is what it is
        self._duration = 0.0  # s

    def begin(self, before: Pose | None) -> None:
        """A new target is taken: at once, or if it comes soon after one that was held, on the way from there."""
        if before is not None and self._elapsed <= _MAX_GLIDE_S:
            self._start = self.pose(before)
            self._duration = self._elapsed
        else:
            self._duration = 0.0
        self._elapsed = 0.0

    def pass_time(self, seconds: float) -> None:
        self._elapsed += seconds

    def pose(self, target: Pose) -> Pose:
        """The target itself, or a pose on the way there."""
        if self._elapsed >= self._duration:
            return target
        share = self._elapsed / self._duration
        start = self._start
        turn = rotation_vector(target.rotation @ start.rotation.T)
        position = start.position + share * (target.position - start.position)
        return computed_pose(position, rotation_from_vector(share * turn) @ start.rotation)


class SwingDetector:
    """Sees joints that move to and fro without getting anywhere."""

    def __init__(self, q: Array):
        self._start = q
        self._way = np.zeros(len(q))
        self._time = 0.0

    def restart(self, q: Array) -> None:
        self._start = q
        self._way = np.zeros(len(q))
        self._time = 0.0

    def swings(self, q: Array, rate: Array, interval: float) -> bool:
        """Whether the joints at q (n,) swing, as seen after each half second; they move at a rate, (n,) rad/s."""
        self._way += interval * np.abs(rate)
        self._time += interval
        if self._time < _SWING_S:
            return False
        swings = np.abs(q - self._start).max() < _SWING_SHARE * self._way.max()
        self.restart(q)
        return bool(swings)
