"""Player: plays motions sample by sample. What it holds always ends at rest, and a stop never leaves the path.

LinkHost: opens a link, plays motions on it and keeps its readings, in the planner's process or in one of its own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import NamedTuple

import numpy as np

from armctl.core.errors import LinkError
from armctl.core.limits import Limits
from armctl.core.trajectory import Setpoint, TickReference
from armctl.core.validation import Array
from armctl.plan.motion.trajectory.path_stop import REST_SPEED, stopped
from armctl.plan.motion.trajectory.piecewise import JointSamples, Pieces, sample, standing
from armctl.run.links.delay_probe import measured_delay
from armctl.run.links.link import HandReading, Link, MotionLink, Reading
from armctl.run.links.torque_interface import TorqueLink
from armctl.run.links.torque_loop import LinkLaw, TorqueLoop

START_TOLERANCE = 1e-5  # rad, between the last command and the start of a motion; the wire may have single precision
_LAW_START_TOLERANCE = 0.02  # rad, likewise under a law: between two streams the robot's own servo holds the arm where it is
MAX_JOIN_GAP = 1e-6  # rad, between the end of one motion and the start of the next; single precision is 1e-7
_NEVER = 2**60
_IDLE_S = 0.1  # at rest, until a stream ends
_LONGEST_IDLE_S = 1.0  # of a law under which the arm is not at rest
_LEAD_S = 0.02  # between a request and its effect, where time passes by itself


class Readings(NamedTuple):
    """Readings of a stream, one for each tick that was not lost."""

    tick: Array  # (m,)
    t: Array  # (m,) s
    q: Array  # (m, n) rad
    v: Array  # (m, n) rad/s
    tau: Array  # (m, n) N m
    sent: Array  # (m, n) rad, the positions that were sent, or those that a law followed
    torque: Array  # (m, n) N m, that a law commanded, with what the maker adds; NaN without a law


class Progress(NamedTuple):
    tick: int  # the tick of its last sample
    streaming: bool  # whether it goes on
    fault: str  # why the robot ended it; empty if it did not
    stopped: str  # why it was stopped; empty if it was not
    lost: int  # ticks that were lost since the link was opened
    readings: Readings  # those since the last question


class Played(NamedTuple):
    first: int  # its first tick
    reason: str = ""  # why it is not played; empty if it is
    opens: bool = False  # whether it opens a stream, whose ticks begin with 0
    late: int = 0  # ticks by which it came too late; the arm then comes to rest on the motion before
    fails: bool = False  # whether a law failed, and the arm is being damped


@dataclass(frozen=True, eq=False)
class _TimedMotion:
    at: int
    pieces: Pieces
    samples: Array  # (T, n) rad, one each tick
    reference: TickReference | None  # (T, n) each, for a law; None where only positions are sent

    @classmethod
    def from_pieces(cls, at: int, pieces: Pieces, dt: float, for_law: bool) -> _TimedMotion:
        ticks = int(np.ceil(pieces.knots[-1] / dt - 1e-9))
        samples = sample(pieces, dt * np.arange(ticks + 1, dtype=np.float64))
        if not for_law:
            return cls(at=at, pieces=pieces, samples=samples.q, reference=None)
        q = np.vstack([samples.q, samples.q[-1:]])
        moving = np.append(np.arange(ticks + 1) * dt < pieces.knots[-1], False)[:, None]  # it ends at rest
        v = moving * np.vstack([samples.v, samples.v[-1:]])
        a = moving * np.vstack([samples.a, samples.a[-1:]])
        reference = TickReference.between(q, v, a, q[0], dt, continuous=True)
        return cls(at=at, pieces=pieces, samples=samples.q, reference=reference)

    def sample_at(self, tick: int) -> Array:
        return self.samples[self._row(tick)]

    def setpoint_at(self, tick: int) -> Setpoint:
        assert self.reference is not None
        row = self._row(tick)
        return Setpoint(*(column[row] for column in self.reference))

    def _row(self, tick: int) -> int:
        return min(max(tick - self.at, 0), len(self.samples) - 1)

    @property
    def end(self) -> int:
        return self.at + len(self.samples) - 1


class Player:
    """The samples of one stream. `play` and `stop` may be called by another thread than `next`."""

    def __init__(self, q: Array, dt: float, limits: Limits, lead: int, for_law: bool = False):
        """A player that stands at q. A request, such as a stop, has its effect after `lead` ticks: a stop has to be planned.

        One `for_law` gives whole setpoints.
        """
        self.tick = -1  # the tick of the last sample; -1 before the first
        self.dt = dt  # s
        self._limits = limits
        self._lead = lead
        self._for_law = for_law
        self._lock = Lock()
        self._motions = [self._timed(0, standing(q))]  # each until the next one begins
        self._stopped_from = _NEVER
        self._send: Callable[[int, int, JointSamples], bool] | None = None  # `MotionLink.send_motion`

    @property
    def end(self) -> int:
        """The first tick at which it rests, if nothing changes."""
        with self._lock:
            return self._motions[-1].end

    def send_to(self, link: MotionLink) -> bool:
        """Sends the motions to a robot that takes them whole, and from now on each change; whether it came in time."""
        with self._lock:
            self._send = link.send_motion
            return self._replace(self._motions, self._motions[-1].at)

    def next(self, ticks: int = 1) -> Array:
        with self._lock:
            return self._advance(ticks).sample_at(self.tick)

    def next_setpoint(self, ticks: int = 1) -> Setpoint:
        with self._lock:
            return self._advance(ticks).setpoint_at(self.tick)

    def _advance(self, ticks: int) -> _TimedMotion:
        self.tick += ticks
        while len(self._motions) > 1 and self._motions[1].at <= self.tick:
            self._motions.pop(0)
        return self._motions[0]

    def _timed(self, at: int, pieces: Pieces) -> _TimedMotion:
        return _TimedMotion.from_pieces(at, pieces, self.dt, self._for_law)

    def play(self, pieces: Pieces, at: int | None, delay: int = 0) -> Played:
        """Replaces what follows a tick by a motion to rest."""
        if np.abs(sample(pieces, pieces.knots[-1:]).v).max() > REST_SPEED:
            return Played(0, "the motion does not end at rest")
        with self._lock:
            first = self.tick + max(self._lead, delay) if at is None else at
            if self._stopped_from <= first:
                return Played(first, "the arm was stopped")
            late = self.tick - first + 1
            if late > 0:
                return Played(first, f"the motion came {self.dt * late:.3f} s too late", late=late)
            before = self._motions[-1]
            if first < before.at:
                return Played(first, "the motion starts before the one that was sent last")
            motion = self._timed(first, pieces)
            gap = float(np.abs(motion.samples[0] - before.sample_at(first)).max())
            if gap > MAX_JOIN_GAP:
                return Played(first, f"the motion starts {gap:.2g} rad from where the last one is then")
            if not self._replace([*self._motions, motion], first):
                return Played(first, "the motion came too late for the robot", late=1)
        return Played(first)

    def stop(self) -> None:
        """Stops on the path, as soon as the limits allow; motions that come later are not played."""
        lead = self._lead
        while self._stopped_from == _NEVER:
            with self._lock:
                tick = self.tick + lead
                motion = [each for each in self._motions if each.at <= tick][-1]
            t = self.dt * (tick - motion.at)
            braked = motion
            if t < motion.pieces.knots[-1]:
                braked = self._timed(motion.at, stopped(motion.pieces, self._limits, t))
            with self._lock:
                if self.tick < tick and motion in self._motions:
                    motions = [*self._motions[: self._motions.index(motion)], braked]
                    if self._replace(motions, tick):
                        self._stopped_from = tick
            lead *= 2  # if planning the stop took too long

    def _replace(self, motions: list[_TimedMotion], changed: int) -> bool:
        """Takes motions that differ from the present ones from a tick on, unless a robot that must know gets them too late."""
        if self._send is not None:
            first = max(self.tick, 0)
            rows = _rows(motions, first, self.dt)
            rests = self._motions[-1].end <= changed and not np.ptp(rows.q, axis=0).any()  # and goes on resting
            if not rests and not self._send(first, changed, rows):
                return False
        self._motions = motions
        return True


def _rows(motions: Sequence[_TimedMotion], first: int, dt: float) -> JointSamples:
    """What motions are, one after another, from a tick on until they rest: one row each tick."""
    parts = []
    for k, motion in enumerate(motions):
        begin = max(first, motion.at)
        end = motions[k + 1].at if k + 1 < len(motions) else max(motion.end, begin) + 1
        ticks = np.arange(begin, end, dtype=np.float64)
        parts.append(sample(motion.pieces, dt * (ticks - motion.at)))
    rows = JointSamples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    rows.v[-1] = 0.0  # below REST_SPEED
    rows.a[-1] = 0.0
    return rows


class LinkHost:
    """A link with the player of its stream. `play`, `stop` and `poll` may be called by another thread than `advance`."""

    def __init__(self, link: Link, law: LinkLaw | None = None):
        """A host that sends positions, or the torques of a law."""
        self.link = link
        self.streaming = False  # whether a stream is open
        self._lock = Lock()
        self._player: Player | None = None
        self._last: Reading | None = None
        self._law = law
        self._torques: TorqueLoop | None = None if law is None else TorqueLoop(law, link.dt)
        self._kept: list[tuple[int, Reading, Array, Array]] = []  # tick, reading, position, and torque of a law
        self._fault = ""
        self._stopped = ""
        self._lost = 0
        self._takes_motions = isinstance(link, MotionLink)
        lead_s = link.lead if isinstance(link, MotionLink) else 0.0 if link.passes_time else _LEAD_S
        self._lead = max(round(lead_s / link.dt), 1)

    def open(self) -> None:
        self.link.open()

    def read(self) -> Reading:
        return self._last if self.streaming and self._last is not None else self.link.read()

    def tip(self) -> Array | None:
        return self.link.tip()

    def recover(self) -> None:
        self.link.recover()
        self._fault = ""

    def measure_delay(self) -> float:
        """s, from a command to the torque, with its jitter, of a link that gives none; the arm is held meanwhile.

        Raises:
            LinkError: No torques are measured that follow the commands.
        """
        assert self._law is not None
        assert self._torques is not None
        given = self._law.interface.delay
        delay = measured_delay(self._torque_link, self.link, self._law) if given is None else given
        self._torques.expect_delay(delay)
        return delay

    def read_hand(self) -> HandReading:
        return self.link.read_hand()

    def move_hand(self, width: float) -> bool:
        return self.link.move_hand(width)

    def close_hand(self, force: float) -> bool:
        return self.link.close_hand(force)

    def play(self, pieces: Pieces, at: int | None, limits: Limits, delay: int = 0) -> Played:
        """Plays a motion to rest from a tick of the open stream, or after some ticks; opens a stream if there is none."""
        with self._lock:
            if self.streaming and self._player is not None:
                if self._torques is not None and self._torques.fault:
                    return Played(0, self._torques.fault, fails=True)
                return self._player.play(pieces, at, delay)
            if at is not None:
                why = self._fault or self._stopped
                return Played(at, why or "the motion came too late: the stream has ended", late=0 if why else 1)
        reading = self.link.read()
        if reading.fault:
            raise LinkError(reading.fault)
        start = pieces.coefficients[0, 0]
        gap = np.abs(reading.q_ref - start)
        joint = int(gap.argmax())
        if gap[joint] > (START_TOLERANCE if self._torques is None else _LAW_START_TOLERANCE):
            return Played(
                0,
                f"joint {joint + 1} of the robot was commanded to {reading.q_ref[joint]:.5f} rad, but the motion starts at "
                f"{start[joint]:.5f} rad: it moved after the motion was planned; plan again",
            )
        player = Player(start, self.link.dt, limits, self._lead, for_law=self._torques is not None)
        played = player.play(pieces, delay)
        if played.reason:
            return played
        self._stopped = ""
        self._fault = ""
        self._kept = []
        if self._torques is not None:
            self._torques.start()
            self._torque_link.start_torques()
        else:
            self.link.start()
            if isinstance(self.link, MotionLink) and not player.send_to(self.link):
                raise LinkError(f"{self.link.name}: the motion came too late; end other programs")
        with self._lock:
            self._player = player
            self.streaming = True
        return played._replace(opens=True)

    def stop(self, reason: str) -> None:
        player = self._player
        if self.streaming and player is not None:
            self._stopped = self._stopped or reason
            with contextlib.suppress(LinkError):  # what it holds ends at rest, too
                player.stop()

    def advance(self) -> None:
        player = self._player
        assert player is not None
        try:
            ticks, reading = self.link.wait()
            if reading.fault:
                raise LinkError(reading.fault)
            self._lost += ticks - 1
            if self._torques is None:
                self._send_position(player, player.next(ticks), reading)
            else:
                self._send_torques(self._torques, player, reading, ticks)
        except LinkError as error:
            with self._lock:
                self._fault = str(error)
                self.streaming = False
            if self._takes_motions:  # the robot goes on with the motion that it has
                with contextlib.suppress(LinkError):
                    player.stop()

    def _send_position(self, player: Player, row: Array, reading: Reading) -> None:
        with self._lock:
            last = player.tick - player.end > _IDLE_S / self.link.dt
            self.link.send(row, last)
            self._keep(player.tick, reading, row, np.full(len(row), np.nan), last)

    def _send_torques(self, torques: TorqueLoop, player: Player, reading: Reading, ticks: int) -> None:
        setpoint = player.next_setpoint(ticks)
        tau = torques.next(reading, setpoint, ticks)
        row = reading.q if torques.fault else setpoint.q
        with self._lock:
            idle = (player.tick - player.end) * self.link.dt
            is_still = bool(np.abs(reading.v).max() < self.link.rest_speed)
            last = torques.is_over or (not torques.fault and idle > (_IDLE_S if is_still else _LONGEST_IDLE_S))
            self._torque_link.send_torques(tau, last)
            self._keep(player.tick, reading._replace(q_ref=row), row, torques.total, last)
            if torques.is_over:
                self._fault = torques.fault

    def _keep(self, tick: int, reading: Reading, row: Array, torque: Array, last: bool) -> None:
        self._last = reading
        self._kept.append((tick, reading, row, torque))
        self.streaming = not last

    @property
    def _torque_link(self) -> TorqueLink:
        link = self.link
        assert isinstance(link, TorqueLink)
        return link

    def poll(self) -> Progress:
        """How far the stream is, and the readings since the last question."""
        with self._lock:
            kept = self._kept
            self._kept = []
            tick = -1 if self._player is None else self._player.tick
            streaming = self.streaming
        readings = Readings(
            tick=np.array([tick for tick, _, _, _ in kept], dtype=np.float64),
            t=np.array([reading.t for _, reading, _, _ in kept]),
            q=np.array([reading.q for _, reading, _, _ in kept]),
            v=np.array([reading.v for _, reading, _, _ in kept]),
            tau=np.array([reading.tau for _, reading, _, _ in kept]),
            sent=np.array([row for _, _, row, _ in kept]),
            torque=np.array([torque for _, _, _, torque in kept]),
        )
        return Progress(tick, streaming, self._fault, self._stopped, self._lost, readings)

    def close(self) -> None:
        self.link.close()
