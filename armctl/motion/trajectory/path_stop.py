"""A stop on the path: the same way in joint space, its pace brought from 1 to 0 without leaving the limits.

With the motion q(u) and the pace w = du/dt, w falls from 1 to 0, and its slope is a trapezoid, so that the jerk is bounded.
Later and longer falls are tried until one keeps the limits; where none is sooner, the motion's own end is the stop.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.validation import Array
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.motion.trajectory.piecewise import hermite

_DELAYS = 12
_SHORTEST, _GROWTH = 0.01, 1.15  # s, and from one length of a fall to the next
_RAMP = 0.2  # of a fall, in which its slope grows
_CUTS = 20  # of a fall
_APART = 2e-5  # s, between cuts
_REST = 1e-6  # rad/s
_SLIVER = 1e-9  # s, too short for a piece


def stopped(trajectory: JointTrajectory, t: float) -> JointTrajectory:
    """A motion that leaves another at a time and stops on its path.

    Args:
        trajectory: The motion.
        t: s, when the stop is asked for.

    Returns:
        The motion up to there and the soonest stop that was found.

    Raises:
        PlanError: None was found, and the motion does not end at rest.
    """
    left, best, soonest = trajectory.duration - t, None, np.inf
    for delay in np.linspace(0.0, 0.9 * left, _DELAYS):
        fall = _SHORTEST
        while delay + fall < soonest and delay + fall / 2 <= left:
            stop = _falling(trajectory, t + delay, fall)
            if stop is not None and stop.check_limits().ok:
                best, soonest = (t + delay, stop), delay + fall
                break
            fall *= _GROWTH
    rests = np.abs(trajectory(trajectory.duration).v).max() < _REST
    if best is None and not rests:
        raise PlanError(f"stopped_at: no stop on the path inside the limits from {t:.4g} s on; stop sooner")
    if best is None or (rests and soonest >= left):
        return trajectory
    return _until(trajectory, best[0], best[1])


def _falling(trajectory: JointTrajectory, begin: float, fall: float) -> JointTrajectory | None:
    """The motion from `begin` on, its pace falling to 0; None where it is seen to leave the limits."""
    x = np.concatenate([np.linspace(0.0, 1.0, _CUTS + 1), [_RAMP, 1 - _RAMP], _crossings(trajectory, begin, fall)])
    x = np.unique(x)
    x = np.append(x[:-1][np.diff(x) * fall > _APART], 1.0)
    gone, w, slope = _fall(x)
    q, v, a = trajectory.sample(np.minimum(begin + fall * gone, trajectory.duration))[:3]
    w, slope = w[:, None], slope[:, None] / fall
    v, a = v * w, a * w**2 + v * slope
    if (np.abs(a) > (1 + 1e-6) * trajectory.limits.a_max).any():
        return None
    pieces = hermite(fall * x, q, v, a)
    return replace(trajectory, knots=pieces.knots, coefficients=pieces.coefficients)


def _fall(x: Array) -> tuple[Array, Array, Array]:
    """Way gone, pace and slope of the pace, for a share x of a fall: the slope is a trapezoid of area -1."""
    top = 1 / (1 - _RAMP)
    rise = top / _RAMP
    up, down = np.minimum(x, _RAMP), np.maximum(x - (1 - _RAMP), 0.0)
    flat = np.maximum(x - _RAMP, 0.0)
    slope = rise * (up - down)
    w = 1 - rise * (up**2 / 2 + _RAMP * flat - down**2 / 2)
    gone = x - rise * (up**3 / 6 + _RAMP**2 / 2 * flat + _RAMP * flat**2 / 2 - down**3 / 6)
    return gone, w, -slope


def _crossings(trajectory: JointTrajectory, begin: float, fall: float) -> Array:
    """The shares of a fall at which it crosses the knots of the motion."""
    x = np.linspace(0.0, 1.0, 400)
    knots = trajectory.knots[(trajectory.knots > begin) & (trajectory.knots < begin + fall / 2)]
    return np.interp((knots - begin) / fall, _fall(x)[0], x)


def _until(trajectory: JointTrajectory, t: float, rest: JointTrajectory) -> JointTrajectory:
    """A motion up to a time, and then another."""
    k = int(np.searchsorted(trajectory.knots, t, side="left"))
    if k > 0 and t - trajectory.knots[k - 1] < _SLIVER:
        k, t = k - 1, float(trajectory.knots[k - 1])
    if k == 0:
        return rest
    knots = np.append(trajectory.knots[:k], t)
    return JointTrajectory.joined([replace(trajectory, knots=knots, coefficients=trajectory.coefficients[:k]), rest])
