"""Which pairs of geoms `DifferentialIk` keeps apart."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.collision.checker import geom_owners
from armctl.core.validation import IntArray
from armctl.robot.arm import Arm

CLEARANCE_SAMPLES = 16


def avoidable_pairs(arm: Arm, clearance: float) -> IntArray:
    """The pairs of geoms that could collide and that some motion of the arm keeps apart.

    Left out are pairs that MuJoCo does not let collide, neighbours in the chain, and pairs nearer than the clearance in every
    one of many random positions.

    Args:
        arm: The arm.
        clearance: m.

    Returns:
        (k, 2).
    """
    model, owner = arm.model, geom_owners(arm)
    one, other = np.triu_indices(model.ngeom, 1)
    mask, affinity, body = model.geom_contype, model.geom_conaffinity, model.geom_bodyid
    can = ((mask[one] & affinity[other]) | (mask[other] & affinity[one])) != 0
    excluded = (body[one] << 16) + body[other], (body[other] << 16) + body[one]
    can &= ~np.isin(excluded[0], model.exclude_signature) & ~np.isin(excluded[1], model.exclude_signature)
    base = model.body_rootid[body] == model.body_rootid[arm.tip_body]  # of the arm's own tree
    scene = (owner < 0) & ~base
    neighbours = (np.abs(owner[one] - owner[other]) <= 1) & ~scene[one] & ~scene[other]
    pairs = np.stack([one, other], axis=1)[can & (owner[one] != owner[other]) & ~neighbours]
    near, data = np.ones(len(pairs), bool), mujoco.MjData(model)
    for q in arm.limits.random(arm.home, CLEARANCE_SAMPLES, np.random.default_rng(0)):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(model, data)
        for k in np.flatnonzero(near):
            near[k] = mujoco.mj_geomDistance(model, data, *pairs[k], 2 * clearance + 1e-3, None) < clearance
    return pairs[~near]
