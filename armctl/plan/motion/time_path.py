"""time_path: the fastest motion along a path of the joints that is given: a spline, a function, points, a recorded motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import LimitError
from armctl.core.limits import Limits
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import planning_arm, read_duration
from armctl.plan.motion.given_duration import lasting
from armctl.plan.motion.path.given_path import GivenPath, SplineLike, read_path
from armctl.plan.motion.timing.end_limits import slowed_into
from armctl.plan.motion.timing.otg import slowed_to_bounds
from armctl.plan.motion.timing.path_timing import time_optimal
from armctl.plan.motion.torque_limits import within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import REST_SPEED, has_continuous_acceleration, is_inside, stretch_needed
from armctl.plan.motion.trajectory.piecewise import Pieces, joints_of, sample, time_scaled

_SHORT_S = 1e-4  # in which no motion worth timing is possible
_FINENESS = 8  # of the timing: its path is known, and nothing else takes time


def time_path(
    arm: Arm,
    path: ArrayLike | SplineLike | JointTrajectory,
    interval: tuple[float, float] | None = None,
    *,
    parameters: ArrayLike | None = None,
    derivatives: ArrayLike | None = None,
    speed: float = 1.0,
    duration: float | None = None,
) -> JointTrajectory:
    """The fastest motion along a given path of the joints, from rest to rest, within all limits.

    The path stays as it is, and only the time along it is chosen: time-optimal path parameterization with limits of speed,
    acceleration and jerk. If a motor would saturate, the motion gets the best speed with torque limits, and `slowed` contains
    the factor. `move_through` is faster through points, because it also chooses the path between them.

    Args:
        path: A spline of SciPy over any parameter, or a path of toppra; a function `path(s, order)` with the derivatives of
            order 0 to 3 at parameters (T,), each (T, n) rad; points (k, n) rad, through which a cubic spline leads; or a
            `JointTrajectory`, of which only the path counts. Its first two derivatives must not jump, and the first must not
            vanish on the way.
        interval: The parameter at the start and at the end; those of the spline if left out.
        parameters: (k,) the parameters of points; their distances if left out.
        derivatives: (k, n) the first derivatives at points, by their parameters.
        speed: Fraction of the full speed, in (0, 1]; 0.5 takes twice as long.
        duration: s, how long it takes; as short as possible if left out.

    Raises:
        InputError: No such path, one of other joints, or one with a corner, a jump of its curvature, or a number that is not
            finite.
        LimitError: The path leaves the position limits; it is not changed.
        PlanError: The limits differ too much to compute a speed, a motor cannot hold the arm at some point of the path, or the
            duration is too short.
    """
    planning = planning_arm(arm, speed, is_signed=True)
    seconds = read_duration(duration)
    given = read_path(arm, path, interval, parameters, derivatives)
    _require_positions(arm, given)
    limits = planning.limits
    pieces = time_optimal(given, limits, None, given.knots, _FINENESS)
    free = slowed_to_bounds(joints_of(pieces), limits.larger_sides)
    if isinstance(path, JointTrajectory):
        as_given = _at_one_speed(path.pieces, limits.symmetric)
        if as_given is not None and as_given.knots[-1] < free.knots[-1]:
            free = as_given
    motion = JointTrajectory(*free, arm.joint_names, arm.limits, units=arm.units)
    if not is_inside(free, arm.limits):
        raise LimitError(f"path: {motion.check_limits().violations[0]}; move the path inside the limits")
    return lasting(arm, within_torque(arm, motion), seconds)


def _at_one_speed(pieces: Pieces, limits: Limits) -> Pieces | None:
    """A motion as fast as it can be at one speed; None if it does not rest at its ends, or its acceleration jumps.

    Along a way of micrometers, or of a motion that is time-optimal for each joint, this may be faster than the timing.
    """
    states = sample(pieces, pieces.knots[[0, -1]])
    if max(np.abs(states.v).max(), np.abs(states.a).max()) > REST_SPEED:
        return None
    short = time_scaled(pieces, float(pieces.knots[-1]) / _SHORT_S)
    fastest = time_scaled(short, 1 / stretch_needed(short, (limits.v_max, limits.a_max, limits.j_max)))
    fastest = slowed_into(fastest, limits)
    return fastest if has_continuous_acceleration(fastest, limits) else None


def _require_positions(arm: Arm, path: GivenPath) -> None:
    """Refuses a path that leaves the position limits at one of its samples. Raises LimitError."""
    s = np.union1d(np.linspace(0.0, path.length, 1000), path.knots)
    q = path.derivatives(s)[0]
    arm.check_units("path", q)
    limits = arm.limits
    excess = np.maximum(q - limits.q_max, limits.q_min - q)
    k, i = np.unravel_index(int(excess.argmax()), excess.shape)
    if excess[k, i] > 1e-9:
        raise LimitError(
            f"path: {arm.joint_names[i]} is at {q[k, i]:.6g} {arm.units[i]}, {s[k]:.4g} after the start of the path, but its "
            f"range is [{limits.q_min[i]:.6g}, {limits.q_max[i]:.6g}]; move the path inside"
        )
