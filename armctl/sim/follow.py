"""follow: an arm after a moving target, for a given time."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.target import Target
from armctl.core.validation import Array, shown
from armctl.mjmodel.queries import object_id
from armctl.motion.trajectory.piecewise import Pieces
from armctl.robot.arm import Arm
from armctl.sim.move import ControlledArms
from armctl.sim.recorder import ticks_for
from armctl.stream.stream import Stream

_FOLLOW_INTERVAL_S = 0.02  # between two readings of a moving target

MovingTarget = str | Callable[[float], Pose | ArrayLike]


def follow(
    arms: ControlledArms, arm: Arm, target: MovingTarget, seconds: float, refusal: Callable[[Pieces], str] | None = None
) -> Log:
    """Follows a body, or a function of the time, and reads it 50 times a second. Arguments as for `Simulation.follow`.

    Args:
        refusal: As for `Stream`.
    """
    drive = arms.drive
    data = drive.data
    target_at = _target_function(drive.model, data, target)
    ticks_for(seconds, drive.dt)
    begin = data.time
    stream = Stream(arm, arms.start(arm.tip), refusal=refusal)
    ticks = ticks_for(_FOLLOW_INTERVAL_S, drive.dt) - 1
    targets: dict[str, Array] = {}
    with arms.recording({arm.tip: seconds}, targets) as recorder:
        while not drive.failure and data.time - begin < seconds - 1e-9:
            goal = Target.read(target_at(data.time - begin))
            targets[arm.tip] = goal.numbers
            stream.push_pose(stream.t, goal)
            to_rest = stream.pieces
            drive.run(arms.controllers[arm.tip], stream.reference(ticks, drive.dt, drive.continuous), recorder, to_rest)
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
    body = object_id(model, mujoco.mjtObj.mjOBJ_BODY, target)
    if body < 0:
        raise UnknownNameError.of("body", target, [model.body(i).name for i in range(1, model.nbody)])

    def position(_: float) -> Array:
        mujoco.mj_kinematics(model, data)
        return data.xpos[body].copy()

    return position
