"""LinkStream: the motions that are sent to a robot, one continuing the other until it rests."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.plan.motion.trajectory.path_stop import remaining
from armctl.plan.motion.trajectory.piecewise import Pieces, sample
from armctl.run.links.host import START_TOLERANCE, LinkHost, Played, Progress
from armctl.run.links.process import RemoteHost

_POLL_INTERVAL_S = 0.004


@dataclass
class OpenStream:
    """What is known of an open stream; its ticks begin with 0."""

    motion: Pieces  # that was sent last
    start: int  # its first tick
    rows: Array  # (3, n) rad, the rows before `next`
    next: int = 0  # the tick after the rows that were asked for
    moves: bool = False  # whether the motion goes on at that tick
    tick: int = -1  # the tick of the last row that was played
    monitored: int = 0  # the tick of the last reading that a contact reaction got

    def end(self, dt: float) -> int:
        """The first tick at which its motion is at rest."""
        return self.start + int(np.ceil(self.motion.knots[-1] / dt - 1e-9))


class LinkStream:
    """The stream of motions to a host: opened by one, continued by others, over when the robot rests or reports a fault."""

    def __init__(self, host: LinkHost | RemoteHost, dt: float, passes_time: bool, n: int):
        """No stream yet, to a robot of n joints with a tick of dt s; `passes_time` as of its link."""
        self.current: OpenStream | None = None
        self.q_end = np.zeros(n)  # (n,) rad, where the motions that were sent end
        self.lost = 0  # ticks that were lost since the link was opened
        self._host = host
        self._dt = dt
        self._passes_time = passes_time

    @property
    def moving(self) -> OpenStream | None:
        """The open stream if a motion can continue it; None: the next motion starts at rest."""
        return self.current if self.current is not None and self.current.moves else None

    def read_command(self) -> Array:
        """(n,) rad, what the robot was commanded last; while no stream is open, it may change that itself."""
        if self.current is None:
            command = self._host.read().q_ref
            if np.abs(command - self.q_end).max() > START_TOLERANCE / 2:
                self.q_end = command
        return self.q_end

    def play(self, motion: Pieces, ticks: int, limits: Limits, ahead: int) -> Played:
        """Plays a motion, at whose first ticks the caller looks; it continues a stream that moves, `ahead` ticks at least."""
        moving = self.moving
        played = self._host.play(motion, None if moving is None else moving.next, limits, ahead)
        if played.late:
            return played
        if played.reason:
            if moving is None:
                self.q_end = self._host.read().q_ref
            return played
        opens = played.opens or self.current is None
        if opens:
            self.current = OpenStream(motion, played.first, np.repeat(motion.coefficients[:1, 0], 3, axis=0))
        stream = self.current
        assert stream is not None
        stream.motion = motion
        stream.start = played.first
        duration = float(motion.knots[-1])
        rows = sample(motion, self._dt * np.arange(ticks, dtype=np.float64)).q
        stream.rows = np.vstack([stream.rows, rows])[-3:]
        stream.next = played.first + ticks
        stream.moves = duration > ticks * self._dt + 1e-9
        self.q_end = sample(motion, np.array([duration])).q[0]
        return played._replace(opens=opens)

    def open_motion(self, ticks: int) -> Pieces | None:
        """What is left of the motion after some ticks from now, when another one may continue it; None if it is over then."""
        stream = self.current
        if stream is None:
            return None
        tick = max(stream.tick, stream.start) + ticks
        if tick >= stream.end(self._dt):
            return None
        before = sample(stream.motion, self._dt * (np.arange(tick - 3, tick, dtype=np.float64) - stream.start)).q
        stream.next = tick
        stream.moves = True
        stream.rows = before
        return remaining(stream.motion, self._dt * (tick - stream.start))

    def stop(self, reason: str) -> None:
        """Brakes on the path."""
        self._host.stop(reason)

    def let_pass(self, stream: OpenStream, tick: int, in_steps: bool) -> None:
        """Lets time pass until a row of the stream may have been played; `in_steps` in steps of a few milliseconds."""
        if not (self._passes_time and isinstance(self._host, LinkHost)):
            time.sleep(_POLL_INTERVAL_S)
            return
        step = max(1, round(_POLL_INTERVAL_S / self._dt))
        until = min(tick, stream.tick + step) if in_steps else tick
        while self._host.streaming and stream.tick < until:
            self._host.advance()
            stream.tick += 1

    def poll(self) -> Progress:
        """What happened since the last call."""
        progress = self._host.poll()
        self.lost = progress.lost
        if self.current is not None:
            self.current.tick = progress.tick
        if progress.fault or not progress.streaming:
            self.current = None
        if self.current is None and (progress.stopped or progress.fault) and len(progress.readings.sent):
            self.q_end = progress.readings.sent[-1]
        return progress
