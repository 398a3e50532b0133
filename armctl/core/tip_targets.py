"""Targets by tip: what each of several tips of an arm should reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.pose import Pose
from armctl.core.target import TargetLike
from armctl.core.validation import Array, instance, matrix, shown, vector


class Stay:
    """The type of `armctl.STAY`: a tip stays where it is, such as a foot on the ground. It holds before all other targets."""

    def __repr__(self) -> str:
        return "armctl.STAY"

    def __reduce__(self) -> str:
        return "STAY"


STAY = Stay()


@dataclass(frozen=True, eq=False)
class RelativeTo:
    """A target in the frame of another tip, such as a second hand on the same tray. It holds before targets in the world.

    Attributes:
        tip: The other tip.
        target: T_other_tip of this tip, or (3,) m in the other tip's frame if any orientation is accepted.
    """

    tip: str
    target: Pose | Array

    def __init__(self, tip: str, target: Pose | ArrayLike):
        """A target relative to another tip.

        Args:
            tip: The other tip.
            target: T_other_tip, or (3,) m.

        Raises:
            InputError: The tip is no name, or the target neither a Pose nor three numbers.
        """
        instance("tip", tip, str, "give the name of one of the arm's tips")
        object.__setattr__(self, "tip", tip)
        object.__setattr__(self, "target", target if isinstance(target, Pose) else vector("target", target, 3))


@dataclass(frozen=True, eq=False)
class LookAt:
    """A point that the z axis of a tip should point to, such as a camera's or a head's.

    Attributes:
        point: (3,) m, in the world.
    """

    point: Array

    def __init__(self, point: ArrayLike):
        """A point to look at.

        Args:
            point: (3,) m, in the world.

        Raises:
            InputError: It is not three numbers.
        """
        object.__setattr__(self, "point", vector("point", point, 3))


TipTarget: TypeAlias = TargetLike | Stay | RelativeTo | LookAt
TipTargets: TypeAlias = Mapping[str, TipTarget]


def targets_by_tip(targets: TipTargets, start: Mapping[str, Pose]) -> dict[str, TipTarget]:
    """The same targets for a motion: tips that stay have the poses of the start, from wherever a search begins."""
    return {tip: start[tip] if isinstance(target, Stay) else target for tip, target in targets.items()}


def read_polygon(what: str, polygon: ArrayLike | None) -> Array:
    """The half planes (K, 3) of a convex polygon: normal x and y, and bound, m; none for None.

    Raises:
        InputError: It is not convex, has fewer than three corners or no area.
    """
    if polygon is None:
        return np.empty((0, 3))
    corners = matrix(what, polygon, 2)
    if len(corners) < 3:
        raise InputError(f"{what}: expected the corners (K, 2) of a polygon, m, at least three, got {shown(polygon)}")
    edges = np.roll(corners, -1, axis=0) - corners
    turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
    if not ((turns > 0).all() or (turns < 0).all()):
        raise InputError(f"{what}: the polygon is not convex; give its corners in order, such as those of its convex hull")
    outward = np.column_stack([edges[:, 1], -edges[:, 0]]) * np.sign(turns[0])
    normals = outward / np.linalg.norm(outward, axis=1, keepdims=True)
    return np.column_stack([normals, (normals * corners).sum(axis=1)])
