"""Which pairs of geoms `DifferentialIk` keeps apart."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.collision.checkers import geom_owners
from armctl.core.validation import BoolArray, IntArray
from armctl.robot.arm import Arm

CLEARANCE_SAMPLES = 16  # configurations
DISTANCE_MARGIN_M = 1e-3


def avoidable_pairs(arm: Arm, clearance: float) -> IntArray:
    """(k, 2) geoms that could collide and that some motion of the arm keeps apart by `clearance`, m.

    Left out are pairs that MuJoCo does not let collide, neighbours in the chain, and pairs nearer than the clearance in every
    one of several random configurations.
    """
    model = arm.model
    owner = geom_owners(arm)
    one, other = np.triu_indices(model.ngeom, 1)
    own_tree = model.body_rootid[model.geom_bodyid] == model.body_rootid[arm.tip_body]
    scene = (owner < 0) & ~own_tree
    neighbours = (np.abs(owner[one] - owner[other]) <= 1) & ~scene[one] & ~scene[other]
    pairs = np.stack([one, other], axis=1)[_can_collide(model, one, other) & (owner[one] != owner[other]) & ~neighbours]
    near = np.ones(len(pairs), bool)
    data = mujoco.MjData(model)
    for q in arm.limits.random(arm.home, CLEARANCE_SAMPLES, np.random.default_rng(0)):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(model, data)
        for k in np.flatnonzero(near):
            far = 2 * clearance + DISTANCE_MARGIN_M
            near[k] = mujoco.mj_geomDistance(model, data, *pairs[k], far, None) < clearance
    return pairs[~near]


def _can_collide(model: mujoco.MjModel, one: IntArray, other: IntArray) -> BoolArray:
    """Whether MuJoCo lets pairs of geoms collide: by their contact masks and by the excluded pairs of bodies."""
    mask = model.geom_contype
    affinity = model.geom_conaffinity
    body = model.geom_bodyid
    masked_in = ((mask[one] & affinity[other]) | (mask[other] & affinity[one])) != 0
    signature = (body[one] << 16) + body[other]  # MuJoCo's code for a pair of bodies
    reversed_signature = (body[other] << 16) + body[one]
    return masked_in & ~np.isin(signature, model.exclude_signature) & ~np.isin(reversed_signature, model.exclude_signature)
