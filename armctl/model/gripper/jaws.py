"""Jaws: the two sides of a gripper and the distance between them, whatever describes their shape."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, frozen
from armctl.model.mjmodel.queries import branches, is_below

MIN_OPENING = 1e-3  # m
# The pads are the two geoms whose distance changes most. A gap that remains in the closed gripper counts against them.
_GAP_WEIGHT = 3.0
# Convex hulls that overlap in most states show less than this fraction of the opening of the points on the jaws.
_MIN_SHOWN_FRACTION = 0.4
MAX_JAW_DISTANCE = 1.0  # m, up to which distances are computed
_TIP_FRACTION = 0.9  # of the largest displacement on a jaw: what moves as far as this is its tip
_CENTER_WEIGHT = 0.1  # of the distance between centers, where the jaws touch both when open and when closed
_MAX_POINTS_PER_GEOM = 1000
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


class BodyPoint(NamedTuple):
    """A point that moves with a body: the body's number, and (3,) m in its frame."""

    body: int
    position: Array


class _Patch(NamedTuple):
    """Points on one side of a gripper: (k,) bodies, (k, 3) m in their frames, (states, k, 3) m in the world."""

    bodies: Array
    local: Array
    world: Array


@dataclass(frozen=True, eq=False)
class Jaws:
    """The two sides of a gripper."""

    sides: tuple[frozenset[int], frozenset[int]]  # the bodies on each side; the second can be the palm
    # the two geoms that meet when the gripper closes; empty if the geoms overlap also when it is open, or are missing
    pads: tuple[int, ...]
    points: tuple[BodyPoint, ...] = ()  # without pads: one point on each side, nearest to each other when closed; else empty
    offset: float = 0.0  # without pads: the distance of the points when closed, m

    def width(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """The distance between the jaws, m, in a state whose positions are computed; 0 if they touch.

        Without pads it is how much farther apart the two points are than in the closed gripper.
        """
        if self.pads:
            return _geom_distance(model, data, self.pads[0], self.pads[1])
        places = [data.xpos[p.body] + data.xmat[p.body].reshape(3, 3) @ p.position for p in self.points]
        return max(0.0, float(np.linalg.norm(places[0] - places[1])) - self.offset)

    def pad_bodies(self, model: mujoco.MjModel) -> set[int]:
        """The bodies of the two pads, or of the points that stand for them."""
        return {int(model.geom_bodyid[pad]) for pad in self.pads} or {point.body for point in self.points}


def find_jaws(model: mujoco.MjModel, states: Sequence[mujoco.MjData], palm: frozenset[int]) -> tuple[Jaws, int, int]:
    """The jaws of a gripper, from its states at the ends of its actuators' ranges, and the indices of the closed and open one.

    The pads are the geoms whose distance changes most. Collision geoms are convex hulls, which can overlap in every state, and
    a file can lack them. The tip of a jaw is then what moves farthest, by vertices of its meshes, else by its center of mass.
    The palm is the bodies that carry the jaws. ModelError if nothing opens or closes.
    """
    roots = branches(model, min(palm))
    sides = [frozenset(b for b in range(model.nbody) if is_below(model, b, root)) for root in roots]
    by_points = _jaws_by_points(model, states, sides, palm)
    by_geoms = _jaws_by_geoms(model, states, [*sides, palm])
    openings = [_opening(model, states, found) for found in (by_points, by_geoms)]
    best = by_geoms if openings[1] >= _MIN_SHOWN_FRACTION * openings[0] else by_points
    if best is None or max(openings) < MIN_OPENING:
        raise ModelError("no gripper: nothing attached to the tip opens or closes")
    return best


def _opening(model: mujoco.MjModel, states: Sequence[mujoco.MjData], found: tuple[Jaws, int, int] | None) -> float:
    """How far jaws open, m; 0 for none."""
    if found is None:
        return 0.0
    jaws, closed, opened = found
    return jaws.width(model, states[opened]) - jaws.width(model, states[closed])


def _geom_distance(model: mujoco.MjModel, data: mujoco.MjData, first: int, second: int) -> float:
    return max(0.0, mujoco.mj_geomDistance(model, data, first, second, MAX_JAW_DISTANCE, None))


def _jaws_by_geoms(
    model: mujoco.MjModel, states: Sequence[mujoco.MjData], sides: Sequence[frozenset[int]]
) -> tuple[Jaws, int, int] | None:
    """The two geoms that meet when the gripper closes and separate most when it opens; None if no geoms can touch."""
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = [[int(g) for g in np.flatnonzero(np.isin(model.geom_bodyid, list(side)) & solid)] for side in sides]
    pairs = [
        (pair, (first, second))
        for (first, some), (second, others) in combinations(zip(sides, geoms, strict=True), 2)
        for pair in product(some, others)
    ]
    if not pairs:
        return None
    distance = np.array([[_geom_distance(model, data, *pair) for data in states] for pair, _ in pairs])
    best = int(np.argmax(np.ptp(distance, axis=1) - _GAP_WEIGHT * distance.min(axis=1)))
    pads, chosen = pairs[best]
    return Jaws(chosen, pads), int(distance[best].argmin()), int(distance[best].argmax())


def _jaws_by_points(
    model: mujoco.MjModel, states: Sequence[mujoco.MjData], branch_sides: Sequence[frozenset[int]], palm: frozenset[int]
) -> tuple[Jaws, int, int] | None:
    """The two points, one on the tip of each jaw, that are nearest to each other when closed; None if nothing moves."""
    patches = [_patch(model, states, side) for side in branch_sides]
    travels = [float(_travel(patch).max()) for patch in patches]
    moving = sorted((k for k in range(len(patches)) if travels[k] > MIN_OPENING), key=lambda k: -travels[k])[:2]
    if not moving:
        return None
    chosen = [branch_sides[k] for k in moving]
    tips = [_tip_of(patches[k]) for k in moving]
    if len(chosen) == 1:
        chosen.append(palm)
        tips.append(_patch(model, states, palm))
    nearest = [_nearest(tips[0].world[k], tips[1].world[k]) for k in range(len(states))]
    centers = [np.linalg.norm(tips[0].world[k].mean(axis=0) - tips[1].world[k].mean(axis=0)) for k in range(len(states))]
    closeness = [near[0] + _CENTER_WEIGHT * float(center) for near, center in zip(nearest, centers, strict=True)]
    closed = int(np.argmin(closeness))
    offset, *indices = nearest[closed]
    points = tuple(BodyPoint(int(tip.bodies[i]), frozen(tip.local[i])) for tip, i in zip(tips, indices, strict=True))
    return Jaws(sides=(chosen[0], chosen[1]), pads=(), points=points, offset=offset), closed, int(np.argmax(closeness))


def _patch(model: mujoco.MjModel, states: Sequence[mujoco.MjData], side: frozenset[int]) -> _Patch:
    """The points that describe the shape of bodies; the centers of mass if none of them has a geom."""
    geoms = [int(g) for g in np.flatnonzero(np.isin(model.geom_bodyid, list(side)))]
    local: list[Array] = [geom_points(model, g) for g in geoms] or [model.body_ipos[b][None] for b in sorted(side)]
    owners = [int(model.geom_bodyid[g]) for g in geoms] or sorted(side)
    bodies = np.repeat(owners, [len(points) for points in local])
    positions = np.concatenate(local)
    rotations = [data.xmat[bodies].reshape(-1, 3, 3) for data in states]
    world = [data.xpos[bodies] + np.einsum("kij,kj->ki", R, positions) for data, R in zip(states, rotations, strict=True)]
    return _Patch(bodies, positions, np.array(world))


def geom_points(model: mujoco.MjModel, geom: int) -> Array:
    """(k, 3) m points of a geom in its body's frame: vertices of a mesh, else the corners of its bounding box."""
    mesh = int(model.geom_dataid[geom])
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and mesh >= 0:
        first = int(model.mesh_vertadr[mesh])
        count = int(model.mesh_vertnum[mesh])
        points = model.mesh_vert[first : first + count : 1 + count // _MAX_POINTS_PER_GEOM].astype(float)
    else:
        points = model.geom_aabb[geom, :3] + _CORNERS * model.geom_aabb[geom, 3:]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return model.geom_pos[geom] + points @ rotation.reshape(3, 3).T


def _travel(patch: _Patch) -> Array:
    """(k,) m, how far each point is from where the first state has it, at most."""
    return np.linalg.norm(patch.world - patch.world[0], axis=2).max(axis=0)


def _tip_of(patch: _Patch) -> _Patch:
    travel = _travel(patch)
    far = travel >= _TIP_FRACTION * travel.max()
    return _Patch(patch.bodies[far], patch.local[far], patch.world[:, far])


def _nearest(first: Array, second: Array) -> tuple[float, int, int]:
    """The smallest distance between two sets of points, m, and the index of each."""
    from scipy.spatial import KDTree

    found = KDTree(second).query(first)
    distances = np.asarray(found[0])
    best = int(np.argmin(distances))
    return float(distances[best]), best, int(np.asarray(found[1])[best])
