"""LinkHost: opens a link, plays motions on it and keeps its readings, in the planner's process or in one of its own."""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from armctl.core.errors import LinkError
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.links.link import Link, Seen
from armctl.links.player import Player
from armctl.motion.trajectory.piecewise import Pieces

START_TOLERANCE = 1e-5  # rad, between what the robot was told and the start of a motion; the wire may have single precision
_IDLE_S = 0.1  # at rest, until a stream ends
_LEAD_S = 0.02  # between a word and its effect, where time passes by itself


class Readings(NamedTuple):
    """Readings of a stream, one for each tick that was not lost."""

    tick: Array  # (m,)
    t: Array  # (m,) s
    q: Array  # (m, n) rad
    v: Array  # (m, n) rad/s
    tau: Array  # (m, n) N m
    sent: Array  # (m, n) rad, the rows that were sent


class Progress(NamedTuple):
    """How far a stream is."""

    tick: int  # the tick of its last row
    streaming: bool  # whether it goes on
    fault: str  # why the robot ended it; empty if it did not
    stopped: str  # why it was stopped; empty if it was not
    lost: int  # ticks that were lost since the link was opened
    readings: Readings  # those since the last question


class Played(NamedTuple):
    """The answer to a motion that is to be played."""

    first: int  # its first tick
    reason: str = ""  # why it is not played; empty if it is
    opens: bool = False  # whether it opens a stream, whose ticks begin with 0


class LinkHost:
    """A link with the player of its stream. `play`, `stop` and `poll` may be called by another thread than `advance`."""

    def __init__(self, link: Link):
        self.link = link
        self.streaming = False  # whether a stream is open
        self._lock = Lock()
        self._player: Player | None = None
        self._last: Seen | None = None
        self._kept: list[tuple[int, Seen, Array]] = []
        self._fault = ""
        self._stopped = ""
        self._lost = 0
        lead = 1 if link.passes_time else round(_LEAD_S / link.dt)
        self._lead = max(lead, 1)

    def open(self) -> None:
        self.link.open()

    def read(self) -> Seen:
        return self._last if self.streaming and self._last is not None else self.link.read()

    def tip(self) -> Array | None:
        return self.link.tip()

    def recover(self) -> None:
        self.link.recover()
        self._fault = ""

    def hand(self, action: str, *arguments: float) -> Any:
        return self.link.hand(action, *arguments)

    def play(self, pieces: Pieces, at: int | None, limits: Limits, delay: int = 0) -> Played:
        """Plays a motion to rest from a tick of the open stream, or after some ticks; opens a stream if there is none."""
        with self._lock:
            if self.streaming and self._player is not None:
                return Played(*self._player.play(pieces, at, delay))
            if at is not None:
                return Played(at, self._fault or self._stopped or "the motion came too late: the stream has ended")
        seen = self.link.read()
        if seen.fault:
            raise LinkError(seen.fault)
        start = pieces.coefficients[0, 0]
        gap = np.abs(seen.q_ref - start)
        joint = int(gap.argmax())
        if gap[joint] > START_TOLERANCE:
            return Played(
                0,
                f"joint {joint + 1} of the robot was told {seen.q_ref[joint]:.5f} rad, but the motion starts at "
                f"{start[joint]:.5f} rad: it moved after the motion was planned; plan again",
            )
        player = Player(start, self.link.dt, limits, self._lead)
        first, reason = player.play(pieces, delay)
        if reason:
            return Played(first, reason)
        self._stopped = ""
        self._fault = ""
        self._kept = []
        self.link.start()
        with self._lock:
            self._player = player
            self.streaming = True
        return Played(first, opens=True)

    def stop(self, reason: str) -> None:
        """Brakes on the path."""
        player = self._player
        if self.streaming and player is not None:
            self._stopped = self._stopped or reason
            player.stop()

    def advance(self) -> None:
        """One tick of the open stream."""
        player = self._player
        assert player is not None
        try:
            ticks, seen = self.link.wait()
            if seen.fault:
                raise LinkError(seen.fault)
            self._lost += ticks - 1
            row = player.next(ticks)
            with self._lock:
                last = player.tick - player.end > _IDLE_S / self.link.dt
                self.link.send(row, last)
                self._last = seen
                self._kept.append((player.tick, seen, row))
                self.streaming = not last
        except LinkError as error:
            with self._lock:
                self._fault = str(error)
                self.streaming = False

    def poll(self) -> Progress:
        """How far the stream is, and the readings since the last question."""
        with self._lock:
            kept = self._kept
            self._kept = []
            tick = -1 if self._player is None else self._player.tick
            streaming = self.streaming
        readings = Readings(
            tick=np.array([tick for tick, _, _ in kept], dtype=np.float64),
            t=np.array([seen.t for _, seen, _ in kept]),
            q=np.array([seen.q for _, seen, _ in kept]),
            v=np.array([seen.v for _, seen, _ in kept]),
            tau=np.array([seen.tau for _, seen, _ in kept]),
            sent=np.array([row for _, _, row in kept]),
        )
        return Progress(tick, streaming, self._fault, self._stopped, self._lost, readings)

    def close(self) -> None:
        self.link.close()
