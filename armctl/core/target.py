"""Target: where a tip should end, and how far from it a tip is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.pose import Pose, rotation_angle
from armctl.core.validation import Array, frozen, number, vector

TOLERANCE = 1e-3  # m: within it a goal counts as reached
ANGLE_TOLERANCE = 1e-2  # rad


@dataclass(frozen=True, eq=False)
class Target:
    """A point, or a pose, for the tip.

    Attributes:
        position: (3,) m.
        pose: T_world_tip; None where the orientation does not matter.
        tolerance: m within which it counts as reached.
        angle_tolerance: rad, likewise.
    """

    position: Array
    pose: Pose | None
    tolerance: float = TOLERANCE
    angle_tolerance: float = ANGLE_TOLERANCE

    @classmethod
    def read(cls, target: Pose | ArrayLike, tolerance: float = TOLERANCE, angle_tolerance: float = ANGLE_TOLERANCE) -> Target:
        """A goal from what a caller gave.

        Args:
            target: T_world_tip, or (3,) m where the orientation does not matter.
            tolerance: m.
            angle_tolerance: rad.

        Returns:
            The goal.

        Raises:
            InputError: The target has a wrong length or a number that is not finite, or a tolerance is negative.
        """
        tolerance = number("tolerance", tolerance, 0.0)
        angle_tolerance = number("angle_tolerance", angle_tolerance, 0.0)
        pose = target if isinstance(target, Pose) else None
        position = target.position if isinstance(target, Pose) else vector("target", target, 3)
        return cls(position, pose, tolerance, angle_tolerance)

    @property
    def numbers(self) -> Array:
        """(7,) m and wxyz, NaN for what is not asked for."""
        quat = np.full(4, np.nan) if self.pose is None else self.pose.quat
        return frozen(np.concatenate([self.position, quat]))

    def distance(self, tip: Pose) -> tuple[float, float]:
        """How far a tip is.

        Args:
            tip: T_world_tip.

        Returns:
            m, and rad; 0 rad where the orientation does not matter.
        """
        angle = 0.0 if self.pose is None else rotation_angle(tip.rotation.T @ self.pose.rotation)
        return float(np.linalg.norm(tip.position - self.position)), angle

    def is_reached(self, tip: Pose) -> bool:
        """Whether a tip is within the tolerances.

        Args:
            tip: T_world_tip.

        Returns:
            True if it is.
        """
        position_error, orientation_error = self.distance(tip)
        return position_error <= self.tolerance and orientation_error <= self.angle_tolerance
