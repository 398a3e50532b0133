"""Candidates: the poses of the tip in which a gripper would hold a body, the most promising first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.core.handling import Grasp
from armctl.core.pose import Pose, computed_pose
from armctl.core.validation import Array
from armctl.model.gripper.grip_frames import GripFrames
from armctl.plan.grasp.holds import BodyPart, Hold, center_of, holds_of, radius_of

FINGER_GAP_M = 3e-3  # between a pad and the body before it closes, where the gripper opens that far
MIN_FINGER_GAP_M = 5e-4  # with less than this on either side a body counts as too wide
_APPROACHES = 12  # directions of the fingers, around the direction in which they close
_BACK = 0.7  # of the depth of the pads: a gripper that holds with the ends of its fingers
# What a grasp costs: far from the middle of the body it twists, from above there is most room, wide ones leave no gap.
_OFFSET_COST = 1.0
_BACK_COST = 0.1
_FROM_BELOW_COST = 1.0
_WIDTH_COST = 0.3
_VERTICAL = 0.99  # cosine


class Candidate(NamedTuple):
    """A grasp that is to be tried."""

    grasp: Grasp
    cost: float


def least_width(parts: Sequence[BodyPart]) -> float:
    """m, the least width at which a body can be held; infinite if it has no opposite sides."""
    return min((hold.width for hold in holds_of(parts)), default=np.inf)


def candidates(parts: Sequence[BodyPart], T_world_body: Pose, frames: GripFrames, up: Array) -> list[Candidate]:
    """The grasps of a body that a gripper is wide enough for, the cheapest first."""
    center = center_of(parts)
    radius = radius_of(parts, center)
    found = []
    for hold in holds_of(parts):
        if hold.width > frames.width_max - 2.0 * MIN_FINGER_GAP_M:
            continue
        offset = hold.point - center
        offset = offset - hold.closing * (hold.closing @ offset)
        cost = _OFFSET_COST * float(np.linalg.norm(offset)) / radius + _WIDTH_COST * hold.width / frames.width_max
        found += _around(hold, cost, T_world_body, frames, up)
    return sorted(found, key=lambda candidate: candidate.cost)


def _around(hold: Hold, cost: float, T_world_body: Pose, frames: GripFrames, up: Array) -> list[Candidate]:
    """The grasps at a hold: fingers from all directions across it, either finger on either side."""
    point = T_world_body.transform(hold.point)
    closing = T_world_body.rotation @ hold.closing
    reference = up if abs(up @ closing) < _VERTICAL else T_world_body.rotation[:, int(np.abs(hold.closing).argmin())]
    reference = reference - closing * (closing @ reference)
    reference = reference / np.linalg.norm(reference)
    side = np.cross(closing, reference)
    gap = min(FINGER_GAP_M, 0.5 * (frames.width_max - hold.width))
    T_grip_tip = frames.at(hold.width + 2.0 * gap).inverse()
    found = []
    for k in range(_APPROACHES):
        angle = 2.0 * math.pi * k / _APPROACHES
        pointing = math.cos(angle) * reference + math.sin(angle) * side
        below = 0.5 * (1.0 + float(pointing @ up))
        for back in (0.0, _BACK) if frames.depth > 0.0 else (0.0,):
            for sign in (1.0, -1.0):
                axes: Array = np.column_stack([sign * closing, np.cross(pointing, sign * closing), pointing]).astype(np.float64)
                tip = computed_pose(point - back * frames.depth * pointing, axes) @ T_grip_tip
                grasp = Grasp(tip=tip, width=hold.width, pointing=pointing, closing=sign * closing)
                found.append(Candidate(grasp, cost + _FROM_BELOW_COST * below + _BACK_COST * (back > 0.0)))
    return found
