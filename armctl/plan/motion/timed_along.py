"""The motion along a smooth path of the joints: as fast as velocity, acceleration, jerk, torque and the caps of tips allow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from armctl.core.limits import Limits
from armctl.model.arm.arm import Arm
from armctl.plan.motion.path.joint_path import JointPath
from armctl.plan.motion.path.tip_caps import TipCaps
from armctl.plan.motion.sections import Section, is_limited, within_sections
from armctl.plan.motion.timing.otg import slowed_to_bounds
from armctl.plan.motion.timing.path_timing import time_optimal
from armctl.plan.motion.torque_limits import within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, joints_of

FINE = 2  # times as many intervals, for paths whose curvature changes from point to point


class TimedPath(NamedTuple):
    """A motion along a path."""

    motion: JointTrajectory
    free: Pieces  # the motion without torque limits and limits of sections; the last column is the length


def timed_along(
    arm: Arm,
    limits: Limits,
    path: JointPath,
    options: Mapping[str, Any],
    *,
    tips: tuple[str, ...] | None = None,
    fineness: int = 1,
    sections: Sequence[Section] = (),
    ends: Sequence[float] = (),
) -> TimedPath:
    """The motion along a path within limits, which are those at its speed; the options are `PathOptions`, for the first tip.

    `sections` are what holds on parts of it, and `ends` the lengths at which they end.
    """
    speed = options.get("speed", 1.0)
    caps = TipCaps.from_path(arm, path, speed, options.get("tip_speed"), options.get("tip_angular_speed"), tips)
    pieces = time_optimal(path, limits, caps, fineness=fineness)
    free = JointTrajectory(
        *slowed_to_bounds(joints_of(pieces), limits.larger_sides), arm.joint_names, arm.limits, units=arm.units
    )
    if any(map(is_limited, sections)):
        times = np.interp(ends, pieces.coefficients[:, 0, -1], free.knots[:-1])
        motion = within_sections(arm, free, np.append(times[:-1], free.duration), sections)
    else:
        motion = within_torque(arm, free)
    return TimedPath(motion if caps is None else caps.kept(motion), pieces)
