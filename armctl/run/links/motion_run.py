"""MotionRun: a robot on whole motions, of which each may replace what is left of the one before."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from armctl.core.trajectory import TickReference
from armctl.core.validation import Array, instance, number
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.path_stop import remaining
from armctl.plan.motion.trajectory.piecewise import JointSamples, Pieces, hermite, joined, quintics, sample, standing
from armctl.run.execution.move import ControlledArm, RunPurpose
from armctl.run.execution.recorder import Recorder
from armctl.run.links.link_drive import LinkDrive

_REPLACED_S = 0.1  # from now, a motion replaces the present one: the time in which it is checked
_MAX_LATE_S = 1.0  # after its end, that an arm at rest still makes a motion: a busy computer gets it late
_MAX_WAIT_S = 60.0  # until a motion begins
_LATE = "the motion came too late, because the computer is busy; the one before is made to its end"
_JOIN_RAD = 0.02  # by which a motion may start beside the arm, or beside the motion that it replaces
_JOIN_SPEED = 0.1  # rad/s, likewise
_JOIN_S = 0.3  # in which such a difference is taken back, or the whole motion if it is shorter
_JOIN_STEP_S = 0.01
_SHIFT_S = 0.3  # by which the time of a motion may differ from that of the arm
_SHIFT_STEP_S = 5e-4
_SAME = 1e-9


class MotionRun:
    """A robot on whole motions, in a `with`; `Robot.playing` makes it. The log is made when the block ends."""

    def __init__(
        self,
        controlled: ControlledArm,
        drive: LinkDrive,
        refusal: Callable[[Pieces], str],
        provable: Callable[[JointTrajectory], JointTrajectory | None],
    ):
        """A run of an arm at rest.

        Args:
            controlled: What moves, with its controller.
            drive: Its drive.
            refusal: Why a motion from now on may not be made; empty if it may.
            provable: A motion, slowed down as far as needed; None if it may not be made.
        """
        instance("controlled", controlled, ControlledArm, "robot.playing() makes a run of a robot")
        self._controlled = controlled
        self._drive = drive
        self._refusal = refusal
        self._provable = provable
        self._recording = controlled.recording(RunPurpose())
        self._recorder: Recorder | None = None
        self._late = 0.0  # s, by which the present motion began later than its sender said

    def __enter__(self) -> MotionRun:
        self._recorder = self._recording.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._recorder = None
        self._recording.__exit__(*exception)

    @property
    def moves(self) -> bool:
        """Whether a motion is made now."""
        return self._drive.moves

    @property
    def q(self) -> Array:
        """(n,) rad, where the last motion ends."""
        return self._controlled.start

    def play(self, motion: JointTrajectory, since: float = 0.0, *, slow: bool = False) -> str:
        """Replaces what is left by a motion that begins where the arm is commanded to be.

        A small difference at its start, as that between a command and a measurement, is taken back in its first 0.3 s. While
        the arm moves, the motion must agree with what it replaces at the time from which on it counts, 0.1 s from now;
        otherwise the arm brakes on its path, because somebody wants another motion than the present one.

        Args:
            motion: The motion, to rest.
            since: s, how long ago it began; negative if it begins later, at most 60 s from now. An arm at rest makes a motion
                that began before from its start, unless it would have ended 1 s ago.
            slow: Whether it is slowed down where the tip or a joint near the end of its range is too fast; otherwise it is not
                made then.

        Returns:
            Why it is not made; empty if it is.

        Raises:
            InputError: A time that is not a finite number.
        """
        since = number("since", since)
        if slow:
            slowed = self._provable(motion)
            if slowed is None:
                return self._refusal(motion.pieces)
            motion = slowed
        if not -_MAX_WAIT_S <= since <= motion.duration + _MAX_LATE_S:
            return (
                f"the motion begins {since:.3g} s before now and takes {motion.duration:.3g} s; its stamp must be of this "
                "computer's time, or zero"
            )
        left = self._drive.open_motion(_REPLACED_S)
        is_moving = left is not None
        if left is None:
            left = standing(self._controlled.start)
            pieces = _delayed(motion.pieces, -since)
            late = max(since, 0.0)
        else:
            expected = since + _REPLACED_S
            time = _time_in(motion.pieces, _first(left), expected - self._late)
            pieces = remaining(motion.pieces, time)
            late = expected - time
        now = _first(left)
        first = _first(pieces)
        gaps = np.abs(now.q - first.q)
        joint = int(gaps.argmax())
        if gaps[joint] > _JOIN_RAD or np.abs(now.v - first.v).max() > _JOIN_SPEED:
            if is_moving:
                self.stop()
            braked = "; the arm braked on its path" if is_moving else ""
            return (
                f"{motion.joint_names[joint]} is commanded to {now.q[joint]:.4f} rad at {now.v[joint]:.3f} rad/s, but the "
                f"motion has {first.q[joint]:.4f} rad at {first.v[joint]:.3f} rad/s then{braked}; plan from where the arm is"
            )
        pieces = _joined(pieces, now)
        reason = self._refusal(pieces) or self._begin(pieces)
        if not reason:
            self._late = late
        return reason

    def _begin(self, pieces: Pieces) -> str:
        """Has a motion played, and does not wait for it. Why it is not; empty if it is."""
        row = TickReference(*(column[:1] for column in (*sample(pieces, np.zeros(1)), *sample(pieces, np.zeros(1))[1:])))
        late = self._drive.late
        assert self._recorder is not None  # inside the `with`
        self._drive.run(self._controlled.controller, row, self._recorder, pieces)
        return _LATE if self._drive.late > late else self._drive.failure

    def advance(self, duration: float) -> str:
        """Lets the arm go on along its motion.

        Args:
            duration: How long, s; at least a tick.

        Returns:
            Why the motion ended early; empty if it did not.

        Raises:
            InputError: A time that is negative or not finite.
        """
        self._drive.wait(number("duration", duration, 0.0))
        return self._drive.failure

    def stop(self) -> None:
        """Brakes on the path, and waits for rest."""
        self._drive.come_to_rest(stop=True)
        self._controlled.resume()


def _time_in(pieces: Pieces, now: JointSamples, since: float) -> float:
    """The time of a motion, near the one that was given, at which it is most like the arm's motion now."""
    times = np.arange(max(since - _SHIFT_S, 0.0), max(since, 0.0) + _SHIFT_S, _SHIFT_STEP_S)
    rows = sample(pieces, times)
    gaps = np.linalg.norm(rows.q - now.q, axis=1) + _SHIFT_S * np.linalg.norm(rows.v - now.v, axis=1)
    best = int(gaps.argmin())
    # One step of Newton's method for the distance of the positions.
    v = rows.v[best]
    speed = float(v @ v)
    correction = float(v @ (now.q - rows.q[best])) / speed if speed > _SAME else 0.0
    time = float(times[best]) + float(np.clip(correction, -_SHIFT_STEP_S, _SHIFT_STEP_S))
    return min(max(time, 0.0), float(pieces.knots[-1]))


def _delayed(pieces: Pieces, seconds: float) -> Pieces:
    """A motion that begins later; at once if the time is not above 0."""
    if seconds <= 0.0:
        return pieces
    before = standing(pieces.coefficients[0, 0])
    return joined([Pieces(np.array([0.0, seconds]), before.coefficients), pieces])


def _first(pieces: Pieces) -> JointSamples:
    """The state at the start, each (n,)."""
    return JointSamples(*(x[0] for x in sample(pieces, np.zeros(1))))


def _joined(pieces: Pieces, now: JointSamples) -> Pieces:
    """A motion that starts in another state, the difference from which vanishes with a polynomial of degree five."""
    first = sample(pieces, np.zeros(1))
    gap = JointSamples(now.q - first.q, now.v - first.v, now.a - first.a)
    end = min(_JOIN_S, float(pieces.knots[-1]))
    if end == 0.0 or max(np.abs(column).max() for column in gap) < _SAME:
        return pieces
    rest = JointSamples(*(np.zeros_like(column) for column in gap))
    difference = Pieces(np.array([0.0, end]), quintics(np.array([end]), gap, rest))
    grid = np.linspace(0.0, end, 2 + int(end / _JOIN_STEP_S))
    times = _apart(np.union1d(grid, pieces.knots))
    rows = sample(pieces, times)
    added = sample(difference, times)
    return hermite(times, *(row + more for row, more in zip(rows, added, strict=True)))


def _apart(times: Array) -> Array:
    """Increasing times without those that follow another one at once."""
    return times[np.append(True, np.diff(times) > 1e-6)]
