"""solve_ik: joint positions for one target."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import Array, frozen, number
from armctl.errors import InputError
from armctl.ik.problem import POSITION, Chain, PoseOrPoint, Target, chain_of
from armctl.ik.result import IkResult

STARTS = 100
FARTHEST = 1e3  # reaches; a target beyond is pulled in along its line, where the solver still sees differences


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
    from armctl.ik import kernel

    goal = Target.read(target, free_axis)
    off_max = number("position_tolerance", position_tolerance, 1e-12)
    turned_max = number("orientation_tolerance", orientation_tolerance, 1e-12)
    start = arm.home if q0 is None else arm.limits.check("q0", q0, arm.joint_names)
    if not isinstance(rng, int):
        raise InputError(f"rng: {rng!r} given, the seed of the random starts wanted: an integer")
    chain = chain_of(arm)
    packed, q = _packed(goal, chain), np.empty(arm.n)
    first = start / chain.unit
    _, starts, steps = kernel.search(
        chain.rows, packed, goal.asked, off_max / chain.reach, turned_max, first, 0, STARTS, rng & (2**63 - 1), q
    )
    found = _judged(arm, goal, q, chain)
    if found[1] <= off_max and found[2] <= turned_max:
        return IkResult(True, *found, "", steps, starts)
    return _best_effort(arm, goal, chain, packed, q, off_max, steps, starts)


def _best_effort(
    arm: Arm, goal: Target, chain: Chain, packed: Array, q: Array, off_max: float, steps: int, starts: int
) -> IkResult:
    """The nearest the tip can come: if the point is out of reach as close to it as possible, or else the least error."""
    from armctl.ik import kernel

    near = q.copy()
    kernel.search(chain.rows, packed, POSITION, off_max / chain.reach, 0.0, q, 0, 10, 0, near)
    kernel.settle(chain.rows, packed, POSITION, near)
    nearest = _judged(arm, goal, near, chain)
    if nearest[1] > off_max:
        return IkResult(False, *nearest, f"{_length(nearest[1])} out of reach", steps, starts)
    kernel.settle(chain.rows, packed, goal.asked, q)
    reason = f"no solution within the joint limits found in {starts} starts"
    return IkResult(False, *_judged(arm, goal, q, chain), reason, steps, starts)


def _judged(arm: Arm, goal: Target, q: Array, chain: Chain) -> tuple[Array, float, float]:
    """A solver's answer in joint units, inside the limits, and its residual by the arm's own forward kinematics."""
    inside = frozen(arm.limits.clamp(q * chain.unit))
    return inside, *goal.residual(*arm.rigid_body.tip(inside))


def _packed(goal: Target, chain: Chain) -> Array:
    """(12,) rotation and translation in reaches."""
    packed = np.empty(12)
    packed[:9] = goal.rotation.ravel()
    packed[9:] = goal.position / chain.reach
    base = chain.rows[0, 9:12]
    distance = math.dist(packed[9:], base)
    if distance > FARTHEST:
        packed[9:] = base + (packed[9:] - base) * (FARTHEST / distance)
    return packed


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres < 1e3 else f"{metres:.0f} m"
