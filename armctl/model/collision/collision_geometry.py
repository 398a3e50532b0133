"""The convex geoms of a MuJoCo model as a model for the compiled core: shapes, frames, and the pairs that may meet.

MuJoCo collides the convex hull of a mesh, so hulls and primitives are its own truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import mujoco
import numpy as np

from armctl._core import CollisionModel, ShapeKind
from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.model.arm.joint_map import JointMap
from armctl.model.arm.loop_closure import LoopClosure
from armctl.model.mjmodel.queries import DISABLES_CONTACTS, is_below, placed

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
_CONVEX = (_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH)

_NO_VERTICES = np.empty((0, 3))
_DEPTH_DIRECTIONS = 500
_BOUNDING_SPHERE_STEPS = 60  # the sphere is then within 2 % of the smallest one
_ROUNDING = 1.0 + 1e-12  # bounding spheres are computed with rounding errors


class Edges(NamedTuple):
    """Which vertices of a hull share an edge."""

    counts: IntArray  # (P,) how many neighbors each vertex has
    neighbors: IntArray  # the neighbors of the first vertex, then those of the second, and so on

    @classmethod
    def unknown(cls, vertices: Array) -> Edges:
        """No edges, for hulls of so few vertices that the core tries all of them."""
        return cls(np.zeros(len(vertices), np.int64), np.empty(0, np.int64))


_NO_EDGES = Edges.unknown(_NO_VERTICES)
_CORNER_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


class GeomShape(NamedTuple):
    """One geom at the reference configuration."""

    kind: ShapeKind  # how the core finds its support points
    frame: int  # the frame that moves it, 0 if it stands
    position: Array  # (3,) m, of the geom
    rotation: Array  # (3, 3) of the geom
    size: Array  # (3,) m, half sizes of a box or an ellipsoid; radius and half length of a cylinder
    vertices: Array  # (P, 3) m, of a hull or a box
    inflation: float  # m by which the vertices are inflated: the radius of a sphere or capsule
    center: Array  # (3,) m, of its bounding sphere
    bound: float  # m, the radius of its bounding sphere
    edges: Edges  # the edges of a mesh, by which the core searches large hulls


class Frames(NamedTuple):
    """One frame for each of the m joints that move, numbered from 1; frame 0 is the world."""

    axes: Array  # (m, 3) of the joints, in the world at the reference configuration
    anchors: Array  # (m, 3) m, a point on each axis
    slides: IntArray  # (m,) whether a joint slides
    references: Array  # (m,) rad, the joint positions of the reference configuration
    parents: IntArray  # (m,) the frames above
    joints: IntArray  # (m,) the row of each joint in the joint map
    of_body: IntArray  # (nbody,) the frame of each body

    def depths(self) -> IntArray:
        """(m + 1,) how many frames are above each, the world included."""
        depths = np.zeros(len(self.parents) + 1, np.int64)
        for i, parent in enumerate(self.parents):
            depths[i + 1] = 1 + depths[parent]
        return depths


@dataclass(frozen=True, eq=False)
class Geometry:
    """What an arm could touch, and the model of it in the compiled core."""

    geom_ids: IntArray  # (G,) the model's geoms in the order of the shapes
    shapes: Sequence[GeomShape]  # their shapes
    frames: Frames  # what moves them
    arrays: dict[str, Any]  # what the core takes, without the pairs
    closure: LoopClosure | None  # of closed loops
    core: CollisionModel  # the model in the core
    pairs: IntArray  # (K, 2) the shapes of each pair
    margins: Array  # (K,) m, the distance at which MuJoCo makes a contact of each pair

    def with_pairs(self, keep: BoolArray) -> Geometry:
        """The same geometry with the pairs that `keep` (K,) marks."""
        return _geometry(
            self.geom_ids, self.shapes, self.frames, self.arrays, self.closure, self.pairs[keep], self.margins[keep]
        )

    def with_margins(self, margins: Array) -> Geometry:
        """The same geometry with other margins (K,), m."""
        margins = np.ascontiguousarray(margins, np.float64)
        return replace(self, core=self.core.with_margins(margins), margins=frozen(margins))

    def moved_by_one_joint(self) -> IntArray:
        """(K,) the joint, a row of the joint map, that alone moves one geom of a pair relative to the other; -1 if more do."""
        frame = np.array([shape.frame for shape in self.shapes], np.int64)
        alone = np.full((len(self.frames.parents) + 1,) * 2, -1)
        child = np.arange(1, len(alone))
        alone[child, self.frames.parents] = self.frames.joints
        alone[self.frames.parents, child] = self.frames.joints
        first, second = frame[self.pairs].T
        return alone[first, second]

    def pair_geoms(self, pair: int) -> tuple[int, int]:
        first, second = self.geom_ids[self.pairs[pair]].tolist()
        return first, second


def is_convex(model: mujoco.MjModel, geom: int) -> bool:
    """Whether the core knows a geom's shape; height fields and signed distance fields are not convex."""
    return int(model.geom_type[geom]) in _CONVEX


def colliding_pairs(model: mujoco.MjModel) -> IntArray:
    """(K, 2) the pairs of geoms that MuJoCo tests for contacts, the lesser first.

    By their bits, parents and exclusions, and those that are listed.
    """
    disabled = int(model.opt.disableflags)
    if disabled & DISABLES_CONTACTS:
        return np.empty((0, 2), np.int64)
    # Two geoms that are both fixed in the world are never tested: with thousands of obstacles these are nearly all pairs.
    is_fixed = model.body_weldid[model.geom_bodyid] == 0
    moving = np.flatnonzero(~is_fixed)
    fixed = np.flatnonzero(is_fixed)
    one, other = np.triu_indices(len(moving), 1)
    first = np.concatenate([moving[one], np.repeat(moving, len(fixed))])
    second = np.concatenate([moving[other], np.tile(fixed, len(moving))])
    pairs = np.sort(np.stack([first, second]), axis=0)
    first = pairs[0]
    second = pairs[1]
    contype = model.geom_contype
    conaffinity = model.geom_conaffinity
    may_touch = ((contype[first] & conaffinity[second]) | (contype[second] & conaffinity[first])) != 0
    first = first[may_touch]
    second = second[may_touch]
    body1 = model.geom_bodyid[first]
    body2 = model.geom_bodyid[second]
    weld1 = model.body_weldid[body1]
    weld2 = model.body_weldid[body2]
    keep = weld1 != weld2
    if not disabled & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        above1 = model.body_weldid[model.body_parentid[weld1]]
        above2 = model.body_weldid[model.body_parentid[weld2]]
        keep &= ~((weld1 != 0) & (weld2 != 0) & ((weld1 == above2) | (weld2 == above1)))
    signature = (np.minimum(body1, body2).astype(np.int64) << 16) + np.maximum(body1, body2)
    keep &= ~np.isin(signature, model.exclude_signature)
    tested = np.column_stack([first[keep], second[keep]])
    listed = np.sort(np.column_stack([model.pair_geom1, model.pair_geom2]), axis=1)
    return np.unique(np.vstack([tested, listed]).astype(np.int64), axis=0)


def build_geometry(model: mujoco.MjModel, joint_map: JointMap, qpos: Array, held: dict[int, int] | None = None) -> Geometry:
    """The convex geoms that an arm could touch, or touch something with, in every pair that its motion can change.

    All joints outside the joint map stay where `qpos` (nq,) has them. `held` are bodies that are carried, and the body that
    carries each.
    """
    data = placed(model, qpos)
    mujoco.mj_comPos(model, data)
    frames = _frames(model, data, joint_map.joints, held or {})
    pairs = _moving_pairs(model, frames)
    geom_ids = np.unique(np.concatenate([pairs.ravel(), _touchable_geoms(model)]))
    shapes = [_shape(model, data, int(geom), int(frames.of_body[model.geom_bodyid[geom]])) for geom in geom_ids]
    arrays = _arrays(frames, shapes, joint_map)
    rows = np.searchsorted(geom_ids, pairs)
    return _geometry(frozen(geom_ids), shapes, frames, arrays, joint_map.closure, rows, contact_margins(model, pairs))


def _touchable_geoms(model: mujoco.MjModel) -> IntArray:
    """The convex geoms that are a shape against obstacles, whether or not the model has any: a world that is seen has some."""
    has_bits = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(has_bits & np.isin(model.geom_type, _CONVEX))


def contact_margins(model: mujoco.MjModel, pairs: IntArray) -> Array:
    """(K,) m, the distance below which MuJoCo makes a contact of each pair (K, 2) of geoms, which then press on each other.

    This is the sum of the margins of both geoms, the margin of a pair that is listed, or that of the options.
    """
    margins = model.geom_margin[pairs].sum(axis=1)
    listed = {
        (min(first, second), max(first, second)): margin
        for first, second, margin in zip(
            model.pair_geom1.tolist(), model.pair_geom2.tolist(), model.pair_margin.tolist(), strict=True
        )
    }
    if listed:
        margins = np.array([listed.get((min(a, b), max(a, b)), m) for (a, b), m in zip(pairs.tolist(), margins, strict=True)])
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        margins = np.full(len(pairs), model.opt.o_margin)
    return np.maximum(margins, 0.0)


def _geometry(
    geom_ids: IntArray,
    shapes: Sequence[GeomShape],
    frames: Frames,
    arrays: dict[str, Any],
    closure: LoopClosure | None,
    pairs: IntArray,
    margins: Array,
) -> Geometry:
    first_geoms, second_geoms = np.ascontiguousarray(pairs.T, np.int64)
    margins = np.ascontiguousarray(margins, np.float64)
    core = CollisionModel(**arrays, first_geoms=first_geoms, second_geoms=second_geoms, margins=margins)
    return Geometry(
        geom_ids=geom_ids,
        shapes=shapes,
        frames=frames,
        arrays=arrays,
        closure=closure,
        core=core if closure is None else core.with_loops(closure.core),
        pairs=frozen(pairs),
        margins=frozen(margins),
    )


def _arrays(frames: Frames, shapes: Sequence[GeomShape], joint_map: JointMap) -> dict[str, Any]:
    """What the core takes, without the pairs."""
    return {
        "axes": frames.axes,
        "anchors": frames.anchors,
        "slides": frames.slides,
        "references": frames.references,
        "parents": frames.parents,
        "joints": frames.joints,
        "n": joint_map.fixed_ratio.shape[1],
        "ratio": joint_map.fixed_ratio,
        "joint_offset": joint_map.offset,
        "directions": _depth_directions(),
        **shape_arrays(shapes),
    }


def shape_arrays(shapes: Sequence[GeomShape]) -> dict[str, Array | IntArray]:
    """What the core takes of geoms, without the pairs."""
    first_vertex = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    counts = [shape.edges.counts for shape in shapes]
    neighbors = [shape.edges.neighbors + first for shape, first in zip(shapes, first_vertex[:-1], strict=True)]
    return {
        "kinds": np.array([int(shape.kind) for shape in shapes], np.int64),
        "frames": np.array([shape.frame for shape in shapes], np.int64),
        "inflations": np.array([shape.inflation for shape in shapes], np.float64),
        "positions": np.array([shape.position for shape in shapes]).reshape(-1, 3),
        "rotations": np.array([shape.rotation for shape in shapes]).reshape(-1, 3, 3),
        "sizes": np.array([shape.size for shape in shapes]).reshape(-1, 3),
        "centers": np.array([shape.center for shape in shapes]).reshape(-1, 3),
        "radii": np.array([shape.bound for shape in shapes], np.float64) * _ROUNDING,
        "first_vertex": first_vertex.astype(np.int64),
        "vertices": np.concatenate([_NO_VERTICES, *(shape.vertices for shape in shapes)]),
        "first_neighbor": np.cumsum(np.concatenate([[0], *counts])).astype(np.int64),
        "neighbors": np.concatenate([np.empty(0, np.int64), *neighbors]).astype(np.int64),
    }


def bounding_sphere(centers: Array, radii: Array) -> tuple[Array, float]:
    """Center (3,) and radius of a small sphere around spheres (N, 3) and (N,).

    M. Badoiu, K. L. Clarkson, "Smaller core-sets for balls", SODA 2003.
    """
    columns = np.ascontiguousarray(centers.T)
    center = 0.5 * (centers.min(axis=0) + centers.max(axis=0))

    def reaches() -> Array:
        x, y, z = columns - center[:, None]
        return np.sqrt(x * x + y * y + z * z) + radii

    for step in range(_BOUNDING_SPHERE_STEPS):
        center = center + (centers[reaches().argmax()] - center) / (step + 2)
    return center, float(reaches().max())


@lru_cache(maxsize=1)
def _depth_directions() -> Array:
    """(D, 3) unit vectors, spread evenly over the sphere (Fibonacci lattice), with the axes of the world."""
    i = np.arange(_DEPTH_DIRECTIONS) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / _DEPTH_DIRECTIONS)
    turn = np.pi * (1.0 + np.sqrt(5.0)) * i
    lattice = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    return np.vstack([lattice, np.eye(3), -np.eye(3)])


def _frames(model: mujoco.MjModel, data: mujoco.MjData, order: Sequence[int], held: dict[int, int]) -> Frames:
    """One frame for each joint that moves. A body belongs to the last one above it, a carried body to its carrier's."""
    joints = sorted(order)  # MuJoCo numbers parents before children
    parents = np.zeros(len(joints), np.int64)
    of_body = np.zeros(model.nbody, np.int64)
    for body in range(1, model.nbody):
        of_body[body] = of_body[int(model.body_parentid[body])]
        for i, joint in enumerate(joints):
            if model.jnt_bodyid[joint] == body:
                parents[i] = of_body[body]
                of_body[body] = i + 1
    for body in range(1, model.nbody):
        for carried, carrier in held.items():
            if is_below(model, body, carried):
                of_body[body] = of_body[carrier]
    return Frames(
        axes=data.xaxis[joints],
        anchors=data.xanchor[joints],
        slides=(model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)).astype(np.int64),
        references=data.qpos[model.jnt_qposadr[joints]],
        parents=parents,
        joints=np.array([order.index(joint) for joint in joints], np.int64),
        of_body=of_body,
    )


def _moving_pairs(model: mujoco.MjModel, frames: Frames) -> IntArray:
    """The convex pairs that the motion of the arm can change; the geom that is nearer to the base first, as planes are."""
    pairs = colliding_pairs(model)
    frame = frames.of_body[model.geom_bodyid]
    convex = np.isin(model.geom_type, _CONVEX)
    pairs = pairs[(frame[pairs[:, 0]] != frame[pairs[:, 1]]) & convex[pairs].all(axis=1)]
    depths = frames.depths()[frame]
    swap = depths[pairs[:, 0]] > depths[pairs[:, 1]]
    pairs[swap] = pairs[swap][:, ::-1]
    return pairs


def _shape(model: mujoco.MjModel, data: mujoco.MjData, geom: int, frame: int) -> GeomShape:
    """The shape of a geom in the world, where `data` has it."""
    place = Place(frame, data.geom_xpos[geom].copy(), data.geom_xmat[geom].reshape(3, 3).copy())
    kind = int(model.geom_type[geom])
    if kind == _MESH:
        return hull_shape(place, model.geom_size[geom], *mesh_hull(model, int(model.geom_dataid[geom])))
    return primitive_shape(place, kind, model.geom_size[geom])


class Place(NamedTuple):
    """Where a geom is at the reference configuration."""

    frame: int
    position: Array  # (3,) m
    rotation: Array  # (3, 3)


def primitive_shape(place: Place, kind: int, size: Array) -> GeomShape:
    """A geom of one of MuJoCo's kinds, with MuJoCo's size, other than a mesh."""
    position = place.position
    R = place.rotation
    round_shape = GeomShape(
        kind=ShapeKind.HULL,
        frame=place.frame,
        position=position,
        rotation=R,
        size=size,
        vertices=_NO_VERTICES,
        inflation=0.0,
        center=position,
        bound=np.inf,
        edges=_NO_EDGES,
    )
    if kind == _PLANE:
        return round_shape._replace(kind=ShapeKind.PLANE)
    if kind == _ELLIPSOID:
        return round_shape._replace(kind=ShapeKind.ELLIPSOID, bound=float(size.max()))
    if kind == _CYLINDER:
        return round_shape._replace(kind=ShapeKind.CYLINDER, bound=float(np.hypot(size[0], size[1])))
    if kind == _SPHERE:
        radius = float(size[0])
        center = position[None]
        return round_shape._replace(vertices=center, inflation=radius, bound=radius, edges=Edges.unknown(center))
    if kind == _CAPSULE:
        axis = R[:, 2] * size[1]
        ends = np.array([position - axis, position + axis])
        bound = float(size[0] + size[1])
        return round_shape._replace(vertices=ends, inflation=float(size[0]), bound=bound, edges=Edges.unknown(ends))
    corners = position + (_CORNER_SIGNS * size) @ R.T
    bound = float(np.linalg.norm(size))
    return round_shape._replace(kind=ShapeKind.BOX, vertices=corners, bound=bound, edges=Edges.unknown(corners))


def hull_shape(place: Place, size: Array, vertices: Array, edges: Edges) -> GeomShape:
    """A convex hull of vertices (V, 3) of its own frame."""
    vertices = place.position + vertices @ place.rotation.T
    center, bound = bounding_sphere(vertices, np.zeros(len(vertices)))
    return GeomShape(
        kind=ShapeKind.HULL,
        frame=place.frame,
        position=place.position,
        rotation=place.rotation,
        size=size,
        vertices=vertices,
        inflation=0.0,
        center=center,
        bound=bound,
        edges=edges,
    )


def mesh_hull(model: mujoco.MjModel, mesh: int) -> tuple[Array, Edges]:
    """The vertices of a mesh's convex hull, (V, 3), and its edges, by MuJoCo's own hull graph.

    The graph is: numbers of vertices and faces, where the edges of each vertex start, the vertices' numbers, and the edges of
    one vertex after another, each list ended by -1 (MuJoCo's `mesh_graph`).
    """
    address = int(model.mesh_vertadr[mesh])
    vertices = model.mesh_vert[address : address + model.mesh_vertnum[mesh]].astype(np.float64)
    graph_address = int(model.mesh_graphadr[mesh])
    if graph_address < 0:  # a mesh of four vertices at most is its own hull
        return vertices, Edges.unknown(vertices)
    count = int(model.mesh_graph[graph_address])
    faces = int(model.mesh_graph[graph_address + 1])
    graph = model.mesh_graph[graph_address + 2 : graph_address + 2 + 3 * (count + faces)].astype(np.int64)
    starts, numbers, edges = np.split(graph, [count, 2 * count])
    stops = np.flatnonzero(edges < 0)
    return vertices[numbers], Edges(counts=stops - starts, neighbors=edges[edges >= 0])
