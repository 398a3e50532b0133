"""LinkDrive: a robot behind the members of `sim.Drive`; its MjData mirrors what the robot measures."""

import copy
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from armctl.control.interface import Controller, State
from armctl.core.errors import LinkError
from armctl.core.log import Log, LogSource, LogTorques
from armctl.core.pose import Pose
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, hermite, sample, standing
from armctl.run.execution.contact_reaction import ContactReaction
from armctl.run.execution.drive import hold_reference
from armctl.run.execution.recorder import Recorder, ReferenceTips, RunInfo
from armctl.run.links.envelope import Envelope
from armctl.run.links.host import START_TOLERANCE, LinkHost, Readings
from armctl.run.links.link import Link
from armctl.run.links.process import RemoteHost

_AHEAD_S = 0.05  # before its chunk of a moving reference is over, `run` returns, so that the next one can be planned
_AHEAD_TICKS = 8  # at least, where ticks are slow
_POLL_INTERVAL_S = 0.004
_REST_WINDOW_S = 0.05  # over which rest is judged: a measured speed is noise
_MIN_REST_WINDOW_S = 0.02
_TIP_SPEED_TOLERANCE = 1.01  # what a motion that was slowed down to a speed may exceed it by, between samples
_TIP_INTERVAL_S = 0.005
_STOPPED = "the arm was stopped on its path"


@dataclass
class _Stream:
    before: Array  # (3, n) rad, the rows before `next`
    next: int = 0  # the tick after the rows that were sent
    moves: bool = False  # whether the motion goes on at that tick
    course: Pieces | None = None  # the motion that was sent last
    at: int = 0  # its first tick
    tick: int = -1  # the tick of the last row that was played
    felt: int = 0  # that of the last reading in which contacts were felt


@dataclass
class _Segment:
    """Readings of one stream, and the ticks among them that belong to a run."""

    first: int  # the first tick
    end: int | None  # the tick after the last one; None where the arm was stopped: then until it rests
    readings: list[Readings] = field(default_factory=list)  # those of the stream, in the order of time


class LinkDrive:
    """A robot as the drive of an arm's commands; its `data` mirrors the joints as measured, and all else as in the model."""

    continuous = True
    source = LogSource.ROBOT
    torques = LogTorques.MEASURED

    def __init__(self, arm: Arm, host: LinkHost | RemoteHost, link: Link, envelope: Envelope, tip_speed: float):
        self.actuation = arm.actuation  # the arm's joints
        self.model = copy.copy(arm.model)  # a copy of the arm's model
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = arm.home_qpos
        self.dt = link.dt  # s, the tick
        self.description = f"robot: {link.name}"
        self.failure = ""  # why the last run ended early; empty if it did not
        self.fault = ""  # why the robot takes no motion until `recover`; empty if it does
        self.tip_speed = tip_speed  # m/s, the greatest that is sent
        self.lost = 0  # ticks that were lost since the link was opened
        self.late = 0  # ticks by which motions that continue others came too late
        self._arm = arm
        self._host = host
        self.envelope = envelope  # what every row is checked against
        self._passes_time = link.passes_time
        self._rest_speed = link.rest_speed
        self._tips = ReferenceTips()
        # Takes each reading, what the robot was told then, (n,) rad each, and its state in words; it must not wait
        self.observer: Callable[[Array, Array, str], None] | None = None
        self.reaction: ContactReaction | None = None  # feels contacts while it is set; where one is felt, the arm stops
        self.passed = 0.0  # s of the motion, until a contact was felt in it
        self._stream: _Stream | None = None
        self._recorder: _LinkRecorder | None = None
        self._trajectory: tuple[TickReference, Trajectory] | None = None
        self._past: deque[tuple[float, Array]] = deque()
        self._end = np.zeros(arm.n)
        first = host.read()
        self._t0 = first.t
        self._see(first.t, first.q, first.v)

    @property
    def blocked(self) -> str:
        """Why no motion may start: the robot reports a fault; empty if one may."""
        return f"{self.fault}; call robot.recover() when the robot may move again" if self.fault else ""

    @property
    def q_ref(self) -> Array:
        """(n,) rad, what the robot was told last; while it is told nothing, it may change that itself."""
        if self._stream is not None:
            self._watch()
        if self._stream is None:
            told = self._host.read().q_ref
            if np.abs(told - self._end).max() > START_TOLERANCE / 2:
                self._end = told
        return self._end

    @property
    def state(self) -> State:
        """What the robot measures now."""
        if self._stream is not None:
            self._watch()
        if self._stream is None:
            seen = self._host.read()
            self._see(seen.t, seen.q, seen.v)
        return State(self._past[-1][1], self._v, float(self.data.time), self.dt, True)

    def tip_pose(self, arm: Arm) -> Pose:
        return arm.fk(self.state.q)

    def is_still(self, joints: slice) -> bool:
        """Whether the positions of some joints have not changed for a moment."""
        t, q = self._past[-1]
        window = t - self._past[0][0]
        if window < _MIN_REST_WINDOW_S:
            return False
        return bool(np.abs(q - self._past[0][1])[joints].max() < self._rest_speed * window)

    def recorder(self) -> Recorder:
        return _LinkRecorder(self)

    def reference(self, trajectory: Trajectory, ticks: int) -> TickReference:
        rows = TickReference.of(trajectory, self.dt, ticks, self.continuous)
        self._trajectory = (rows, trajectory)
        return rows

    def run(
        self, controller: Controller | None, reference: TickReference, recorder: Recorder, to_rest: Pieces | None = None
    ) -> None:
        """Checks a reference, or the motion `to_rest` that it begins; has it played, mirrors and records it."""
        if self.fault:
            raise LinkError(self.blocked)
        assert isinstance(recorder, _LinkRecorder)
        recorder.has_begun = True
        self._recorder = recorder
        ticks = len(reference.q)
        course = self._course(reference) if to_rest is None else to_rest
        self.failure = self.refusal(course)
        if self.failure:
            return
        stream = self._stream
        at = stream.next if stream is not None and stream.moves else None
        duration = float(course.knots[-1])
        moves = duration > ticks * self.dt + 1e-9
        ahead = max(round(_AHEAD_S / self.dt), _AHEAD_TICKS) if moves else 0
        try:
            first, reason, opens, late = self._host.play(course, at, self._arm.limits, ahead)
            if late:
                self.late += late
                self.come_to_rest(stop=False)
                return
            if reason:
                self.failure = f"not sent: {reason}" if at is None else f"{reason}; the arm came to rest on its path"
                if at is None:
                    self._end = self._host.read().q_ref
                return
            if opens or self._stream is None:
                self._stream = _Stream(np.repeat(course.coefficients[:1, 0], 3, axis=0))
                recorder.segments.append(_Segment(first, first))
            stream = self._stream
            stream.course = course
            stream.at = first
            rows = sample(course, self.dt * np.arange(ticks, dtype=np.float64)).q
            stream.before = np.vstack([stream.before, rows])[-3:]
            stream.next = first + ticks
            stream.moves = moves
            self._end = sample(course, np.array([duration])).q[0]
            if not recorder.segments:
                recorder.segments.append(_Segment(first, first))
            recorder.segments[-1].end = stream.next
            self._wait_for(stream.next - 1 - ahead)
        except LinkError as error:
            self._lose(str(error))

    def hold(self, seconds: float) -> Array:
        """Streams the present position for a while; the times of the readings, s."""
        recorder = _LinkRecorder(self)
        self.run(None, hold_reference(self, seconds), recorder)
        self._recorder = None
        return np.concatenate([part.t for segment in recorder.segments for part in segment.readings] or [np.zeros(0)])

    def instability(self, arm: Arm, controller: Controller, q: Array) -> str:
        """Nothing: a robot follows references with its own controller."""
        return ""

    def come_to_rest(self, *, stop: bool) -> None:
        """Waits until the arm rests; with `stop` it brakes on its path."""
        segment = self._recorder.segments[-1] if self._recorder is not None and self._recorder.segments else None
        try:
            if (stop or self._has_contact) and self._stream is not None:
                failure = self.failure
                self._host.stop(_STOPPED)
                while self._stream is not None:
                    self._wait_for(self._stream.tick + 1)
                self.failure = failure if self.failure == _STOPPED else self.failure
                if segment is not None:
                    segment.end = None
            elif self._stream is not None and self._stream.moves and self._stream.course is not None:
                end = self._stream.at + int(np.ceil(self._stream.course.knots[-1] / self.dt - 1e-9))
                if segment is not None:
                    segment.end = end + 1
                self._wait_for(end)
                if self._stream is not None:
                    self._stream.moves = False
        except LinkError as error:
            self._lose(str(error))

    def recover(self) -> None:
        self._host.recover()
        self.fault = ""
        self.failure = ""

    def refusal(self, course: Pieces) -> str:
        """Why a motion from now on, or one that continues the present one, must not be sent; empty if it may."""
        ticks = int(np.ceil(course.knots[-1] / self.dt - 1e-9))
        rows = sample(course, self.dt * np.arange(ticks + 2, dtype=np.float64)).q
        stream = self._stream
        before = stream.before if stream is not None and stream.moves else np.repeat(rows[:1], 3, axis=0)
        reason = self.envelope.refusal(rows, before, self.dt)
        if not reason:
            speed = self.tip_speed_of(course)
            if speed > _TIP_SPEED_TOLERANCE * self.tip_speed:
                reason = f"the tip moves at {speed:.3g} m/s, at most {self.tip_speed:.3g} m/s; set tip_speed= of the Robot"
        return f"not sent: {reason}" if reason else ""

    def tip_speed_of(self, course: Pieces) -> float:
        """m/s, the greatest speed of the tip in a motion."""
        count = 2 + int(course.knots[-1] / _TIP_INTERVAL_S)
        times = np.linspace(0.0, course.knots[-1], count)
        steps = np.diff(self._arm.fk_many(sample(course, times).q)[0], axis=0)
        return float(np.linalg.norm(steps, axis=1).max() / max(times[1], 1e-9))

    def _course(self, reference: TickReference) -> Pieces:
        """A reference as polynomials: those of its trajectory if it has them. It ends at rest, or is refused by the player."""
        if self._trajectory is not None and self._trajectory[0] is reference:
            trajectory = self._trajectory[1]
            if isinstance(trajectory, JointTrajectory):
                return self._lengthened(trajectory.pieces, len(reference.q))
        if np.ptp(reference.q, axis=0).max() == 0.0:
            return self._lengthened(standing(reference.q[0]), len(reference.q))
        return hermite(self.dt * np.arange(len(reference.q), dtype=np.float64), reference.q, reference.v, reference.a)

    def _lengthened(self, pieces: Pieces, ticks: int) -> Pieces:
        """A motion with its end held for a dwell."""
        end = self.dt * (ticks - 1)
        if pieces.knots[-1] >= end:
            return pieces
        rest = standing(sample(pieces, pieces.knots[-1:]).q[0])
        return Pieces(np.append(pieces.knots, end), np.concatenate([pieces.coefficients, rest.coefficients]))

    def _wait_for(self, tick: int) -> None:
        """Mirrors and records until a row was played, or the stream has ended."""
        while self._stream is not None and self._stream.tick < tick:
            if self._passes_time and isinstance(self._host, LinkHost):
                between = max(1, round(_POLL_INTERVAL_S / self.dt))
                until = tick if self.reaction is None else min(tick, self._stream.tick + between)
                while self._host.streaming and self._stream.tick < until:
                    self._host.advance()
                    self._stream.tick += 1
            else:
                time.sleep(_POLL_INTERVAL_S)
            self._watch()

    def _watch(self) -> None:
        progress = self._host.poll()
        readings = progress.readings
        self.lost = progress.lost
        if self._recorder is not None and self._recorder.segments:
            self._recorder.segments[-1].readings.append(readings)
        for k in range(len(readings.tick)):
            self._see(readings.t[k], readings.q[k], readings.v[k])
        if self._stream is not None:
            if self.reaction is not None and len(readings.tick) and not self._has_contact:
                self._feel(self.reaction, self._stream, readings)
            self._stream.tick = progress.tick
            if not progress.streaming:
                self._stream = None
        if progress.fault:
            self._lose(progress.fault)
        elif progress.stopped and not self.failure:
            self.failure = progress.stopped
        if self._stream is None and (progress.stopped or progress.fault) and len(readings.sent):
            self._end = readings.sent[-1]
        if self.observer is not None and len(readings.sent):
            self.observer(readings.q[-1], readings.sent[-1], self.fault or f"t = {self.data.time:.1f} s")

    @property
    def _has_contact(self) -> bool:
        return self.reaction is not None and bool(self.reaction.contact)

    def _feel(self, reaction: ContactReaction, stream: _Stream, readings: Readings) -> None:
        for k, tick in enumerate(readings.tick.astype(int)):
            dt = self.dt * max(1, tick - stream.felt)
            stream.felt = tick
            reaction.update(readings.t[k] - self._t0, readings.q[k], readings.v[k], readings.tau[k], dt)
        if reaction.contact:
            self.passed = self.dt * max(0, stream.felt - stream.at)
            self._host.stop(reaction.felt)

    def _lose(self, fault: str) -> None:
        self._stream = None
        self.fault = fault
        self.failure = fault

    def _see(self, t: float, q: Array, v: Array) -> None:
        self._v = v
        self._past.append((t, q))
        while len(self._past) > 2 and t - self._past[1][0] > _REST_WINDOW_S:
            self._past.popleft()
        self.actuation.joint_map.set_positions(self.data.qpos, q)
        self.actuation.joint_map.set_speeds(self.data.qvel, np.nan_to_num(v))
        self.data.time = t - self._t0
        mujoco.mj_kinematics(self.model, self.data)


class _LinkRecorder(Recorder):
    """Readings of a run, which become rows when the log is made: what was sent, and what was measured then."""

    def __init__(self, drive: LinkDrive):
        super().__init__(drive.model, drive.actuation, drive._tips)
        self.segments: list[_Segment] = []  # its readings, by stream
        self._drive = drive

    def log(self, arm: Arm, run: RunInfo, joints: slice = slice(None), wrench: slice = slice(0, 6)) -> Log:
        """The readings as a Log. A tick that was lost has the next reading, and a reference between those that were sent."""
        self._drive._recorder = None
        for segment in self.segments:
            self._add(segment)
        return super().log(arm, run, joints, wrench)

    def _add(self, segment: _Segment) -> None:
        drive = self._drive
        parts = [part for part in segment.readings if len(part.tick)]
        if not parts:
            return
        readings = Readings(*map(np.concatenate, zip(*parts, strict=True)))
        end = segment.end
        if end is None:
            moved = np.flatnonzero(np.abs(np.diff(readings.sent, axis=0)).max(axis=1))
            end = int(readings.tick[moved[-1] + 1]) + 1 if len(moved) else segment.first + 1
        ticks = np.arange(segment.first, min(end, int(readings.tick[-1]) + 1))
        if not len(ticks):
            return
        seen = np.minimum(np.searchsorted(readings.tick, ticks), len(readings.tick) - 1)
        q_ref = np.column_stack([np.interp(ticks, readings.tick, column) for column in readings.sent.T])
        v_ref = np.diff(q_ref, axis=0, prepend=q_ref[:1]) / drive.dt
        a_ref = np.diff(v_ref, axis=0, append=v_ref[-1:]) / drive.dt
        rows = self.begin(TickReference(q_ref, v_ref, a_ref, v_ref, a_ref))
        rows.qpos[:] = drive.data.qpos
        joint_map = drive.actuation.joint_map
        rows.qpos[:, joint_map.qpos_adr] = joint_map.positions(readings.q[seen])
        rows.v[:] = readings.v[seen]
        rows.tau[:] = readings.tau[seen]
        rows.tau_cmd[:] = rows.tau
        rows.count = len(ticks)
