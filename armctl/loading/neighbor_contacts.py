"""Contacts between links that overlap at home: they would brake the joints between them."""

from __future__ import annotations

from collections.abc import Collection

import mujoco

from armctl.loading.home import home_qpos
from armctl.mjmodel.queries import Joints, last_joint_above


def overlapping_neighbors(model: mujoco.MjModel, joints: Joints) -> list[tuple[str, str]]:
    """The pairs of named neighbouring bodies of an arm that touch each other at home.

    MuJoCo itself leaves out contacts of a body with its parent, but not if the parent is fixed to the world.
    """
    above = last_joint_above(model, joints)
    touching = _touching_bodies(model, joints)
    pairs = []
    for first, second in touching:
        names = (model.body(first).name, model.body(second).name)
        if first > 0 and all(names) and abs(above[first] - above[second]) == 1:
            pairs.append(names)
    return pairs


def touching_links(model: mujoco.MjModel, joints: Joints, links: Collection[str]) -> list[tuple[str, str]]:
    """The pairs of bodies, both among some links, that touch each other at home."""
    pairs = [(model.body(first).name, model.body(second).name) for first, second in _touching_bodies(model, joints)]
    return [pair for pair in pairs if set(pair) <= set(links)]


def _touching_bodies(model: mujoco.MjModel, joints: Joints) -> list[tuple[int, int]]:
    """The pairs of bodies that touch each other while some joints are at home."""
    data = mujoco.MjData(model)
    data.qpos[:] = home_qpos(model, joints)
    mujoco.mj_forward(model, data)
    found = set()
    for contact in data.contact:
        if contact.dist < 0:
            first, second = sorted(int(model.geom_bodyid[g]) for g in contact.geom)
            found.add((first, second))
    return sorted(found)
