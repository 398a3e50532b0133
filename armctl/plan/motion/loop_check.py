"""Closed loops during a motion: each has to stay closed, with its passive joints inside their limits."""

import numpy as np

from armctl._core import MAX_DEGREE
from armctl.core.errors import PlanError
from armctl.core.trajectory import Trajectory
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, sample

_INTERVAL_S = 0.002  # of a motion that has no polynomials


def check_loops(arm: Arm, motion: Trajectory | Pieces) -> None:
    """Raises PlanError if a motion is not known to keep closed loops closed; nothing happens for an arm without loops.

    A motion of polynomials is proved as a whole, any other is checked at samples.
    """
    closure = arm.joint_map.closure
    if closure is None:
        return
    if isinstance(motion, (JointTrajectory, Pieces)) and motion.coefficients.shape[1] <= MAX_DEGREE + 1:
        time = closure.first_break(motion.knots, motion.coefficients)
        if time is None:
            return
        reason = closure.first_refusal(_sampled(motion, np.array([time])))[1]
        where = f"the motion leaves where its closed loops are known to close, at {time:.3f} s"
        raise PlanError(f"{where}: {reason}" if reason else where)
    duration = float(motion.knots[-1]) if isinstance(motion, Pieces) else motion.duration
    times = np.linspace(0.0, duration, 2 + int(duration / _INTERVAL_S))
    row, reason = closure.first_refusal(_sampled(motion, times))
    if reason:
        raise PlanError(f"{reason}, at {times[row]:.3f} s of the motion")


def _sampled(motion: Trajectory | Pieces, times: Array) -> Array:
    """(T, n) rad."""
    return sample(motion, times).q if isinstance(motion, Pieces) else motion.sample(times).q
