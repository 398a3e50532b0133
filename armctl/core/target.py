"""Target: the point or pose that a tip should reach, with tolerances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.pose import Pose, rotation_angle
from armctl.core.validation import Array, frozen, instance, number, shown, vector

TOLERANCE = 1e-3  # m
ANGLE_TOLERANCE = 1e-2  # rad


@dataclass(frozen=True, eq=False)
class Target:
    """A point or a pose that the tip should reach.

    Attributes:
        position: (3,) m.
        pose: T_world_tip; None if any orientation is accepted.
        tolerance: m, the largest position error of a tip that counts as at the target.
        angle_tolerance: rad, the largest orientation error, likewise.
    """

    position: Array
    pose: Pose | None
    tolerance: float = TOLERANCE
    angle_tolerance: float = ANGLE_TOLERANCE

    def __post_init__(self) -> None:
        if not (isinstance(self.position, np.ndarray) and self.position.shape == (3,) and np.isfinite(self.position).all()):
            object.__setattr__(self, "position", vector("position", self.position, 3))
        if self.pose is not None:
            instance("pose", self.pose, Pose, "armctl.Pose(position) makes one")
            if not np.array_equal(self.pose.position, self.position):
                raise InputError(f"position: {shown(self.position)} is not that of the pose, {shown(self.pose.position)}")
        for name in ("tolerance", "angle_tolerance"):
            object.__setattr__(self, name, number(name, getattr(self, name), 0.0))

    @classmethod
    def read(cls, target: TargetLike, tolerance: float | None = None, angle_tolerance: float | None = None) -> Target:
        """A checked target. A Target that was already read is not checked again; it keeps tolerances that are not given.

        Args:
            target: T_world_tip, (3,) m if any orientation is accepted, or a Target.
            tolerance: m; None is 1e-3 m.
            angle_tolerance: rad; None is 1e-2 rad.

        Raises:
            InputError: The target has a wrong length or a number that is not finite, or a tolerance is negative or not finite.
        """
        if isinstance(target, Pose):
            target = cls(target.position, target)
        elif not isinstance(target, Target):
            position = vector("target", target)
            if len(position) != 3:
                raise InputError(f"target: expected 3 numbers, got {len(position)}; Pose(point, rpy=angles) adds angles")
            target = cls(position, None)
        given = {"tolerance": tolerance, "angle_tolerance": angle_tolerance}
        changed = {name: value for name, value in given.items() if value is not None}
        return replace(target, **changed) if changed else target

    @property
    def numbers(self) -> Array:
        """(7,) m and quaternion wxyz; NaN for an orientation that is not constrained."""
        quat = np.full(4, np.nan) if self.pose is None else self.pose.quat
        return frozen(np.concatenate([self.position, quat]))

    def distance(self, tip: Pose) -> tuple[float, float]:
        """The errors of a tip.

        Args:
            tip: T_world_tip.

        Returns:
            Position error, m, and orientation error, rad; 0 rad if any orientation is accepted.
        """
        instance("tip", tip, Pose, "arm.fk returns one")
        angle = 0.0 if self.pose is None else rotation_angle(tip.rotation.T @ self.pose.rotation)
        return float(np.linalg.norm(tip.position - self.position)), angle

    def is_reached(self, tip: Pose) -> bool:
        """Whether both errors of a tip are within the tolerances.

        Args:
            tip: T_world_tip.
        """
        position_error, orientation_error = self.distance(tip)
        return position_error <= self.tolerance and orientation_error <= self.angle_tolerance


@dataclass(frozen=True, eq=False)
class RegionMember:
    """The pose of a region that a solver or a motion has chosen.

    Attributes:
        index: The number of the part of the region that it is in.
        pose: T_world_tip.
        name: What the part is called; empty if it has no name.
    """

    index: int
    pose: Pose
    name: str = ""

    def __str__(self) -> str:
        part = f"{self.name!r}" if self.name else f"part {self.index}"
        return f"{part} at {self.pose}"


TargetLike: TypeAlias = Target | Pose | ArrayLike
