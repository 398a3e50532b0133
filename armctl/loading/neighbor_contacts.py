"""Contacts between neighbouring links that overlap at home: they would brake the joint between them."""

from __future__ import annotations

import mujoco

from armctl.loading.home import home_qpos
from armctl.mjmodel.queries import Joints, last_joint_above


def overlapping_neighbors(model: mujoco.MjModel, joints: Joints) -> list[tuple[str, str]]:
    """The pairs of named neighbouring bodies of an arm that touch each other at home.

    MuJoCo itself leaves out contacts of a body with its parent, but not if the parent is fixed to the world.
    """
    data = mujoco.MjData(model)
    above = last_joint_above(model, joints)
    data.qpos[:] = home_qpos(model, joints)
    mujoco.mj_forward(model, data)
    touching = {tuple(sorted(int(model.geom_bodyid[g]) for g in contact.geom)) for contact in data.contact if contact.dist < 0}
    pairs = []
    for first, second in sorted(touching):
        names = (model.body(first).name, model.body(second).name)
        if first > 0 and all(names) and abs(above[first] - above[second]) == 1:
            pairs.append(names)
    return pairs
