"""Actions: what the numbers of a policy mean."""

from __future__ import annotations

from dataclasses import dataclass

from armctl.core.validation import choice
from armctl.robot.arm import Arm

_MIN_JOINTS_FOR_POSES = 6


@dataclass(frozen=True)
class ActionMode:
    """How the controller uses an action, whose numbers are in [-1, 1].

    Attributes:
        number: What the compiled step calls it.
        joint_scale: Fraction of the way at full speed that a full action moves the target of a joint in a step.
        position_scale: m, of a full action.
        rotation_scale: rad, of a full action.
    """

    number: int
    joint_scale: float = 0.5
    position_scale: float = 0.0
    rotation_scale: float = 0.0

    def size(self, arm: Arm) -> int:
        """The numbers of an action: one a joint, or 6 of the tip (3 where the arm has fewer than 6 joints)."""
        if self.position_scale == 0.0:
            return arm.n
        return 6 if arm.n >= _MIN_JOINTS_FOR_POSES else 3


ACTION_MODES = {
    "torque": ActionMode(0),
    "joint_delta": ActionMode(1),
    "joint_target": ActionMode(2),
    "cartesian_delta": ActionMode(3, position_scale=0.025, rotation_scale=0.1),
    "cartesian_pose": ActionMode(4, position_scale=0.5, rotation_scale=1.0),
}


def read_mode(action: object) -> ActionMode:
    """The mode of a name.

    Raises:
        InputError: There is no such mode.
    """
    return ACTION_MODES[choice("action", action, ACTION_MODES)]
