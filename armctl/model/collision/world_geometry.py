"""The bodies of a world as geoms of the compiled core, added to those of an arm's model, which stays as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from armctl._core import CollisionAdditions, PointCloud, ShapeKind
from armctl.core.errors import InputError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.shapes import Mesh, Points, Shape
from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.model.arm.arm import Arm
from armctl.model.collision.collision_geometry import (
    Edges,
    Geometry,
    GeomShape,
    Place,
    hull_shape,
    mesh_hull,
    primitive_shape,
    shape_arrays,
)
from armctl.model.collision.world_snapshot import WorldBody, WorldSnapshot, checked_tip, is_of_model
from armctl.model.mjmodel.queries import is_below, object_id, placed, robot_roots
from armctl.model.mjmodel.shape_geoms import add_shape, geom_form

_NO_SIZE = np.zeros(3)
_SAME_PLACE = 1e-6  # m, rad: a body of the model that a world has, too, is at the same place
_hulls: WeakKeyDictionary[Mesh, tuple[Array, Edges]] = WeakKeyDictionary()
_clouds: WeakKeyDictionary[Points, PointCloud] = WeakKeyDictionary()


class PlacedBody(NamedTuple):
    """A body of a world at the reference configuration of a geometry."""

    name: str
    shape: Shape
    place: Place


@dataclass(frozen=True, eq=False)
class WorldGeometry:
    """A geometry with the bodies of a world.

    Attributes:
        geometry: The geometry; the numbers of the bodies' geoms follow those of the model's geoms.
        names: The bodies, in the order of their numbers.
    """

    geometry: Geometry
    names: tuple[str, ...]


def add_world(arm: Arm, geometry: Geometry, qpos: Array, snapshot: WorldSnapshot) -> WorldGeometry:
    """An arm's geometry with a world around the arm.

    `qpos` (nq,) is the reference configuration of the geometry. A body that stands may meet what moves; an attached one
    everything that it moves against. A body that the model has at the same place, as one that was loaded with the world, is the
    model's; InputError for another one of the name.
    """
    bodies = _placed_bodies(arm, geometry, qpos, snapshot)
    solid = [body for body in bodies if not isinstance(body.shape, Points)]
    clouds = [body for body in bodies if isinstance(body.shape, Points)]
    shapes = [_solid_shape(body.shape, body.place) for body in solid]
    names = tuple(body.name for body in (*solid, *clouds))
    first = len(geometry.geom_ids)
    ids = np.concatenate([geometry.geom_ids, arm.model.ngeom + np.arange(len(names))])
    frames = np.array(
        [*(shape.frame for shape in geometry.shapes), *(body.place.frame for body in (*solid, *clouds))], np.int64
    )
    owners = _Owners(arm.model, geometry.geom_ids, names)
    pairs = _pairs(geometry, frames, first, len(solid))
    margins = np.concatenate([arm.model.geom_margin[geometry.geom_ids], np.zeros(len(names))])[pairs].sum(axis=1)
    allowed = [(owners.named(one), owners.named(other)) for one, other in sorted(snapshot.allowed)]
    kept = ~_are_allowed(geometry.pairs, allowed)
    added = ~_are_allowed(pairs, allowed)
    additions = CollisionAdditions(
        **shape_arrays(shapes),
        first_geoms=np.ascontiguousarray(pairs[added, 0]),
        second_geoms=np.ascontiguousarray(pairs[added, 1]),
        margins=np.ascontiguousarray(margins[added]),
        kept_pairs=kept.astype(np.int64),
    )
    poses = np.array([[*body.place.rotation.ravel(), *body.place.position] for body in clouds]).reshape(-1, 12)
    core = geometry.core.with_additions(additions, [_cloud(body.shape) for body in clouds], poses)
    whole = replace(
        geometry,
        geom_ids=frozen(ids),
        shapes=[*geometry.shapes, *shapes, *(_cloud_shape(body.place) for body in clouds)],
        core=core,
        pairs=frozen(np.concatenate([geometry.pairs[kept], pairs[added]])),
        margins=frozen(np.concatenate([geometry.margins[kept], margins[added]])),
    )
    return WorldGeometry(geometry=whole, names=names)


def _placed_bodies(arm: Arm, geometry: Geometry, qpos: Array, snapshot: WorldSnapshot) -> list[PlacedBody]:
    """The bodies that the model does not have, where they are at the reference configuration."""
    tips: dict[str, tuple[int, Pose]] = {}
    placed_bodies = []
    for body in snapshot.bodies.values():
        if body.shape is None:
            continue
        if is_of_model(arm, body.name):
            _require_same(arm, qpos, body)
            continue
        frame = 0
        pose = body.pose
        if body.tip is not None:
            if not tips:
                tips = _tip_poses(arm, geometry, qpos)
            frame, T_world_tip = tips[checked_tip(arm, body)]
            pose = T_world_tip @ body.pose
        placed_bodies.append(PlacedBody(body.name, body.shape, Place(frame, pose.position, pose.rotation)))
    return placed_bodies


def _require_same(arm: Arm, qpos: Array, body: WorldBody) -> None:
    """InputError for a body of a world that has the name of another body of the model, which is not added twice."""
    number = object_id(arm.model, mujoco.mjtObj.mjOBJ_BODY, body.name)
    if any(is_below(arm.model, number, root) for root in robot_roots(arm.model, arm.joint_map.joints)):
        raise InputError(f"world: {body.name:.60} is the name of a part of the robot; give the body another name")
    data = placed(arm.model, qpos)
    distance, angle = Pose(data.xpos[number], data.xquat[number]).distance(body.pose)
    if body.tip is not None or max(distance, angle) > _SAME_PLACE:
        raise InputError(
            f"world: the model has a body {body.name:.60} already, and elsewhere; give the body of the world another name"
        )


def _tip_poses(arm: Arm, geometry: Geometry, qpos: Array) -> dict[str, tuple[int, Pose]]:
    """The frame and the pose in the world of each tip, at the reference configuration."""
    data = placed(arm.model, qpos)
    poses = {}
    for frame in arm.tip_frames:
        T_world_body = Pose(data.xpos[frame.body], data.xquat[frame.body])
        poses[frame.name] = (int(geometry.frames.of_body[frame.body]), T_world_body @ frame.T_body_tip)
    return poses


def _pairs(geometry: Geometry, frames: IntArray, first: int, solids: int) -> IntArray:
    """(K, 2) the pairs of the geoms behind `first` with all that moves against them; what has fewer joints above it first."""
    depths = geometry.frames.depths()[frames]
    numbers = np.arange(len(frames))
    found = [np.empty((0, 2), np.int64)]
    moving = numbers[frames != 0]
    standing = numbers[first:][frames[first:] == 0]
    robot = moving[moving < first]
    found.append(np.column_stack([np.repeat(standing, len(robot)), np.tile(robot, len(standing))]))
    for carried in moving[moving >= first].tolist():
        others = numbers[(frames != frames[carried]) & ((numbers < first) | (frames == 0) | (numbers < carried))]
        comes_first = depths[others] <= depths[carried]
        ones = np.where(comes_first, others, carried)
        found.append(np.column_stack([ones, np.where(comes_first, carried, others)]))
    return np.concatenate(found).astype(np.int64)


class _Owners(NamedTuple):
    """Which geoms a name stands for."""

    model: mujoco.MjModel
    geom_ids: IntArray
    names: tuple[str, ...]

    def named(self, name: str) -> IntArray:
        """The rows of the geoms of a body of the world, of a body of the model and those below it, or of a geom."""
        if name in self.names:
            return np.array([len(self.geom_ids) + self.names.index(name)])
        body = object_id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body >= 0:
            owners = self.model.geom_bodyid[self.geom_ids].tolist()
            return np.flatnonzero([is_below(self.model, owner, body) for owner in owners])
        geom = object_id(self.model, mujoco.mjtObj.mjOBJ_GEOM, name)
        if geom < 0:
            bodies = [self.model.body(i).name for i in range(1, self.model.nbody)]
            raise UnknownNameError.from_known("body in allow", name, [*self.names, *bodies])
        return np.flatnonzero(self.geom_ids == geom)


def _are_allowed(pairs: IntArray, allowed: Sequence[tuple[IntArray, IntArray]]) -> BoolArray:
    """(K,) which pairs of geoms may touch."""
    found = np.zeros(len(pairs), bool)
    for one, other in allowed:
        first = np.isin(pairs, one)
        second = np.isin(pairs, other)
        found |= (first[:, 0] & second[:, 1]) | (first[:, 1] & second[:, 0])
    return found


def _solid_shape(shape: Shape, place: Place) -> GeomShape:
    """A shape, other than points, at a place."""
    form = geom_form(shape)
    if not isinstance(shape, Mesh):
        return primitive_shape(place, int(form.kind), form.size)
    if shape not in _hulls:
        _hulls[shape] = _hull_of(shape)
    return hull_shape(place, form.size, *_hulls[shape])


def _hull_of(mesh: Mesh) -> tuple[Array, Edges]:
    """The vertices of the convex hull of a mesh in its own frame, and its edges, by MuJoCo."""
    spec = mujoco.MjSpec()
    add_shape(spec, spec.worldbody, "mesh", mesh)
    model = spec.compile()
    vertices, edges = mesh_hull(model, 0)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    return model.mesh_pos[0] + vertices @ rotation.reshape(3, 3).T, edges


def _cloud(shape: Shape) -> PointCloud:
    """The tree of a cloud; it is made once."""
    assert isinstance(shape, Points)
    if shape not in _clouds:
        _clouds[shape] = PointCloud(shape.points, shape.radius)
    return _clouds[shape]


def _cloud_shape(place: Place) -> GeomShape:
    """What a geometry knows of a cloud, which the core has itself."""
    nothing = np.empty((0, 3))
    return GeomShape(
        kind=ShapeKind.POINTS,
        frame=0,
        position=place.position,
        rotation=place.rotation,
        size=_NO_SIZE,
        vertices=nothing,
        inflation=0.0,
        center=place.position,
        bound=np.inf,
        edges=Edges.unknown(nothing),
    )
