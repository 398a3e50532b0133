"""RealTimeClock: keeps simulated time in step with wall-clock time."""

import time
from collections import deque
from typing import NamedTuple

from armctl.core.validation import number

MIN_SPEED = 1e-3
MAX_SPEED = 1e3
_MAX_LAG_S = 0.5  # a simulation that is further behind does not catch up
_MAX_SLEEP_S = 0.05  # until the clock looks whether its speed was changed
_MAX_IDLE_S = 0.05  # after a longer time without `wait`, the clock restarts: that time was spent on something else
_FACTOR_WINDOW_S = 2.0


class _Mark(NamedTuple):
    """What had been simulated at one time."""

    wall: float
    simulated: float


def checked_speed(speed: float) -> float:
    """Simulated seconds per second, in [0.001, 1000]."""
    return number("speed", speed, MIN_SPEED, MAX_SPEED)


class RealTimeClock:
    """Waits so that simulated time passes as fast as wall-clock time, times `speed`. After a delay it catches up."""

    def __init__(self, speed: float = 1.0):
        """A clock that starts now, with so many simulated seconds per second, in [0.001, 1000]."""
        self._speed = checked_speed(speed)
        self._due = time.perf_counter()
        self._simulated = 0.0
        self._marks = deque([_Mark(self._due, 0.0)])

    @property
    def speed(self) -> float:
        """Simulated seconds per second, in [0.001, 1000]."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        self._speed = checked_speed(speed)

    def restart(self) -> None:
        """Starts again, as after a pause."""
        self._due = time.perf_counter()
        self._simulated = 0.0
        self._marks = deque([_Mark(self._due, 0.0)])

    def resume(self) -> None:
        """Restarts if nothing was simulated yet, or not for a while: time spent on planning is not caught up."""
        if len(self._marks) == 1 or time.perf_counter() - self._marks[-1].wall > _MAX_IDLE_S:
            self.restart()

    def wait(self, seconds: float) -> None:
        """Sleeps until the wall clock has caught up, where the simulation went on by so many seconds since the last call.

        A speed that is set meanwhile, by another thread, counts from then on.
        """
        begun = self._due
        left = seconds
        speed = self._speed
        while True:
            if speed != self._speed:
                now = max(begun, time.perf_counter())
                left = max(0.0, left - (now - begun) * speed)
                begun = now
                speed = self._speed
            due = begun + left / speed
            remaining = due - time.perf_counter()
            if remaining <= 0:
                break
            time.sleep(min(remaining, _MAX_SLEEP_S))
        self._simulated += due - self._due
        self._due = due if remaining > -_MAX_LAG_S else due - remaining
        now = time.perf_counter()
        self._marks.append(_Mark(now, self._simulated))
        while len(self._marks) > 2 and now - self._marks[0].wall > _FACTOR_WINDOW_S:
            self._marks.popleft()

    @property
    def real_time_factor(self) -> float:
        """Share of the set speed that was achieved over the last two seconds; 1 is all of it."""
        first = self._marks[0]
        last = self._marks[-1]
        return (last.simulated - first.simulated) / (last.wall - first.wall) if last.wall > first.wall else 1.0
