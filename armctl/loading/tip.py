"""The tip of a chain: the site, body or geom at its end."""

from __future__ import annotations

import re

import mujoco

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.pose import Pose
from armctl.mjmodel.queries import Chain, body_name, is_below, name_of, welded_behind

_TIP_NAMES = ("pinch", "grasp", "tcp", "attachment", "tool", "effector", "eef", "ee", "tip", "flange", "gripper")
_NO_TIP = re.compile(r"imu|cam|force|torque|sensor", re.IGNORECASE)


def find_tip(model: mujoco.MjModel, joints: Chain) -> tuple[str, int, Pose]:
    """The tip of a chain.

    Args:
        model: The compiled model.
        joints: The chain.

    Returns:
        The tip's name, the body that carries it, and its pose in that body.
    """
    return tip_on(model, int(model.jnt_bodyid[joints[-1]]))


def tip_on(model: mujoco.MjModel, body: int) -> tuple[str, int, Pose]:
    """The tip of what is one rigid piece with a body: a site that is named like one, or else a body.

    Where no site is named like a tip, the only site will do, and then a named ball, such as a foot: a body's own frame often
    sits on the last joint's axis, which then could not move it. Then a body that is named like a tip, such as a URDF's tool0,
    and last the end of the piece; where it branches, as into fingers, the body before that.

    Args:
        model: The compiled model.
        body: Its number.

    Returns:
        The tip's name, the body that carries it, and its pose in that body.
    """
    bodies = welded_behind(model, body)
    sites = [s for s in range(model.nsite) if int(model.site_bodyid[s]) in bodies and model.site(s).name]
    names = {s: name_of(model, mujoco.mjtObj.mjOBJ_SITE, s) for s in sites}
    named = [s for wanted in _TIP_NAMES for s in sites if wanted in names[s].lower() and not _NO_TIP.search(names[s])]
    if named:
        return named_tip(model, names[named[0]])
    alone = [s for s in sites if not _NO_TIP.search(names[s])]
    if len(alone) == 1:
        return named_tip(model, names[alone[0]])
    balls = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in bodies and _is_ball(model, g)]
    if len(balls) == 1:
        return named_tip(model, model.geom(balls[0]).name)
    end = _end_body(model, bodies)
    return body_name(model, end), end, Pose([0.0, 0.0, 0.0])


def named_tip(model: mujoco.MjModel, name: str) -> tuple[str, int, Pose]:
    """The site, body or geom of a name, as a tip.

    Args:
        model: The compiled model.
        name: The name; a site is looked for first, then a body, then a geom.

    Returns:
        The tip's name, the body that carries it, and its pose in that body.

    Raises:
        InputError: It is no name.
        UnknownNameError: There is none of that name.
    """
    if not isinstance(name, str):
        raise InputError(f"tip: {name!r} is no name of a site, body or geom")
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        return name, int(model.site_bodyid[site]), Pose(model.site_pos[site], model.site_quat[site])
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return name, body, Pose([0.0, 0.0, 0.0])
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    if geom >= 0:
        return name, int(model.geom_bodyid[geom]), Pose(model.geom_pos[geom], model.geom_quat[geom])
    known = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
    raise UnknownNameError.of("site, body or geom", name, filter(None, known))


def named_body(model: mujoco.MjModel, name: str) -> int:
    """The body of a name.

    Args:
        model: The compiled model.
        name: Its name.

    Returns:
        Its number.

    Raises:
        InputError: It is no name.
        UnknownNameError: There is none of that name.
    """
    if not isinstance(name, str):
        raise InputError(f"base: {name!r} is no name of a body")
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        raise UnknownNameError.of("body", name, filter(None, (model.body(i).name for i in range(model.nbody))))
    return body


def _end_body(model: mujoco.MjModel, bodies: list[int]) -> int:
    """The body of a rigid piece that is named like a tip; else its end, or the body before it branches; no sensor."""
    kept = [b for b in bodies if not _NO_TIP.search(body_name(model, b))] or bodies
    for wanted in _TIP_NAMES:
        word = re.compile(rf"(?<![a-z]){wanted}(?![a-z])", re.IGNORECASE)
        named = [b for b in kept if word.search(body_name(model, b))]
        if named and all(is_below(model, named[-1], b) for b in named):
            return named[-1]
    ends = [b for b in kept if not any(is_below(model, other, b) for other in kept if other != b)]
    return max(b for b in bodies if all(is_below(model, end, b) for end in ends))


def _is_ball(model: mujoco.MjModel, geom: int) -> bool:
    return model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE and bool(model.geom(geom).name)
