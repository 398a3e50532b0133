"""An IK problem in numbers: the chain packed for the compiled solver, the target, and the residual that judges an answer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from armctl.arm import Arm
from armctl.arrays import Array, frozen, vector
from armctl.errors import InputError
from armctl.pose import Pose

PoseOrPoint: TypeAlias = Pose | ArrayLike

POSE, POSITION, FREE_X, FREE_Y, FREE_Z = range(5)  # what of the tip is asked for
_FREE = {"x": FREE_X, "y": FREE_Y, "z": FREE_Z}


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain as the compiled solver takes it, its lengths in units of the reach.

    Attributes:
        rows: (n + 1, 15): rotation, translation, 1 for a slide joint, bounds; the last row is the tip.
        reach: m, the arm stretched out: the unit of length.
        unit: (n,) what one unit of each joint is: 1 rad, or the reach for a slide joint.
    """

    rows: Array
    reach: float
    unit: Array


@dataclass(frozen=True, eq=False)
class Target:
    """Where the tip should be.

    Attributes:
        asked: POSE, POSITION, or which axis of the tip may be turned about freely.
        position: (3,) m.
        rotation: (3, 3), the identity where none is asked for.
    """

    asked: int
    position: Array
    rotation: Array

    @classmethod
    def read(cls, target: PoseOrPoint, free_axis: str | None) -> Target:
        """A caller's target, checked.

        Args:
            target: A Pose, or (3,) m for position only.
            free_axis: "x", "y" or "z", the tip's axis about which the target may be turned; None fixes all three.

        Returns:
            The target.

        Raises:
            InputError: Neither a Pose nor three finite numbers, or no such axis.
        """
        if free_axis is not None and free_axis not in _FREE:
            raise InputError(f"free_axis: {free_axis!r} given, 'x', 'y', 'z' or None wanted")
        if isinstance(target, Pose):
            return cls(_FREE[free_axis] if free_axis else POSE, target.position, target.rotation)
        return cls(POSITION, vector("target", target, 3), np.eye(3))

    def residual(self, position: Array, rotation: Array) -> tuple[float, float]:
        """How far a tip is from the target.

        Args:
            position: (3,) m, the tip's.
            rotation: (3, 3), the tip's.

        Returns:
            m, and rad of what of the orientation is asked for.
        """
        x, y, z = (position - self.position).tolist()
        off = math.sqrt(x * x + y * y + z * z)
        if self.asked == POSITION:
            return off, 0.0
        if self.asked == POSE:
            chord, turns = (rotation - self.rotation).ravel(), 2 * math.sqrt(2)
        else:
            axis = self.asked - FREE_X
            chord, turns = rotation[:, axis] - self.rotation[:, axis], 2.0
        return off, 2 * math.asin(min(1.0, math.sqrt(float(chord @ chord)) / turns))


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
    body, limits = arm.rigid_body, arm.limits
    links = np.concatenate([body.placements, body.T_last_tip[None]])
    travel = np.where(body.is_slide, np.maximum(np.abs(limits.q_min), np.abs(limits.q_max)), 0.0)
    reach = float(np.linalg.norm(links[1:, :3, 3], axis=1).sum() + travel[np.isfinite(travel)].sum()) or 1.0
    unit = np.where(body.is_slide, reach, 1.0)
    rows = np.zeros((arm.n + 1, 15))
    rows[:, :9] = links[:, :3, :3].reshape(-1, 9)
    rows[:, 9:12] = links[:, :3, 3] / reach
    rows[:-1, 12] = body.is_slide
    rows[:-1, 13], rows[:-1, 14] = limits.q_min / unit, limits.q_max / unit
    return Chain(frozen(rows), reach, frozen(unit))
