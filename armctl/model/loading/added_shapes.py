"""Collision shapes that a caller asks for, on links that have none: capsules along them, or their visual geoms."""

from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from armctl.core.validation import Array, choice
from armctl.model.loading.inertias import MIN_MASS_KG
from armctl.model.mjmodel.queries import colliding_geoms, placed, welded_behind

CAPSULES = "capsules"
VISUAL = "visual"
_KINDS = (CAPSULES, VISUAL)
_LEAST_SLENDERNESS = 0.1  # radius of a capsule over the length of its link: 1/5 as thick as long, as robots' links are
_GREATEST_SLENDERNESS = 0.3  # inertias in files can be far too large
_LEAST_RADIUS = 0.01  # of the length of the whole arm
_COLLISION_GROUP = 3  # where Menagerie has the shapes for contacts


def read_shapes(shapes: object) -> str | None:
    """The argument `shapes` of `load`, checked."""
    return None if shapes is None else choice("shapes", shapes, _KINDS)


def add_shapes(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    qpos: Array,
    kind: str,
    links: Sequence[int],
    tips: Collection[tuple[int, Array]],
) -> list[str]:
    """Gives links of a compiled specification, by their bodies, shapes in place; a sentence about it.

    `qpos` (nq,) is where the links are measured; `tips` are bodies and points in them, m, where arms end.
    """
    bodies = {body.id: body for body in spec.bodies}
    names = ", ".join(bodies[link].name or f"body{link}" for link in links)
    if kind == VISUAL:
        used = [link for link in links if _use_visual_geoms(bodies[link])]
        names = ", ".join(bodies[link].name or f"body{link}" for link in used)
        return [f"the visual geoms of {names:.200} are used for contacts"] if used else []
    for link in links:
        for ends, radius in _capsules(model, qpos, link, tips):
            bodies[link].add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=ends.ravel(),
                size=[radius, 0.0, 0.0],
                mass=0.0,
                contype=1,
                conaffinity=1,
                group=_COLLISION_GROUP,
            )
    return [f"capsules along {names:.200} stand for their shapes, which the file does not have"]


def visual_links(model: mujoco.MjModel, links: Sequence[int]) -> list[int]:
    """Which bodies have geoms that do not collide, and could."""
    idle = ~colliding_geoms(model)
    return [link for link in links if idle[model.geom_bodyid == link].any()]


def _use_visual_geoms(body: mujoco.MjsBody) -> bool:
    """Lets the geoms of a body collide; returns whether it has any."""
    for geom in body.geoms:
        geom.contype = 1
        geom.conaffinity = 1
    return bool(body.geoms)


def _capsules(model: mujoco.MjModel, qpos: Array, body: int, tips: Collection[tuple[int, Array]]) -> list[tuple[Array, float]]:
    """The ends (2, 3) m, in the frame of a body, and the radius of capsules from its joint to all that it carries.

    Their radius is that of a solid cylinder with the body's mass and inertia, within bounds by the length of the link.
    """
    data = placed(model, qpos)
    begin = _place(model, data, body)
    own = [child for child in range(1, model.nbody) if model.body_parentid[child] == body]
    places = [_place(model, data, child) for child in own] or [
        data.xpos[tip] + data.xmat[tip].reshape(3, 3) @ point for tip, point in tips if tip in welded_behind(model, body)
    ]
    if model.body_mass[body] > MIN_MASS_KG:
        places.append(data.xipos[body])
    R = data.xmat[body].reshape(3, 3)
    ends = (np.array(places).reshape(-1, 3) - begin) @ R
    size = float(np.linalg.norm(np.ptp(data.xpos[1:], axis=0)))
    length = float(np.linalg.norm(ends, axis=1).max(initial=0.0))
    radius = _cylinder_radius(model, body)
    if length > 0.0:
        radius = min(max(radius, _LEAST_SLENDERNESS * length), _GREATEST_SLENDERNESS * max(length, _LEAST_SLENDERNESS * size))
    radius = max(radius, _LEAST_RADIUS * size)
    lines = [end for end in ends if np.linalg.norm(end) > _LEAST_SLENDERNESS * radius] or [np.array([0.0, 0.0, 1e-3 * radius])]
    start = (begin - data.xpos[body]) @ R
    return [(np.array([start, start + end]), radius) for end in lines]


def _place(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    """(3,) m, where a body is attached: the anchor of its first joint, which does not move with it, or its origin."""
    return data.xanchor[model.body_jntadr[body]] if model.body_jntnum[body] else data.xpos[body]


def _cylinder_radius(model: mujoco.MjModel, body: int) -> float:
    """m; across a solid cylinder of radius r, the mean square of a coordinate is r^2 / 4. 0 for a body without mass."""
    mass = float(model.body_mass[body])
    if mass <= MIN_MASS_KG:
        return 0.0
    moments = model.body_inertia[body]
    squares = np.sort(np.maximum(0.5 * moments.sum() - moments, 0.0)) / mass
    return float(2.0 * np.sqrt(0.5 * (squares[0] + squares[1])))
