"""solve_ik: joint positions for one target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import Array, frozen, number
from armctl.errors import InputError
from armctl.ik import lm
from armctl.ik.problem import PoseOrPoint, Problem, Target, chain_of
from armctl.ik.result import IkResult

STARTS = 200


def solve_ik(
    arm: Arm,
    target: PoseOrPoint,
    q0: ArrayLike | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    rng: int = 0,
) -> IkResult:
    """Joint positions that bring the tip to a target, inside the joint limits.

    Args:
        arm: The arm.
        target: A Pose, or (3,) m for position only.
        q0: (n,) rad, where to start; the solution is near it where possible. Left out, the arm's home.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.
        rng: The seed of the random starts.

    Returns:
        The result; where `ok` is False it holds the best effort and says why.

    Raises:
        InputError: An argument of the wrong shape, kind or value.
        LimitError: q0 is outside the joint limits.
    """
    goal = Target.read(target, free_axis)
    off_max = number("position_tolerance", position_tolerance, 1e-12)
    turned_max = number("orientation_tolerance", orientation_tolerance, 1e-12)
    start = arm.home if q0 is None else arm.limits.check("q0", q0, arm.joint_names)
    if not isinstance(rng, int):
        raise InputError(f"rng: {rng!r} given, the seed of the random starts wanted: an integer")
    problem = Problem(arm, chain_of(arm), goal.asked, goal.numbers[None], start[None], off_max, turned_max, rng)
    q, tally = lm.search(problem, 0, STARTS)
    q = lm.stay_near(problem, q, tally)
    _, starts, steps, _ = tally[0].tolist()
    off, turned = (float(error[0]) for error in problem.residuals(q))
    if off <= off_max and turned <= turned_max:
        return IkResult(True, frozen(q[0]), off, turned, "", steps, starts)
    q, out_of_reach = lm.best_effort(problem, q)
    off, turned = (float(error[0]) for error in problem.residuals(q))
    reason = f"no solution within the joint limits found in {starts} starts"
    if out_of_reach[0]:
        reason = f"{_length(off)} out of reach"
    return IkResult(False, frozen(q[0]), off, turned, reason, steps, starts)


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres < 1e3 else f"{metres:.0f} m"
