"""move_back: the way of a run, from its end to its beginning."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.validation import Array, instance, number
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import planning_arm
from armctl.plan.motion.timing.end_limits import slowed_into
from armctl.plan.motion.torque_limits import within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import stretch_needed
from armctl.plan.motion.trajectory.piecewise import hermite, standing, time_scaled

_GRID_S = 0.02  # between two samples of the way; a jerk-limited motion between them is a polynomial to micrometers
_SAME_RAD = 1e-4  # rad (m): a smaller difference between the end of the run and the arm is that of its last reference
_MIN_SAMPLES = 6  # that determine a polynomial of degree five


def move_back(arm: Arm, log: Log, start: ArrayLike, speed: float = 1.0) -> JointTrajectory:
    """A motion along the path that the reference of a run took, from its end to its beginning, within all limits.

    Args:
        arm: The arm of the run.
        log: The run.
        start: (n,) rad, where the arm is: where the reference of the run ended.
        speed: Fraction of the speed of the run, in (0, 1].

    Raises:
        InputError: The run is one of another arm, it has no reference, or the arm is not where it ended.
        PlanError: A motor cannot hold the arm at some point of the way.
    """
    from scipy.interpolate import make_interp_spline

    planning = planning_arm(arm, 1.0)
    speed = number("speed", speed, 1e-3, 1.0)
    q = _way(planning, log, arm.checked("start", start))
    ticks = np.flatnonzero((q != q[-1]).any(axis=1))
    if not len(ticks):
        return JointTrajectory(*standing(q[-1]), arm.joint_names, arm.limits, units=arm.units)
    q = q[: ticks[-1] + 2][::-1]
    duration = log.dt * (len(q) - 1)
    samples = max(_MIN_SAMPLES, round(duration / _GRID_S) + 1)
    rows = np.unique(np.round(np.linspace(0, len(q) - 1, samples)).astype(int))
    times = log.dt * rows.astype(np.float64)
    if len(rows) < 2:
        return JointTrajectory(*standing(q[-1]), arm.joint_names, arm.limits, units=arm.units)
    rest = [(1, np.zeros(arm.n)), (2, np.zeros(arm.n))]
    spline = make_interp_spline(times, q[rows], k=5, bc_type=(rest, rest))
    pieces = hermite(times, spline(times), spline(times, 1), spline(times, 2))
    limits = planning.limits
    stretch = stretch_needed(pieces, (limits.v_max, limits.a_max, limits.j_max))
    pieces = slowed_into(time_scaled(pieces, speed * min(1.0, 1.0 / stretch)), limits)
    return within_torque(arm, JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units))


def _way(arm: Arm, log: Log, start: Array) -> Array:
    """(T, n) rad, the reference of a run that ended where the arm is."""
    instance("log", log, Log, "every move that is not refused gives one")
    if log.joint_names != arm.joint_names:
        raise InputError(f"log: it is of {log.robot:.60} with {len(log.joint_names)} joints, not of {arm.name:.60}")
    if len(log) == 0 or not np.isfinite(log.q_ref).all():
        raise InputError("log: the run has no reference whose way could be gone back")
    gap = np.abs(log.q_ref[-1] - start)
    joint = int(gap.argmax())
    if gap[joint] > _SAME_RAD:
        raise InputError(
            f"log: {arm.joint_names[joint]} ended at {log.q_ref[-1, joint]:.4g} {arm.units[joint]}, and is at "
            f"{start[joint]:.4g} {arm.units[joint]} now; only the way of the last motion can be gone back"
        )
    return np.vstack([log.q_ref[:-1], start])
