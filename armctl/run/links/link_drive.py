"""LinkDrive: a robot behind the members of `Drive`; its MjData mirrors what the robot measures."""

from collections.abc import Callable

import mujoco
import numpy as np

from armctl.control.interface import Controller, State
from armctl.core.errors import LinkError
from armctl.core.log import LogSource, LogTorques
from armctl.core.pose import Pose
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, hermite, sample, standing
from armctl.run.execution.contact_reaction import ContactReaction
from armctl.run.execution.drive import hold_reference
from armctl.run.execution.recorder import Recorder, ReferenceTips
from armctl.run.links.envelope import Envelope
from armctl.run.links.host import LinkHost, Readings
from armctl.run.links.link import Link
from armctl.run.links.link_recorder import LinkRecorder
from armctl.run.links.link_stream import LinkStream, OpenStream
from armctl.run.links.motion_check import MotionCheck
from armctl.run.links.process import RemoteHost
from armctl.run.links.robot_mirror import RobotMirror

_AHEAD_S = 0.05  # before its chunk of a moving reference is over, `run` returns, so that the next one can be planned
_AHEAD_TICKS = 8  # at least, where ticks are slow
_LONGEST_GAP_S = 0.01  # between readings, half of the time constant of an observer of contacts
_STOPPED = "the arm was stopped on its path"


class LinkDrive:
    """A robot as the drive of an arm's commands: it checks motions, streams them, and mirrors and records what is measured."""

    continuous = True
    source = LogSource.ROBOT

    def __init__(
        self, arm: Arm, host: LinkHost | RemoteHost, link: Link, envelope: Envelope, tip_speed: float, *, has_law: bool
    ):
        """A drive of a link that is open; `has_law` if its host computes torques."""
        self.torques = LogTorques.BOTH if has_law else LogTorques.MEASURED
        self.actuation = arm.actuation  # the arm's joints
        self.dt = link.dt  # s, the tick
        self.description = f"robot: {link.name}"
        self.failure = ""  # why the last run ended early; empty if it did not
        self.fault = ""  # why the robot takes no motion until `recover`; empty if it does
        self.late = 0  # ticks by which motions that continue others came too late
        self.check = MotionCheck(arm, envelope, tip_speed, link.dt)  # of every motion
        # Takes each reading, the command at that time, (n,) rad each, and the robot's state in words; it must not wait
        self.observer: Callable[[Array, Array, str], None] | None = None
        self.reaction: ContactReaction | None = None  # detects contacts while it is set; the arm stops at one
        self.interlock: Callable[[], str] | None = None  # says why the arm must not move now; empty if it may
        self.time_at_contact = 0.0  # s of the motion, until a contact was detected in it
        self._arm = arm
        self._host = host
        self._tips = ReferenceTips()
        self._stream = LinkStream(host, link.dt, link.passes_time, arm.n)
        self._recorder: LinkRecorder | None = None
        self._asks = False  # whether the interlock is being asked
        self._trajectory: tuple[TickReference, Trajectory] | None = None
        first = host.read()
        self._mirror = RobotMirror(arm, link.rest_speed, first.t, first.q, first.v)

    @property
    def model(self) -> mujoco.MjModel:
        """A copy of the arm's model."""
        return self._mirror.model

    @property
    def data(self) -> mujoco.MjData:
        return self._mirror.data

    @property
    def mirror(self) -> RobotMirror:
        """What the robot measures, and carries."""
        return self._mirror

    @property
    def lost(self) -> int:
        """Ticks that were lost since the link was opened."""
        return self._stream.lost

    @property
    def blocked(self) -> str:
        """Why no motion may start: the robot reports a fault; empty if one may."""
        return f"{self.fault}; call robot.recover() when the robot may move again" if self.fault else ""

    @property
    def q_ref(self) -> Array:
        """(n,) rad, the robot's last command; while it is sent nothing, it may change that itself."""
        if self._stream.current is not None:
            self._watch()
        return self._stream.read_command()

    @property
    def state(self) -> State:
        """What the robot measures now."""
        if self._stream.current is not None:
            self._watch()
        if self._stream.current is None:
            reading = self._host.read()
            self._mirror.show(reading.t, reading.q, reading.v)
        return self._mirror.state(self.dt)

    def tip_pose(self, arm: Arm, tip: str | None = None) -> Pose:
        return arm.fk(self.state.q, tip)

    def is_still(self) -> bool:
        """Whether the positions of the joints have not changed for a moment."""
        return self._mirror.is_still()

    def recorder(self) -> LinkRecorder:
        return LinkRecorder(self._mirror, self.actuation, self._tips, self.dt)

    def reference(self, trajectory: Trajectory, ticks: int) -> TickReference:
        rows = TickReference.from_trajectory(trajectory, self.dt, ticks, self.continuous)
        self._trajectory = (rows, trajectory)
        return rows

    def run(
        self, controller: Controller | None, reference: TickReference, recorder: Recorder, to_rest: Pieces | None = None
    ) -> None:
        """Checks a reference, or the motion `to_rest` that it begins; has it played, mirrors and records it."""
        if self.fault:
            raise LinkError(self.blocked)
        assert isinstance(recorder, LinkRecorder)
        recorder.has_begun = True
        self._recorder = recorder
        motion = self._motion_along(reference) if to_rest is None else to_rest
        self.failure = self._interlocked() or self.refusal(motion)
        if not self.failure:
            try:
                self._play(motion, len(reference.q), recorder)
            except LinkError as error:
                self._lose(str(error))

    def _play(self, motion: Pieces, ticks: int, recorder: LinkRecorder) -> None:
        """Has a motion played, and waits for its first ticks, or until the next motion must be planned."""
        is_at_rest = self._stream.moving is None
        goes_on = float(motion.knots[-1]) > ticks * self.dt + 1e-9
        ahead = max(round(_AHEAD_S / self.dt), _AHEAD_TICKS) if goes_on else 0
        played = self._stream.play(motion, ticks, self._arm.limits, ahead)
        if played.late:
            self.late += played.late
            self.come_to_rest(stop=False)
        elif played.fails:
            while self._stream.current is not None:
                self._wait_for(self._stream.current.tick + 1)
        elif played.reason:
            self.failure = f"not sent: {played.reason}" if is_at_rest else f"{played.reason}; the arm came to rest on its path"
        else:
            end = played.first + ticks
            recorder.begin_run(played.first, played.opens)
            recorder.end_run(end)
            self._wait_for(end - 1 - ahead)

    @property
    def moves(self) -> bool:
        """Whether a motion is played, and is not over."""
        stream = self._stream.current
        return stream is not None and stream.tick < stream.end(self.dt)

    def wait(self, seconds: float) -> None:
        """Lets time pass while a motion is played, at least a tick."""
        stream = self._stream.current
        if stream is not None:
            self._wait_for(stream.tick + max(1, round(seconds / self.dt)))

    def open_motion(self, seconds: float) -> Pieces | None:
        """What is left of the motion some seconds from now, from where `run` replaces it next; None if it is over then."""
        left = self._stream.open_motion(max(1, round(seconds / self.dt)))
        if left is None:
            self.come_to_rest(stop=False)
        return left

    def hold(self, seconds: float) -> Array:
        """Streams the present position for a while; the times of the readings, s."""
        recorder = self.recorder()
        self.run(None, hold_reference(self, seconds), recorder)
        self._recorder = None
        return np.concatenate(recorder.times or [np.zeros(0)])

    def instability(self, arm: Arm, controller: Controller, q: Array) -> str:
        """Nothing: a robot follows references with its own controller."""
        return ""

    def come_to_rest(self, *, stop: bool) -> None:
        """Waits until the arm rests; with `stop` it brakes on its path."""
        stream = self._stream.current
        recorder = self._recorder
        try:
            if (stop or self._has_contact) and stream is not None:
                failure = self.failure
                self._stream.stop(_STOPPED)
                while self._stream.current is not None:
                    self._wait_for(self._stream.current.tick + 1)
                self.failure = failure if self.failure == _STOPPED else self.failure
                if recorder is not None:
                    recorder.end_run(None)
            elif stream is not None and stream.moves:
                end = stream.end(self.dt)
                if recorder is not None:
                    recorder.end_run(end + 1)
                self._wait_for(end)
                stream.moves = False
        except LinkError as error:
            self._lose(str(error))

    def recover(self) -> None:
        self._host.recover()
        self.fault = ""
        self.failure = ""

    def refusal(self, motion: Pieces) -> str:
        """Why a motion from now on, or one that continues the present one, must not be sent; empty if it may."""
        moving = self._stream.moving
        return self.check.refusal(motion, None if moving is None else moving.rows)

    def _motion_along(self, reference: TickReference) -> Pieces:
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
        while (stream := self._stream.current) is not None and stream.tick < tick:
            self._stream.let_pass(stream, tick, in_steps=self.reaction is not None or self.interlock is not None)
            self._watch()

    def _watch(self) -> None:
        """Takes the readings since the last call, and what the robot reports."""
        stream = self._stream.current
        progress = self._stream.poll()
        readings = progress.readings
        if self._recorder is not None:
            self._recorder.take(readings)
        for k in range(len(readings.tick)):
            self._mirror.show(readings.t[k], readings.q[k], readings.v[k])
        if stream is not None and self.reaction is not None and len(readings.tick) and not self._has_contact:
            self._detect_contact(self.reaction, stream, readings)
        if self._stream.current is not None and not progress.stopped and (reason := self._interlocked()):
            self._stream.stop(reason)
        if progress.fault:
            self._lose(progress.fault)
        elif progress.stopped and not self.failure:
            self.failure = progress.stopped
        if self.observer is not None and len(readings.sent):
            self.observer(readings.q[-1], readings.sent[-1], self.fault or f"t = {self.data.time:.1f} s")

    def _interlocked(self) -> str:
        """Why the arm must not move now; empty if it may."""
        if self.interlock is None or self._asks:
            return ""
        self._asks = True  # it may look at the state of the robot, and is not asked again by that
        try:
            return str(self.interlock())
        except Exception as error:  # of a caller's function: an arm that nobody can hold back does not move
            return f"the interlock failed ({type(error).__name__}: {error!s:.120})"
        finally:
            self._asks = False

    @property
    def _has_contact(self) -> bool:
        return self.reaction is not None and bool(self.reaction.contact)

    def _detect_contact(self, reaction: ContactReaction, stream: OpenStream, readings: Readings) -> None:
        for k, tick in enumerate(readings.tick.astype(int)):
            dt = self.dt * max(1, tick - stream.monitored)
            stream.monitored = tick
            if dt > max(_LONGEST_GAP_S, 2 * self.dt):
                reaction.force.reset()  # nobody knows the torques in between
                dt = self.dt
            reaction.update(readings.t[k] - self._mirror.t0, readings.q[k], readings.v[k], readings.tau[k], dt)
        if reaction.contact:
            self.time_at_contact = self.dt * max(0, stream.monitored - stream.start)
            self._stream.stop(reaction.reason)

    def _lose(self, fault: str) -> None:
        self._stream.current = None
        self.fault = fault
        self.failure = fault
