"""An IK problem in numbers: the chain packed for the compiled solver, the target, and the residual that judges an answer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.limits import Limits
from armctl.core.pose import Pose
from armctl.core.validation import Array, BoolArray, IntArray, frozen, matrix, number, vector
from armctl.robot.arm import Arm, check_arm

PoseOrPoint: TypeAlias = Pose | ArrayLike

POSE, POSITION, FREE_X, FREE_Y, FREE_Z = range(5)  # what of the tip is asked for
_FREE = {"x": FREE_X, "y": FREE_Y, "z": FREE_Z}


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain as the compiled solver takes it, its lengths in units of the reach.

    Attributes:
        rows: (k + 1, 18): for each of its k joints rotation, translation, 1 for a slide joint, bounds, leader, ratio, period,
            as the kernels explain; the last row is the tip.
        reach: m, the arm stretched out: the unit of length.
        unit: (n,) what one unit of each of the arm's joints is: 1 rad, or the reach for a slide joint.
        slides: Whether any of them slides.
        limits: The arm's.
    """

    rows: Array
    reach: float
    unit: Array
    slides: bool
    limits: Limits

    def units(self, q: Array) -> Array:
        """Joint positions in the solver's units.

        Args:
            q: (N, n) rad (m for a slide joint).

        Returns:
            (N, n).
        """
        return q / self.unit if self.slides else q

    def joints(self, q: Array) -> Array:
        """Joint positions from the solver's units.

        Args:
            q: (N, n), inside the bounds of `rows`.

        Returns:
            (N, n) rad (m for a slide joint), inside the joint limits.
        """
        return self.limits.clamp(q * self.unit) if self.slides else q


class Problem(NamedTuple):
    """N targets for one arm, of one kind, with what a solver needs to know.

    Attributes:
        arm: The arm.
        chain: Its packed chain.
        asked: What of the tip is asked for.
        targets: (N, 12).
        q0: (N, n) rad, where to start.
        position_tolerance: m.
        orientation_tolerance: rad.
        seed: Of the random starts.
    """

    arm: Arm
    chain: Chain
    asked: int
    targets: Array
    q0: Array
    position_tolerance: float
    orientation_tolerance: float
    seed: int

    def rows(self, which: IntArray) -> Problem:
        """The same problem for some of its targets.

        Args:
            which: (K,) their numbers.

        Returns:
            K targets.
        """
        return self._replace(targets=self.targets[which], q0=self.q0[which])

    def residual(self, q: Array) -> tuple[float, float]:
        """How far the tip is from the first target, by the arm's own forward kinematics.

        Args:
            q: (n,) rad.

        Returns:
            m, and rad of what of the orientation is asked for.
        """
        return compiled().residual(self.asked, self.targets[0], *self.arm.pinocchio_model.tip(q))

    def residuals(self, q: Array) -> tuple[Array, Array]:
        """How far the tip is from each target.

        Args:
            q: (N, n) rad.

        Returns:
            (N,) m, and (N,) rad of what of the orientation is asked for.
        """
        off, turned = np.empty(len(q)), np.empty(len(q))
        compiled().residuals(self.asked, self.targets, *self.arm.pinocchio_model.tips(q), off, turned)
        return off, turned


@cache
def compiled() -> ModuleType:
    """The compiled kernels; numba is imported when they are first used."""
    from armctl.ik import kernel

    return kernel


def read_target(target: PoseOrPoint, free_axis: str | None) -> tuple[int, Array]:
    """A caller's target, checked.

    Args:
        target: A Pose, or (3,) m for position only.
        free_axis: "x", "y" or "z", the tip's axis about which the target may be turned; None fixes all three.

    Returns:
        What of the tip is asked for, and (12,): rotation row by row (zeros for a point), position.

    Raises:
        InputError: Neither a Pose nor three finite numbers, or no such axis.
    """
    if isinstance(target, Pose):
        return asked_for(True, free_axis), target.rows.reshape(12)
    asked, numbers = asked_for(False, free_axis), np.zeros(12)
    numbers[9:] = vector("target", target, 3)
    return asked, frozen(numbers)


def asked_for(is_pose: bool, free_axis: str | None) -> int:
    """What of the tip is asked for.

    Args:
        is_pose: Whether the target is a pose rather than a point.
        free_axis: As for `read_target`.

    Returns:
        POSE, POSITION, FREE_X, FREE_Y or FREE_Z.

    Raises:
        InputError: No such axis, or an axis beside a point.
    """
    if free_axis is None:
        return POSE if is_pose else POSITION
    if free_axis not in _FREE:
        raise InputError(f"free_axis: {free_axis!r} given, 'x', 'y', 'z' or None wanted")
    if not is_pose:
        raise InputError("free_axis: given with a point, which leaves every axis free; give a Pose as the target")
    return _FREE[free_axis]


def read_problem(
    arm: Arm,
    asked: int,
    targets: Array,
    q0: ArrayLike | None,
    position_tolerance: float,
    orientation_tolerance: float,
    rng: int,
) -> Problem:
    """A caller's problem, checked.

    Args:
        arm: The arm.
        asked: What of the tip is asked for.
        targets: (N, 12).
        q0: (n,) or (N, n) rad, where to start; None is the arm's home.
        position_tolerance: m.
        orientation_tolerance: rad.
        rng: The seed of the random starts.

    Returns:
        The problem.

    Raises:
        InputError: An argument of the wrong shape, kind or value.
        LimitError: q0 is outside the joint limits.
    """
    check_arm(arm)
    if isinstance(rng, bool) or not isinstance(rng, (int, np.integer)) or rng < 0:
        raise InputError(f"rng: {rng!r} given, the seed of the random starts wanted: an integer of at least 0")
    count = len(targets)
    if q0 is None or np.ndim(q0) == 1 or count == 1:
        start = arm.home if q0 is None else arm.checked("q0", np.reshape(q0, -1) if count == 1 else q0)
        starts = start[None] if count == 1 else np.broadcast_to(start, (count, arm.n))
    else:
        rows = matrix("q0", q0, arm.n)
        if len(rows) != count:
            raise InputError(f"q0: {len(rows)} rows given for {count} targets")
        outside = ~((rows >= arm.limits.q_min - 1e-9) & (rows <= arm.limits.q_max + 1e-9)).all(axis=1)
        for row in rows[outside]:
            arm.checked("q0", row)
        starts = arm.limits.clamp(rows)
    return Problem(
        arm,
        chain_of(arm),
        asked,
        targets,
        starts,
        number("position_tolerance", position_tolerance, 1e-12),
        number("orientation_tolerance", orientation_tolerance, 1e-12),
        int(rng) % 2**63,
    )


_chains: WeakKeyDictionary[Arm, Chain] = WeakKeyDictionary()


def chain_of(arm: Arm) -> Chain:
    """The packed chain of an arm, made once.

    Args:
        arm: The arm.

    Returns:
        Its chain.
    """
    chain = _chains.get(arm)
    if chain is None:
        chain = _chains[arm] = _pack(arm)
    return chain


def _pack(arm: Arm) -> Chain:
    body, limits, joint_map = arm.pinocchio_model, arm.limits, arm.joint_map
    k, n = body.chain_length, arm.n
    ratio, slides = joint_map.ratio[:k], body.is_slide[joint_map.leaders]
    links = np.concatenate([body.placements @ _moved(joint_map.offset[:k], body.is_slide), body.T_last_tip[None]])
    farthest = np.maximum(np.abs(limits.q_min), np.abs(limits.q_max))
    travel = np.where(body.is_slide, np.abs(ratio) @ np.where(np.isfinite(farthest), farthest, 0.0), 0.0)
    reach = float(np.linalg.norm(links[1:, :3, 3], axis=1).sum() + travel.sum()) or 1.0
    unit = np.where(slides, reach, 1.0)
    rows = np.zeros((k + 1, 18))
    rows[:, :9] = links[:, :3, :3].reshape(-1, 9)
    rows[:, 9:12] = links[:, :3, 3] / reach
    rows[:-1, 12] = body.is_slide
    rows[:n, 13], rows[:n, 14] = limits.q_min / unit, limits.q_max / unit
    rows[:-1, 15] = np.abs(ratio).argmax(axis=1)
    rows[:-1, 16] = (ratio @ unit) / np.where(body.is_slide, reach, 1.0)
    rows[:n, 17] = np.where(slides | (np.count_nonzero(ratio, axis=0) > 1), 0.0, 2 * np.pi)
    return Chain(frozen(rows), reach, frozen(unit), bool(slides.any()), limits)


def _moved(offset: Array, is_slide: BoolArray) -> Array:
    """(k, 4, 4) what joints do when they move by their offsets, about z or along it."""
    T = np.tile(np.eye(4), (len(offset), 1, 1))
    c, s = np.where(is_slide, 1.0, np.cos(offset)), np.where(is_slide, 0.0, np.sin(offset))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1], T[:, 2, 3] = c, -s, s, c, np.where(is_slide, offset, 0.0)
    return T
