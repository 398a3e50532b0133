"""Player: plays motions row by row. What it holds always ends at rest, and a stop never leaves the path."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.motion.trajectory.path_stop import REST_SPEED, stopped
from armctl.motion.trajectory.piecewise import Pieces, sample, standing

JOIN_TOLERANCE = 1e-6  # rad, between the end of one motion and the start of the next; single precision is 1e-7
_NEVER = 2**60


@dataclass(frozen=True, eq=False)
class _Course:
    """A motion to rest, and its rows from a tick on."""

    at: int
    pieces: Pieces
    rows: Array

    @classmethod
    def of(cls, at: int, pieces: Pieces, dt: float) -> _Course:
        ticks = int(np.ceil(pieces.knots[-1] / dt - 1e-9))
        return cls(at, pieces, sample(pieces, dt * np.arange(ticks + 1, dtype=np.float64)).q)

    def row(self, tick: int) -> Array:
        return self.rows[min(max(tick - self.at, 0), len(self.rows) - 1)]


class Player:
    """The rows of one stream. `play` and `stop` may be called by another thread than `next`."""

    def __init__(self, q: Array, dt: float, limits: Limits, lead: int):
        """A player that stands at q. A word, such as a stop, has its effect after `lead` ticks: a stop has to be planned."""
        self.tick = -1  # the tick of the last row; -1 before the first
        self.dt = dt  # s
        self._limits = limits
        self._lead = lead
        self._lock = Lock()
        self._courses = [_Course.of(0, standing(q), dt)]  # each until the next one begins
        self._stopped_from = _NEVER

    @property
    def end(self) -> int:
        """The first tick at which it rests, if nothing changes."""
        with self._lock:
            last = self._courses[-1]
            return last.at + len(last.rows) - 1

    def next(self, ticks: int = 1) -> Array:
        """The row some ticks after the last one, (n,) rad."""
        with self._lock:
            self.tick += ticks
            while len(self._courses) > 1 and self._courses[1].at <= self.tick:
                self._courses.pop(0)
            return self._courses[0].row(self.tick)

    def play(self, pieces: Pieces, at: int | None, delay: int = 0) -> tuple[int, str]:
        """Replaces what follows a tick by a motion to rest: its first tick, and why it is not played."""
        if np.abs(sample(pieces, pieces.knots[-1:]).v).max() > REST_SPEED:
            return 0, "the motion does not end at rest"
        with self._lock:
            first = self.tick + max(self._lead, delay) if at is None else at
            if self._stopped_from <= first:
                return first, "the arm was stopped"
            if first <= self.tick:
                return first, f"the motion came {self.dt * (self.tick - first + 1):.3f} s too late"
            before = self._courses[-1]
            if first < before.at:
                return first, "the motion starts before the one that was sent last"
            course = _Course.of(first, pieces, self.dt)
            gap = float(np.abs(course.rows[0] - before.row(first)).max())
            if gap > JOIN_TOLERANCE:
                return first, f"the motion starts {gap:.2g} rad from where the last one is then"
            self._courses.append(course)
        return first, ""

    def stop(self) -> None:
        """Stops on the path, as soon as the limits allow; motions that come later are not played."""
        lead = self._lead
        while self._stopped_from == _NEVER:
            with self._lock:
                tick = self.tick + lead
                course = [each for each in self._courses if each.at <= tick][-1]
            t = self.dt * (tick - course.at)
            braked = course
            if t < course.pieces.knots[-1]:
                braked = _Course.of(course.at, stopped(course.pieces, self._limits, t), self.dt)
            with self._lock:
                if self.tick < tick and course in self._courses:
                    self._courses = [*self._courses[: self._courses.index(course)], braked]
                    self._stopped_from = tick
            lead *= 2  # if planning the stop took too long
