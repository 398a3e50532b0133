"""The convex geoms of a MuJoCo model as packed rows for the collision kernels: shapes, frames, and the pairs that may meet.

MuJoCo collides the convex hull of a mesh, so hulls and primitives are its own truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.collision import kernel
from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.mjmodel.queries import is_below

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
_CONVEX = (_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH)

_SPHERE_STEPS = 60  # of the iteration towards the smallest bounding sphere: within 2 % of it
_ROUNDING = 1.0 + 1e-12


class Shape(NamedTuple):
    """One geom at the reference configuration.

    Attributes:
        kind: POINTS, CYLINDER, ELLIPSOID or PLANE of the kernel.
        points: (P, 3) m, the vertices; the center of a round shape.
        radius: m by which it is inflated.
        info: (16,) the parameters of a round shape or a plane for the kernel.
        box: (15,) center, inverse rotation, half sizes of a box; None for other shapes.
        center: (3,) m, of its bounding sphere.
        bound: m, the radius of its bounding sphere.
        neighbors: For each vertex those that share an edge with it; empty where all are tried.
    """

    kind: int
    points: Array
    radius: float
    info: Array
    box: Array | None
    center: Array
    bound: float
    neighbors: Sequence[Sequence[int]]


class Frames(NamedTuple):
    """What moves, as rows of `tree`, and which frame each body belongs to.

    Attributes:
        tree: (F, 11) as the kernel reads it.
        of_body: (nbody,) frame of each body; 0 where it stands in the world.
    """

    tree: Array
    of_body: IntArray


@dataclass(frozen=True, eq=False)
class Geometry:
    """The packed rows of a model. Arrays are read-only; `pairs` is copied by each thread that asks.

    Attributes:
        geom_ids: (G,) the model's geoms in the order of the rows.
        geoms: (G + groups, 41).
        points: (P, 5).
        neighbors: (N,).
        pairs: (K, 9).
        groups: (Q, 4).
        tree: (F, 11).
        depth: Frames above the deepest one, the world included.
    """

    geom_ids: IntArray
    geoms: Array
    points: Array
    neighbors: IntArray
    pairs: Array
    groups: IntArray
    tree: Array
    depth: int

    def with_pairs(self, keep: BoolArray) -> Geometry:
        """The same geometry with fewer pairs.

        Args:
            keep: (K,) which pairs stay.

        Returns:
            The geometry.
        """
        rows = self.pairs[keep][:, [kernel.A, kernel.B]].astype(np.int64)
        count = len(self.geom_ids)
        return _packed(self.geom_ids, self.geoms[:count], self.points, self.neighbors, self.tree, rows)

    def pair_geoms(self, pair: int) -> tuple[int, int]:
        """The model's geoms of a pair.

        Args:
            pair: Its row.

        Returns:
            Both geoms.
        """
        first = int(self.pairs[pair, kernel.A])
        second = int(self.pairs[pair, kernel.B])
        return int(self.geom_ids[first]), int(self.geom_ids[second])


def is_convex(model: mujoco.MjModel, geom: int) -> bool:
    """Whether the kernels know a geom's shape; height fields and signed distance fields are not convex.

    Args:
        model: The model.
        geom: The geom.

    Returns:
        True if they do.
    """
    return int(model.geom_type[geom]) in _CONVEX


def colliding_pairs(model: mujoco.MjModel) -> IntArray:
    """The pairs of geoms that MuJoCo tests for contacts: by their bits, parents and exclusions, and those that are listed.

    Args:
        model: The model.

    Returns:
        (K, 2), the lesser geom first.
    """
    disabled = int(model.opt.disableflags)
    if disabled & (int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)):
        return np.empty((0, 2), np.int64)
    first, second = np.triu_indices(model.ngeom, 1)
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


def build_geometry(model: mujoco.MjModel, joints: Sequence[int], qpos: Array, held: dict[int, int] | None = None) -> Geometry:
    """Packs the geoms that an arm could touch, or touch something with.

    Args:
        model: The model.
        joints: The hinges and slides that move, in the order of the joint positions; all others stay where qpos has them.
        qpos: (nq,) the reference configuration.
        held: Bodies that are carried, and the body that carries each.

    Returns:
        The geometry, with every pair that MuJoCo tests and that the arm's motion can change. Geoms that are not convex are left
        out.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    frames = _frames(model, data, joints, held or {})
    pairs = _moving_pairs(model, frames)
    geom_ids = np.unique(pairs)
    rows = np.zeros((len(geom_ids), kernel.GEOM_COLUMNS))
    points: list[Array] = []
    neighbors: list[int] = []
    for row, geom in zip(rows, geom_ids, strict=True):
        first = len(points)
        shape = _shape(model, data, int(geom))
        _write_geom(row, shape, int(frames.of_body[model.geom_bodyid[geom]]), first)
        for i, point in enumerate(shape.points):
            begin = len(neighbors)
            neighbors += [first + k for k in shape.neighbors[i]] if shape.neighbors else []
            points.append(np.array([*point, begin, len(neighbors)]))
    index = {int(geom): i for i, geom in enumerate(geom_ids)}
    by_row = np.array([[index[int(a)], index[int(b)]] for a, b in pairs], np.int64).reshape(-1, 2)
    packed_points = np.array(points).reshape(-1, 5)
    return _packed(geom_ids, rows, packed_points, np.array([*neighbors, 0], np.int64), frames.tree, by_row)


def _frames(model: mujoco.MjModel, data: mujoco.MjData, order: Sequence[int], held: dict[int, int]) -> Frames:
    """One frame for each joint that moves. A body belongs to the last one above it, a carried body to its carrier's."""
    joints = sorted(order)  # MuJoCo numbers parents before children
    reference = data.qpos[model.jnt_qposadr[joints]]
    tree = np.zeros((len(joints), kernel.TREE_COLUMNS))
    of_body = np.zeros(model.nbody, np.int64)
    for body in range(1, model.nbody):
        of_body[body] = of_body[int(model.body_parentid[body])]
        for i, joint in enumerate(joints):
            if model.jnt_bodyid[joint] != body:
                continue
            parent = int(of_body[body])
            row = tree[i]
            row[kernel.AXIS : kernel.AXIS + 3] = data.xaxis[joint]
            row[kernel.ANCHOR : kernel.ANCHOR + 3] = data.xanchor[joint]
            is_slide = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE)
            row[kernel.KIND] = kernel.SLIDE if is_slide else kernel.HINGE
            row[kernel.REFERENCE] = reference[i]
            row[kernel.PARENT] = parent
            row[kernel.JOINT] = order.index(joint)
            row[kernel.DEPTH] = 1 + (tree[parent - 1, kernel.DEPTH] if parent else 0)
            of_body[body] = i + 1
    for body in range(1, model.nbody):
        for carried, carrier in held.items():
            if is_below(model, body, carried):
                of_body[body] = of_body[carrier]
    return Frames(tree, of_body)


def _moving_pairs(model: mujoco.MjModel, frames: Frames) -> IntArray:
    """The convex pairs that the motion of the arm can change; planes first, then the geom that is nearer to the base."""
    pairs = colliding_pairs(model)
    frame = frames.of_body[model.geom_bodyid]
    convex = np.array([is_convex(model, geom) for geom in range(model.ngeom)], bool)
    pairs = pairs[(frame[pairs[:, 0]] != frame[pairs[:, 1]]) & convex[pairs].all(axis=1)]
    depth = np.concatenate([[0], frames.tree[:, kernel.DEPTH]])
    rank = 2 * depth[frame] - (model.geom_type == _PLANE)
    swap = rank[pairs[:, 0]] > rank[pairs[:, 1]]
    pairs[swap] = pairs[swap][:, ::-1]
    return pairs


def _write_geom(row: Array, shape: Shape, frame: int, first: int) -> None:
    row[kernel.CENTER : kernel.CENTER + 3] = shape.center
    row[kernel.BOUND] = shape.bound * _ROUNDING
    row[kernel.RADIUS] = shape.radius
    row[kernel.SHAPE] = shape.kind
    row[kernel.FRAME] = frame
    row[kernel.FIRST] = first
    row[kernel.LAST] = first + len(shape.points)
    row[kernel.INFO : kernel.INFO + 16] = shape.info
    if shape.box is not None:
        row[kernel.IS_BOX] = 1.0
        row[kernel.BOX : kernel.BOX + 15] = shape.box


def _shape(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Shape:
    """The shape of a geom in the world, where `data` has it."""
    position = data.geom_xpos[geom].copy()
    R = data.geom_xmat[geom].reshape(3, 3).copy()
    size = model.geom_size[geom]
    kind = int(model.geom_type[geom])
    info = np.zeros(16)
    if kind == _PLANE:
        info[:3] = R[:, 2]
        info[3] = R[:, 2] @ position
        return Shape(kernel.PLANE, position[None], 0.0, info, None, position, np.inf, ())
    if kind == _ELLIPSOID:
        info[:9] = (R * size).ravel()
        return Shape(kernel.ELLIPSOID, position[None], 0.0, info, None, position, float(size.max()), ())
    if kind == _CYLINDER:
        info[:3] = R[:, 2]
        info[3:5] = size[:2]
        return Shape(kernel.CYLINDER, position[None], 0.0, info, None, position, float(np.hypot(size[0], size[1])), ())
    if kind == _SPHERE:
        return Shape(kernel.POINTS, position[None], float(size[0]), info, None, position, float(size[0]), ())
    if kind == _CAPSULE:
        axis = R[:, 2] * size[1]
        points = np.array([position - axis, position + axis])
        return Shape(kernel.POINTS, points, float(size[0]), info, None, position, float(size[0] + size[1]), ())
    if kind == _BOX:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        points = position + (signs * size) @ R.T
        box = np.concatenate([position, R.T.ravel(), size])
        return Shape(kernel.POINTS, points, 0.0, info, box, position, float(np.linalg.norm(size)), ())
    vertices, neighbors = _hull(model, int(model.geom_dataid[geom]))
    points = position + vertices @ R.T
    center, bound = _bounding_sphere(points)
    return Shape(kernel.POINTS, points, 0.0, info, None, center, bound, neighbors)


def _hull(model: mujoco.MjModel, mesh: int) -> tuple[Array, Sequence[Sequence[int]]]:
    """The vertices of a mesh's convex hull, (V, 3), and the neighbors of each, by MuJoCo's own hull graph.

    The graph is: numbers of vertices and faces, where the edges of each vertex start, the vertices' numbers, and the edges,
    each list ended by -1 (MuJoCo's `mesh_graph`).
    """
    address = int(model.mesh_vertadr[mesh])
    vertices = model.mesh_vert[address : address + model.mesh_vertnum[mesh]].astype(np.float64)
    graph_address = int(model.mesh_graphadr[mesh])
    if graph_address < 0:  # a mesh of four vertices at most is its own hull
        return vertices, ()
    graph = model.mesh_graph[graph_address:]
    count = int(graph[0])
    starts = graph[2 : 2 + count]
    numbers = graph[2 + count : 2 + 2 * count]
    edges = graph[2 + 2 * count :]
    if count <= kernel.LARGE_HULL:
        return vertices[numbers], ()
    neighbors = []
    for start in starts:
        stop = start
        while edges[stop] >= 0:
            stop += 1
        neighbors.append([int(edge) for edge in edges[start:stop]])
    return vertices[numbers], neighbors


def _bounding_sphere(points: Array, radii: Array | float = 0.0) -> tuple[Array, float]:
    """A small sphere around spheres: M. Badoiu, K. L. Clarkson, "Smaller core-sets for balls", SODA 2003."""
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    for step in range(_SPHERE_STEPS):
        farthest = int(np.argmax(np.linalg.norm(points - center, axis=1) + radii))
        center = center + (points[farthest] - center) / (step + 2)
    return center, float(np.max(np.linalg.norm(points - center, axis=1) + radii))


def _packed(geom_ids: IntArray, geoms: Array, points: Array, neighbors: IntArray, tree: Array, pairs: IntArray) -> Geometry:
    """Adds the groups: all geoms of a moving frame together, each thing that stands alone."""
    count = len(geoms)
    frame = geoms[:, kernel.FRAME].astype(np.int64)
    group = np.arange(count)
    rows = [*geoms]
    for moving in np.unique(frame[frame > 0]):
        members = np.flatnonzero(frame == moving)
        row = np.zeros(kernel.GEOM_COLUMNS)
        center, bound = _bounding_sphere(geoms[members, :3], geoms[members, kernel.BOUND])
        row[kernel.CENTER : kernel.CENTER + 3] = center
        row[kernel.BOUND] = bound * _ROUNDING
        row[kernel.FRAME] = moving
        group[members] = len(rows)
        rows.append(row)
    key = group[pairs[:, 0]] * len(rows) + group[pairs[:, 1]]
    order = np.argsort(key, kind="stable")
    pairs = pairs[order]
    key = key[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    stops = np.append(starts[1:], len(key))[: len(starts)]
    groups = np.column_stack([key[starts] // len(rows), key[starts] % len(rows), starts, stops]).astype(np.int64)
    packed_pairs = np.zeros((len(pairs), kernel.PAIR_COLUMNS))
    packed_pairs[:, [kernel.A, kernel.B]] = pairs
    packed_pairs[:, [kernel.VERTEX_A, kernel.VERTEX_B]] = -1.0
    for row, (a, b) in zip(packed_pairs, pairs, strict=True):
        common = _common_frame(tree, int(frame[a]), int(frame[b]))
        row[kernel.COMMON] = common
        row[kernel.COMMON_DEPTH] = tree[common - 1, kernel.DEPTH] if common else 0.0
    return Geometry(
        geom_ids=frozen(geom_ids),
        geoms=frozen(np.array(rows).reshape(-1, kernel.GEOM_COLUMNS)),
        points=frozen(points),
        neighbors=frozen(neighbors),
        pairs=frozen(packed_pairs),
        groups=frozen(groups),
        tree=frozen(tree),
        depth=1 + int(tree[:, kernel.DEPTH].max(initial=0.0)),
    )


def frames_above(tree: Array, frame: int) -> list[int]:
    """A frame and those above it, up to the world, 0.

    Args:
        tree: (F, 11).
        frame: The frame.

    Returns:
        Frames, from the given one to the world.
    """
    path = [frame]
    while path[-1] > 0:
        path.append(int(tree[path[-1] - 1, kernel.PARENT]))
    return path


def _common_frame(tree: Array, a: int, b: int) -> int:
    above = frames_above(tree, a)
    return next(frame for frame in frames_above(tree, b) if frame in above)
