"""RealTimeClock: simulated time kept abreast of the clock on the wall."""

from __future__ import annotations

import time
from collections import deque

_HOPELESS = 0.5  # s behind: what is lost by then is not caught up
_IDLE = 0.05  # s without a wait: nothing was going on
_WINDOW = 2.0  # s that the real-time factor is taken over


class RealTimeClock:
    """Waits so that simulated time goes by as fast as time does; behind, it catches up.

    Attributes:
        speed: Simulated seconds a second.
    """

    def __init__(self, speed: float = 1.0):
        """A pace that starts now.

        Args:
            speed: Simulated seconds a second.
        """
        self.speed = speed
        self.restart()

    def restart(self) -> None:
        """Starts afresh, as after a pause."""
        self._due, self._simulated = time.perf_counter(), 0.0
        self._marks = deque([(self._due, 0.0)])

    def resume(self) -> None:
        """Starts afresh if nothing has gone on yet, or not for a while: time spent planning is not caught up."""
        if len(self._marks) == 1 or time.perf_counter() - self._marks[-1][0] > _IDLE:
            self.restart()

    def wait(self, seconds: float) -> None:
        """Sleeps until it is time.

        Args:
            seconds: Simulated since the last call.
        """
        self._due += seconds / self.speed
        self._simulated += seconds / self.speed
        left = self._due - time.perf_counter()
        if left > 0:
            time.sleep(left)
        elif left < -_HOPELESS:
            self._due -= left
        now = time.perf_counter()
        self._marks.append((now, self._simulated))
        while len(self._marks) > 2 and now - self._marks[0][0] > _WINDOW:
            self._marks.popleft()

    @property
    def real_time_factor(self) -> float:
        """How much of the wanted speed the last two seconds kept; 1 is all of it."""
        (first, begin), (last, end) = self._marks[0], self._marks[-1]
        return (end - begin) / (last - first) if last > first else 1.0
