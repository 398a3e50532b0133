"""Which joints of an arm with several tips need not move to targets by tip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.core.tip_targets import Stay, TipTargets
from armctl.model.arm.arm import Arm

Mask = NDArray[np.bool_]


class RestingJoints(NamedTuple):
    """Joints that no tip needs which has to move."""

    held: Mask  # (n,) those that would move tips that stay, and no other tip with a target
    idle: Mask  # (n,) those that would move no tip with a target


def resting_joints(arm: Arm, targets: TipTargets) -> RestingJoints:
    """The joints that rest where the arm is, while tips move to their targets.

    A tip that shares a joint with one that has to move cannot rest this way, such as a hand on a torso that turns: the joints
    to it move, and its pose stays at the end.
    """
    needed = np.zeros(arm.n, bool)
    for tip, target in targets.items():
        if not isinstance(target, Stay):
            needed |= _moving(arm, tip)
    held = np.zeros(arm.n, bool)
    idle = ~needed
    for tip, target in targets.items():
        if not isinstance(target, Stay):
            continue
        own = _moving(arm, tip)
        idle &= ~own
        if not (own & needed).any():
            held |= own
    return RestingJoints(held, idle)


def _moving(arm: Arm, tip: str) -> Mask:
    """(n,) which joints move a tip."""
    moving = np.zeros(arm.n, bool)
    moving[list(arm.joints_to(tip))] = True
    return moving
