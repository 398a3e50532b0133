"""StreamRun: an arm on a stream of targets, and follow: after a moving target, for a given time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.target import Target
from armctl.core.validation import Array, instance, number, shown
from armctl.model.mjmodel.queries import body_named
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.plan.stream.stream import Stream
from armctl.run.execution.move import ControlledArm, RunPurpose
from armctl.run.execution.recorder import Recorder, ticks_for

_FOLLOW_INTERVAL_S = 0.02  # between two readings of a moving target

MovingTarget = str | Callable[[float], Pose | ArrayLike]


class StreamRun:
    """An arm on a stream of targets, in a `with`; `Simulation.streaming` makes it. The log is made when the block ends.

    Attributes:
        stream: Where targets are pushed.
    """

    def __init__(
        self,
        controlled: ControlledArm,
        refusal: Callable[[Pieces], str] | None = None,
        purpose: RunPurpose | None = None,
    ):
        """A run that begins where the arm's last reference ended.

        Args:
            refusal: Why a motion, given as polynomials from now on, may not be made; empty if it may.
            purpose: What the log says of the run; None for a run without a target.
        """
        instance("controlled", controlled, ControlledArm, "Simulation.streaming() makes a StreamRun of its arm")
        self.stream = Stream(controlled.arm, controlled.start, refusal=refusal)
        self._controlled = controlled
        self._drive = controlled.drive
        self._controller = controlled.controller
        self._purpose = RunPurpose() if purpose is None else purpose
        self._recording = controlled.recording(self._purpose)
        self._due = 0.0
        self._recorder: Recorder | None = None

    def __repr__(self) -> str:
        return f"StreamRun({self._controlled.arm.tip!r}, t = {self.stream.t:.4g} s{'' if self._recorder else ', not running'})"

    def __enter__(self) -> StreamRun:
        self._recorder = self._recording.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._recorder = None
        self._purpose.duration = self.stream.t
        self._recording.__exit__(*exception)

    def advance(self, duration: float) -> str:
        """Lets the arm go on along its motion. A robot leaves some time for the next targets.

        Args:
            duration: How long, s; what is left of a tick counts the next time.

        Returns:
            Why the run ended; empty if it goes on.

        Raises:
            InputError: A negative time, one that is too long for a log, or a call outside the `with`.
            SimulationError: The controller failed, or the run ended before.
        """
        if self._recorder is None:
            raise InputError("advance: nothing runs yet; use `with sim.streaming() as run:`")
        dt = self._drive.dt
        self._due += number("duration", duration, 0.0)
        ticks = ticks_for(max(self._due - self.stream.t, 0.0) + dt / 2, dt) - 2
        if ticks > 0:
            to_rest = self.stream.pieces
            begin = self._drive.data.time
            late = self._drive.late
            t = self.stream.t
            reference = self.stream.reference(ticks, dt, self._drive.continuous)
            self._drive.run(self._controller, reference, self._recorder, to_rest)
            if self._drive.late > late:
                self.stream.restart(max(self.stream.t, t + float(self._drive.data.time) - begin), self._controlled.start)
                self._due = self.stream.t
        return self._drive.failure


def follow(
    controlled: ControlledArm, target: MovingTarget, duration: float, refusal: Callable[[Pieces], str] | None = None
) -> Log:
    """Follows a body, or a function of the time, for a duration, s, and reads it 50 times a second."""
    drive = controlled.drive
    data = drive.data
    target_at = _target_function(drive.model, data, target)
    ticks_for(duration, drive.dt)
    begin = data.time
    interval = max(_FOLLOW_INTERVAL_S, drive.dt)
    purpose = RunPurpose()
    with StreamRun(controlled, refusal, purpose) as run:
        while not drive.failure and data.time - begin < duration - 1e-9:
            goal = Target.read(target_at(data.time - begin))
            purpose.target = goal.numbers
            run.stream.push_pose(run.stream.t, goal)
            run.advance(interval)
        purpose.target = Target.read(target_at(data.time - begin)).numbers
    assert controlled.log is not None  # the run is over
    return controlled.log


def _target_function(model: mujoco.MjModel, data: mujoco.MjData, target: MovingTarget) -> Callable[[float], Pose | ArrayLike]:
    """The target as a function of the time since the start, s."""
    if callable(target):

        def called(time: float) -> Pose | ArrayLike:
            try:
                return target(time)
            except Exception as error:
                reason = f"{type(error).__name__}: {error!s:.200}"
                raise InputError(f"target: the function failed at {time:g} s: {reason}") from error

        return called
    if not isinstance(target, str):
        raise InputError(f"target: {shown(target)} is neither the name of a body nor a function of the time")
    body = body_named(model, target)

    def position(_: float) -> Array:
        mujoco.mj_kinematics(model, data)
        return data.xpos[body].copy()

    return position
