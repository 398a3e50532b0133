"""Candidates: the poses of the tip in which a gripper would hold a body, the most promising first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.core.handling import Grasp
from armctl.core.pose import Pose
from armctl.core.validation import Array, frozen
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


class Candidates(NamedTuple):
    """Grasps that are to be tried, the cheapest first."""

    rotations: Array  # (N, 3, 3) of the tip
    positions: Array  # (N, 3) m, of the tip
    pointings: Array  # (N, 3) the directions of the fingers
    closings: Array  # (N, 3) the directions in which they close
    widths: Array  # (N,) m, between the pads
    costs: Array  # (N,)

    @property
    def tips(self) -> Array:
        """(N, 4, 4) T_world_tip."""
        matrices = np.tile(np.eye(4), (len(self.costs), 1, 1))
        matrices[:, :3, :3] = self.rotations
        matrices[:, :3, 3] = self.positions
        return matrices

    def grasp(self, row: int, tip: Pose) -> Grasp:
        """A grasp with the tip where an arm can have it."""
        return Grasp(
            tip=tip,
            width=float(self.widths[row]),
            pointing=frozen(self.pointings[row].copy()),
            closing=frozen(self.closings[row].copy()),
        )


def least_width(parts: Sequence[BodyPart]) -> float:
    """m, the least width at which a body can be held; infinite if it has no opposite sides."""
    return min((hold.width for hold in holds_of(parts)), default=np.inf)


def candidates(parts: Sequence[BodyPart], T_world_body: Pose, frames: GripFrames, up: Array, most: int) -> Candidates:
    """The `most` cheapest grasps of a body: fingers from all directions across a hold, either finger on either side."""
    holds = [hold for hold in holds_of(parts) if hold.width <= frames.width_max - 2.0 * MIN_FINGER_GAP_M]
    center = center_of(parts)
    widths = np.array([hold.width for hold in holds])
    local = np.array([hold.closing for hold in holds])
    offsets = np.array([hold.point for hold in holds]) - center
    offsets -= local * (local * offsets).sum(axis=1, keepdims=True)
    costs = _OFFSET_COST * np.linalg.norm(offsets, axis=1) / radius_of(parts, center) + _WIDTH_COST * widths / frames.width_max
    closings = local @ T_world_body.rotation.T
    points = T_world_body.position + np.array([hold.point for hold in holds]) @ T_world_body.rotation.T
    references = np.array([_reference(hold, T_world_body, up) for hold in holds])
    sides = np.cross(closings, references)
    angles = 2.0 * np.pi / _APPROACHES * np.arange(_APPROACHES)
    around = np.cos(angles)[:, None, None] * references + np.sin(angles)[:, None, None] * sides
    mounts = [_mount(frames, float(width)) for width in widths]
    R_grip_tip = np.array([mount.rotation for mount in mounts])
    p_grip_tip = np.array([mount.position for mount in mounts])
    found: list[Candidates] = []
    for pointings in around:
        below = 0.5 * (1.0 + pointings @ up)
        for back in (0.0, _BACK) if frames.depth > 0.0 else (0.0,):
            for sign in (1.0, -1.0):
                columns = [sign * closings, np.cross(pointings, sign * closings), pointings]
                axes: Array = np.stack(columns, axis=2).astype(np.float64)
                origins = points - back * frames.depth * pointings
                found.append(
                    Candidates(
                        rotations=axes @ R_grip_tip,
                        positions=origins + np.einsum("nij,nj->ni", axes, p_grip_tip),
                        pointings=pointings,
                        closings=sign * closings,
                        widths=widths,
                        costs=costs + _FROM_BELOW_COST * below + _BACK_COST * (back > 0.0),
                    )
                )
    together = Candidates(*(np.concatenate(column) for column in zip(*found, strict=True)))
    order = np.argsort(together.costs, kind="stable")[:most]
    return Candidates(*(column[order] for column in together))


def _mount(frames: GripFrames, width: float) -> Pose:
    """T_grip_tip of a gripper whose pads come to a body of a width, m, with a gap on either side."""
    gap = min(FINGER_GAP_M, 0.5 * (frames.width_max - width))
    return frames.at(width + 2.0 * gap).inverse()


def _reference(hold: Hold, T_world_body: Pose, up: Array) -> Array:
    """(3,) a direction across that in which the gripper closes: upwards, or along the body if it closes upwards."""
    closing = T_world_body.rotation @ hold.closing
    along = up if abs(up @ closing) < _VERTICAL else T_world_body.rotation[:, int(np.abs(hold.closing).argmin())]
    across = along - closing * (closing @ along)
    return across / np.linalg.norm(across)
