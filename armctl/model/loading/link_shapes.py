"""Links without a collision shape: what touches them is not seen, so no contact of the arm can be excluded.

A *link* is what a joint moves: a body and those welded to it. It needs a shape if it carries more than 1 g. It needs none if
its mass lies within the shapes of its neighbors: then its ellipsoid of gyration, whose half axes are the standard deviations of
the mass (Goldstein, Classical Mechanics, 5.3: radii of gyration), is inside them at every one of some configurations. No body
of that mass and inertia is smaller than that ellipsoid. A part that is welded to a link with shapes needs one of its own only
if its center of mass is outside all of them.
"""

from collections.abc import Collection, Iterator

import mujoco
import numpy as np

from armctl.core.validation import Array, BoolArray
from armctl.model.loading.home import home_qpos
from armctl.model.loading.inertias import MIN_MASS_KG
from armctl.model.loading.neighbor_contacts import RANDOM_CONFIGURATIONS
from armctl.model.mjmodel.queries import Joints, body_name, colliding_geoms, joint_range, object_id, robot_roots

_ROUNDING_M = 1e-6  # masses of a body that fills its shape exactly count as inside
# The faces and corners of a cube, projected on the sphere.
_GRID = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)], float)
_DIRECTIONS = _GRID / np.linalg.norm(_GRID, axis=1, keepdims=True)


def unchecked_links(model: mujoco.MjModel, joints: Joints, unread: Collection[str] = ()) -> tuple[int, ...]:
    """The bodies of a robot without a collision shape that they need.

    `joints` are the arm's; `unread` are names of bodies whose shapes are in the file and could not be read.
    """
    missing = {body for name in unread if (body := object_id(model, mujoco.mjtObj.mjOBJ_BODY, name)) > 0}
    links = _moving_links(model, joints)
    collides = colliding_geoms(model)
    shaped = set(model.geom_bodyid[collides].tolist())
    if not any(shaped & set(parts) for parts in links.values()):
        return tuple(sorted(missing | set(links)))
    bare = [body for body in _bodies_without_shape(model, links, shaped) if body not in missing]
    if bare:
        missing |= _outside_of_neighbors(model, joints, links, collides, bare)
    return tuple(sorted(missing))


def fixed_without_shape(model: mujoco.MjModel, joints: Joints) -> tuple[int, ...]:
    """The fixed bodies of a robot that carry mass and have no collision shape, such as its base."""
    shaped = set(model.geom_bodyid[colliding_geoms(model)].tolist())
    roots = robot_roots(model, joints)
    return tuple(
        body
        for body in range(1, model.nbody)
        if model.body_rootid[body] in roots
        and not model.body_weldid[body]
        and model.body_mass[body] > MIN_MASS_KG
        and body not in shaped
    )


def _moving_links(model: mujoco.MjModel, joints: Joints) -> dict[int, list[int]]:
    """The links of the robot of some joints: the first body of each, and all that are rigidly joined to it."""
    roots = robot_roots(model, joints)
    links: dict[int, list[int]] = {}
    for body in range(1, model.nbody):
        first = int(model.body_weldid[body])
        if first and int(model.body_rootid[body]) in roots:
            links.setdefault(first, []).append(body)
    return links


def _bodies_without_shape(model: mujoco.MjModel, links: dict[int, list[int]], shaped: set[int]) -> Iterator[int]:
    """The bodies of links that carry mass and have no shape."""
    for parts in links.values():
        yield from (body for body in parts if body not in shaped and model.body_mass[body] > MIN_MASS_KG)


def _outside_of_neighbors(
    model: mujoco.MjModel, joints: Joints, links: dict[int, list[int]], collides: BoolArray, bodies: list[int]
) -> set[int]:
    """Which bodies have mass outside the shapes of their own link and of its neighbors, at home or elsewhere."""
    link_of_geom = model.body_weldid[model.geom_bodyid]
    is_in_world = model.geom_bodyid == 0
    around = {}
    for body in bodies:
        own = int(model.body_weldid[body])
        above = int(model.body_weldid[model.body_parentid[own]])
        below = [link for link in links if int(model.body_weldid[model.body_parentid[link]]) == own]
        has_shape = bool(collides[link_of_geom == own].any())
        points = np.zeros((1, 3)) if has_shape else _DIRECTIONS * _gyration(model, body)
        near = np.flatnonzero(collides & ~is_in_world & np.isin(link_of_geom, [own, above, *below]))
        around[body] = (points, near.tolist())
    outside: set[int] = set()
    data = mujoco.MjData(model)
    home = home_qpos(model, joints)
    rng = np.random.default_rng(0)
    scalar = [j for j in range(model.njnt) if model.body_weldid[model.jnt_bodyid[j]] in links and model.jnt_type[j] >= 2]
    for sample in range(RANDOM_CONFIGURATIONS + 1):
        data.qpos[:] = home
        for joint in scalar if sample else ():
            low, high = joint_range(model, joint)
            data.qpos[model.jnt_qposadr[joint]] = rng.uniform(max(low, -np.pi), min(high, np.pi))
        mujoco.mj_kinematics(model, data)
        for body, (points, near) in around.items():
            if body in outside:
                continue
            places = data.xipos[body] + points @ data.ximat[body].reshape(3, 3).T
            covered = np.zeros(len(places), bool)
            for geom in near:
                covered |= is_inside(model, geom, (places - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3))
            if not covered.all():
                outside.add(body)
    return outside


def _gyration(model: mujoco.MjModel, body: int) -> Array:
    """(3,) m, the standard deviations of a body's mass along its principal axes."""
    moments = model.body_inertia[body]
    return np.sqrt(np.maximum(0.5 * moments.sum() - moments, 0.0) / model.body_mass[body])


def is_inside(model: mujoco.MjModel, geom: int, points: Array) -> BoolArray:
    """(P,) which points (P, 3) m, in the frame of a geom, are inside its shape; of a mesh, inside its convex hull."""
    size = model.geom_size[geom] + _ROUNDING_M
    kind = int(model.geom_type[geom])
    radial = np.hypot(points[:, 0], points[:, 1])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.linalg.norm(points, axis=1) <= size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.hypot(radial, np.maximum(np.abs(points[:, 2]) - size[1], 0.0)) <= size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return (radial <= size[0]) & (np.abs(points[:, 2]) <= size[1])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return np.linalg.norm(points / size, axis=1) <= 1.0
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return (np.abs(points) <= size).all(axis=1)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _is_in_hull(model, int(model.geom_dataid[geom]), points)
    return np.zeros(len(points), bool)


def _is_in_hull(model: mujoco.MjModel, mesh: int, points: Array) -> BoolArray:
    """Whether points are behind all faces of a mesh's hull, which `mesh_graph` lists last: three vertices for each."""
    address = int(model.mesh_graphadr[mesh])
    if address < 0:  # a mesh of four vertices at most
        return np.zeros(len(points), bool)
    vertices, faces = model.mesh_graph[address : address + 2].tolist()
    end = address + 2 + 3 * vertices + 6 * faces
    corners = model.mesh_vert[int(model.mesh_vertadr[mesh]) + model.mesh_graph[end - 3 * faces : end].reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0.0] / lengths[lengths > 0.0, None]
    offsets = np.einsum("fi,fi->f", normals, corners[lengths > 0.0, 0])
    return (points @ normals.T <= offsets + _ROUNDING_M).all(axis=1)


def names_of(model: mujoco.MjModel, bodies: Collection[int]) -> tuple[str, ...]:
    return tuple(body_name(model, body) for body in bodies)
