"""Contacts between links that overlap at home: they would brake the joints between them."""

from collections.abc import Collection

import mujoco
import numpy as np

from armctl.model.loading.home import home_qpos
from armctl.model.mjmodel.queries import Joints, acts, last_joint_above, stands_alone

RANDOM_CONFIGURATIONS = 20
_LEVEL_M = 1e-3  # a surface that is drawn at the height of the base may differ from it by this much


def overlapping_neighbors(model: mujoco.MjModel, joints: Joints) -> list[tuple[str, str]]:
    """The pairs of named neighbouring bodies of an arm that touch each other at home.

    MuJoCo itself leaves out contacts of a body with its parent, but not if the parent is fixed to the world.
    """
    above = last_joint_above(model, joints)
    touching = _touching_bodies(model, joints)
    pairs = []
    for first, second in touching:
        names = (model.body(first).name, model.body(second).name)
        is_pair = first > 0 and all(names) and abs(above[first] - above[second]) == 1
        if is_pair and not stands_alone(model, *sorted((first, second), key=above.__getitem__)):
            pairs.append(names)
    return pairs


def unavoidable_contacts(model: mujoco.MjModel, joints: Joints) -> list[tuple[str, str]]:
    """The pairs of the fixed body that an arm stands on, and a link that overlaps with it at home and wherever the arm is.

    Found by random configurations: a floor that cuts into a shoulder which turns about its vertical axis.
    """
    above = last_joint_above(model, joints)
    data = mujoco.MjData(model)
    data.qpos[:] = home_qpos(model, joints)
    pairs = set()
    for geoms in _touching_geoms(model, data):
        ground, other = sorted(geoms, key=lambda geom: above[model.geom_bodyid[geom]])
        body = int(model.geom_bodyid[ground])
        link = int(model.geom_bodyid[other])
        is_pair = above[body] < 0 <= above[link] and all(_body_names(model, body, link)) and stands_alone(model, body, link)
        if is_pair and _carries(model, data, ground, int(model.jnt_bodyid[joints[0]])):
            pairs.add((min(body, link), max(body, link)))
    rng = np.random.default_rng(0)
    for _ in range(RANDOM_CONFIGURATIONS if pairs else 0):
        data.qpos[:] = home_qpos(model, joints)
        for joint in joints:
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
            data.qpos[model.jnt_qposadr[joint]] = rng.uniform(low, high)
        pairs &= _touching(model, data)
    return [_body_names(model, *sorted(pair, key=above.__getitem__)) for pair in sorted(pairs)]


def _carries(model: mujoco.MjModel, data: mujoco.MjData, geom: int, first_link: int) -> bool:
    """Whether a fixed geom can be what an arm stands on: a plane, or a shape that lies behind the base along its z axis."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        return True
    base = int(model.body_parentid[first_link]) or first_link
    axis = data.xmat[base].reshape(3, 3)[:, 2]
    center, half_sizes = model.geom_aabb[geom].reshape(2, 3)
    turned = data.geom_xmat[geom].reshape(3, 3).T @ axis
    front = (data.geom_xpos[geom] - data.xpos[base]) @ axis + turned @ center + np.abs(turned) @ half_sizes
    return bool(front <= _LEVEL_M)


def _body_names(model: mujoco.MjModel, first: int, second: int) -> tuple[str, str]:
    return model.body(first).name, model.body(second).name


def touching_links(model: mujoco.MjModel, joints: Joints, links: Collection[str]) -> list[tuple[str, str]]:
    """The pairs of bodies, both among some links, that touch each other at home."""
    pairs = [_body_names(model, *pair) for pair in _touching_bodies(model, joints)]
    return [pair for pair in pairs if set(pair) <= set(links)]


def _touching_bodies(model: mujoco.MjModel, joints: Joints) -> list[tuple[int, int]]:
    """The pairs of bodies that touch each other while some joints are at home."""
    data = mujoco.MjData(model)
    data.qpos[:] = home_qpos(model, joints)
    return sorted(_touching(model, data))


def _touching(model: mujoco.MjModel, data: mujoco.MjData) -> set[tuple[int, int]]:
    """The pairs of bodies that touch each other in a state."""
    bodies = model.geom_bodyid
    pairs = [sorted((int(bodies[first]), int(bodies[second]))) for first, second in _touching_geoms(model, data)]
    return {(first, second) for first, second in pairs}


def _touching_geoms(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[int, int]]:
    mujoco.mj_fwdPosition(model, data)
    return [(int(contact.geom[0]), int(contact.geom[1])) for contact in data.contact if acts(contact)]
