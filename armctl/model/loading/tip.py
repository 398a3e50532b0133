"""The tip of a chain: the site, body or geom at its end."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from armctl.core.errors import UnknownNameError
from armctl.core.pose import Pose
from armctl.core.validation import instance
from armctl.model.mjmodel.queries import Joints, body_name, is_below, joint_name, object_id, welded_behind

_TIP_WORDS = ("pinch", "grasp", "tcp", "attachment", "tool", "effector", "eef", "ee", "tip", "flange", "gripper")
_SENSOR_NAME = re.compile(r"imu|cam|force|torque|sensor", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Tip:
    """The end of an arm: a frame in one of its bodies."""

    name: str
    body: int
    T_body_tip: Pose

    def moved(self, offset: Pose | None) -> Tip:
        """The tip at an offset in its own frame, T_tip_new; the same tip without an offset."""
        return self if offset is None else replace(self, T_body_tip=self.T_body_tip @ offset)


def tip_of_chain(model: mujoco.MjModel, joints: Joints) -> Tip:
    return tip_on(model, int(model.jnt_bodyid[joints[-1]]))


def tip_on(model: mujoco.MjModel, body: int) -> Tip:
    """The tip on a body and what is welded to it.

    The first of these that exists: a site that is named like a tip; the only site; the only named ball, such as a foot; a body
    that is named like a tip, such as a URDF's tool0; the end of the piece, and where it branches, as into fingers, the body
    before that. A body comes last because its frame often lies on the last joint's axis, which then could not move it.
    """
    bodies = welded_behind(model, body)
    sites = {
        s: model.site(s).name
        for s in range(model.nsite)
        if int(model.site_bodyid[s]) in bodies and model.site(s).name and not _SENSOR_NAME.search(model.site(s).name)
    }
    for word in _TIP_WORDS:
        for name in sites.values():
            if word in name.lower():
                return named_tip(model, name)
    if len(sites) == 1:
        return named_tip(model, next(iter(sites.values())))
    spheres = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE).tolist()
    balls = [model.geom(g).name for g in spheres if int(model.geom_bodyid[g]) in bodies and model.geom(g).name]
    if len(balls) == 1:
        return named_tip(model, balls[0])
    end = _end_body(model, bodies)
    return Tip(body_name(model, end), end, Pose([0.0, 0.0, 0.0]))


def axis_note(model: mujoco.MjModel, joints: Joints, tip: Tip) -> list[str]:
    """One sentence if the last joint of a chain cannot move its tip, which is the origin of its own link; or none."""
    last = joints[-1]
    sentence = f"joint {joint_name(model, last)!r} cannot move the tip {tip.name!r}; pass tip= or tip_offset=, or add a link"
    turns = model.jnt_type[last] == mujoco.mjtJoint.mjJNT_HINGE and tip.body == model.jnt_bodyid[last]
    return [sentence] if turns and not (tip.T_body_tip.position - model.jnt_pos[last]).any() else []


def named_tip(model: mujoco.MjModel, name: str) -> Tip:
    """The site of a name as a tip, else the body, else the geom; UnknownNameError if there is none."""
    instance("tip", name, str, "give the name of a site, body or geom")
    site = object_id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        return Tip(name, int(model.site_bodyid[site]), Pose(model.site_pos[site], model.site_quat[site]))
    body = object_id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return Tip(name, body, Pose([0.0, 0.0, 0.0]))
    geom = object_id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    if geom >= 0:
        return Tip(name, int(model.geom_bodyid[geom]), Pose(model.geom_pos[geom], model.geom_quat[geom]))
    known = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
    raise UnknownNameError.from_known("site, body or geom", name, filter(None, known))


def _end_body(model: mujoco.MjModel, bodies: list[int]) -> int:
    """The body of a rigid piece that is named like a tip; else its end, or the body before it branches; no sensor."""
    kept = [b for b in bodies if not _SENSOR_NAME.search(body_name(model, b))] or bodies
    for tip_word in _TIP_WORDS:
        word = re.compile(rf"(?<![a-z]){tip_word}(?![a-z])", re.IGNORECASE)
        named = [b for b in kept if word.search(body_name(model, b))]
        if named and all(is_below(model, named[-1], b) for b in named):
            return named[-1]
    ends = [b for b in kept if not any(is_below(model, other, b) for other in kept if other != b)]
    return max(b for b in bodies if all(is_below(model, end, b) for end in ends))
