"""Actions: what the numbers of a policy mean."""

import math
from dataclasses import dataclass, replace

import numpy as np

from armctl import _core
from armctl.core.defaults import MIN_JOINTS_FOR_POSES
from armctl.core.errors import InputError
from armctl.core.limits import Limits
from armctl.model.arm.arm import Arm

_COMPONENTS = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")  # of a tip
_TURN = 2.0 * np.pi  # rad (m), to both sides of home
_MAX_SMOOTHING_S = 10.0
_STOP_MARGIN = 1e-3  # of the range of a joint


@dataclass(frozen=True)
class ActionMode:
    """How the controller uses an action, whose numbers are in [-1, 1]."""

    kind: _core.ActionMode  # what the compiled step calls it
    joint_scale: float = 0.5  # fraction of the way at full speed that a full action moves the target of a joint in a step
    position_scale: float = 0.0  # m, of a full action
    rotation_scale: float = 0.0  # rad, of a full action
    is_smooth: bool = False  # whether the reference keeps the jerk limits too, which delays it

    @property
    def is_cartesian(self) -> bool:
        return self.position_scale > 0.0

    def size(self, arm: Arm) -> int:
        """The numbers of an action: one a joint, or the block of each tip."""
        return sum(tip_sizes(arm)) if self.is_cartesian else arm.n

    def names(self, arm: Arm) -> list[str]:
        """The name of each number of an action."""
        if not self.is_cartesian:
            return list(arm.joint_names)
        blocks = zip(arm.tips, tip_sizes(arm), strict=True)
        return [f"{tip}/{name}" if arm.further_tips else name for tip, size in blocks for name in _COMPONENTS[:size]]


ACTION_MODES = {
    "torque": ActionMode(_core.ActionMode.torque),
    "joint_delta": ActionMode(_core.ActionMode.joint_delta),
    "joint_target": ActionMode(_core.ActionMode.joint_target),
    "cartesian_delta": ActionMode(_core.ActionMode.cartesian_delta, position_scale=0.025, rotation_scale=0.1),
    "cartesian_pose": ActionMode(_core.ActionMode.cartesian_pose, position_scale=0.5, rotation_scale=1.0),
}
for _name in ("joint_delta", "cartesian_delta"):
    ACTION_MODES[f"{_name}_smooth"] = replace(ACTION_MODES[_name], is_smooth=True)


def tip_sizes(arm: Arm) -> list[int]:
    """The numbers of each tip in a cartesian action: 6, or 3 (its position) where fewer than 6 joints move it."""
    return [6 if len(arm.joints_to(tip)) >= MIN_JOINTS_FOR_POSES else 3 for tip in arm.tips]


def target_limits(arm: Arm) -> Limits:
    """The limits of an arm, with finite positions for joint targets; InputError if a joint lacks another one.

    Targets keep a thousandth of a joint's range away from its stops; those of a joint without stops stay within a turn of home.
    """
    limits = arm.limits
    for what in ("v_max", "a_max", "tau_max"):
        if not np.isfinite(getattr(limits, what)).all():
            raise InputError(f"{what}: environments need a finite limit of each joint of {arm.name:.80}; use arm.with_limits")
    low = np.where(np.isfinite(limits.q_min), limits.q_min, arm.home - _TURN)
    high = np.where(np.isfinite(limits.q_max), limits.q_max, arm.home + _TURN)
    margin = _STOP_MARGIN * (high - low)
    return replace(limits, q_min=low + margin, q_max=high - margin)


def smoothing_ticks(arm: Arm) -> int:
    """Over how many control periods a reference that keeps all other limits is averaged to keep those of jerk."""
    seconds = float((2.0 * arm.limits.a_max / arm.limits.j_max).max())  # within them, the acceleration can be reversed
    if seconds > _MAX_SMOOTHING_S:
        raise InputError(f"j_max: smooth actions would be averaged over {seconds:.3g} s; the most is {_MAX_SMOOTHING_S:g} s")
    return max(1, math.ceil(seconds / arm.dt))
