"""StreamRun: an arm on a stream of targets, and follow: after a moving target, for a given time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mujoco
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.target import Target
from armctl.core.validation import Array, instance, number, shown
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.mjmodel.queries import body_named
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.plan.stream.stream import Stream
from armctl.run.execution.move import ControlledArms
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
        arms: ControlledArms,
        arm: Arm,
        refusal: Callable[[Pieces], str] | None = None,
        targets: Mapping[str, Array] | None = None,
    ):
        """A run that begins where the arm's last reference ended.

        Args:
            refusal: Why a motion, given as polynomials from now on, may not be made; empty if it may.
            targets: (7,) of each arm, for the log; changes until the end of the run count. None for no targets.
        """
        instance("arms", arms, ControlledArms, "Simulation.streaming() makes a StreamRun of its arms")
        check_arm(arm)
        self.stream = Stream(arm, arms.start(arm.tip), refusal=refusal)
        self._arms = arms
        self._drive = arms.drive
        self._controller = arms.controllers[arm.tip]
        self._durations: dict[str, float] = {}
        self._tip = arm.tip
        self._recording = arms.recording(self._durations, targets)
        self._due = 0.0
        self._recorder: Recorder | None = None

    def __repr__(self) -> str:
        return f"StreamRun({self._tip!r}, t = {self.stream.t:.4g} s{'' if self._recorder else ', not running'})"

    def __enter__(self) -> StreamRun:
        self._recorder = self._recording.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._recorder = None
        self._durations[self._tip] = self.stream.t
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
                self.stream.restart(max(self.stream.t, t + float(self._drive.data.time) - begin), self._arms.start(self._tip))
                self._due = self.stream.t
        return self._drive.failure


def follow(
    arms: ControlledArms, arm: Arm, target: MovingTarget, duration: float, refusal: Callable[[Pieces], str] | None = None
) -> Log:
    """Follows a body, or a function of the time, for a duration, s, and reads it 50 times a second."""
    drive = arms.drive
    data = drive.data
    target_at = _target_function(drive.model, data, target)
    ticks_for(duration, drive.dt)
    begin = data.time
    interval = max(_FOLLOW_INTERVAL_S, drive.dt)
    targets: dict[str, Array] = {}
    with StreamRun(arms, arm, refusal, targets) as run:
        while not drive.failure and data.time - begin < duration - 1e-9:
            goal = Target.read(target_at(data.time - begin))
            targets[arm.tip] = goal.numbers
            run.stream.push_pose(run.stream.t, goal)
            run.advance(interval)
        targets[arm.tip] = Target.read(target_at(data.time - begin)).numbers
    return arms.logs[arm.tip]


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
