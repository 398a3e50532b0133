"""StickFigure: lines from joint to joint, for a robot whose shapes are missing, or not there yet."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

NO_SHAPES = "the model has no visible shapes, so a stick figure is drawn"
_MAX_DRAWN_GROUP = 2  # MuJoCo draws the geoms of groups 0 to 2 by default; collision shapes are in the others


def drawn_geoms(model: mujoco.MjModel) -> np.ndarray:
    """(ngeom,) whether a geom is drawn."""
    return (model.geom_group <= _MAX_DRAWN_GROUP) & (model.geom_rgba[:, 3] > 0)


def has_shapes(arm: Arm) -> bool:
    """Whether something of an arm that moves is drawn."""
    model = arm.model
    bodies = model.geom_bodyid[drawn_geoms(model)]
    roots = model.body_rootid[list(arm.moved_bodies)]
    return bool((np.isin(model.body_rootid[bodies], roots) & (model.body_weldid[bodies] > 0)).any())


def needed_stick_figure(arm: Arm) -> StickFigure | None:
    """The stick figure of an arm without visible shapes; None for others."""
    return None if has_shapes(arm) else StickFigure(arm)


class StickFigure:
    """The lines between the joints of all robots of a model, and to the tips of an arm."""

    def __init__(self, arm: Arm):
        model = arm.model
        moving = (model.body_weldid > 0) & (model.body_mocapid[model.body_rootid] < 0)
        self._ends = np.flatnonzero(moving & (model.body_parentid > 0))
        self._starts = model.body_parentid[self._ends]
        self._first_joint = model.body_jntadr  # -1: none
        self._tips = arm.tip_frames

    def segments(self, data: mujoco.MjData) -> Array:
        """(k, 2, 3) m, the ends of the lines, after forward kinematics."""
        places = np.where(self._first_joint[:, None] >= 0, data.xanchor[self._first_joint], data.xpos)
        links = np.stack([places[self._starts], places[self._ends]], axis=1)
        tips = []
        for tip in self._tips:
            offset = data.xmat[tip.body].reshape(3, 3) @ tip.T_body_tip.position
            tips.append([places[tip.body], data.xpos[tip.body] + offset])
        return np.concatenate([links, tips])
