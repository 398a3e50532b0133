"""Bodies that can be handled: loose bodies of an arm's model, and bodies of the world around it."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.shapes import Ball, Box, Cylinder, Mesh, Points, Shape
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.world import checked_name
from armctl.model.collision.world_snapshot import WorldBody, WorldSnapshot
from armctl.model.mjmodel.queries import body_name, is_below, is_loose, object_id, robot_roots
from armctl.model.mjmodel.shape_geoms import mass_distribution
from armctl.plan.grasp.handling_scene import HandledBody
from armctl.plan.grasp.holds import BodyPart, half_sphere

_ROUND_DIRECTIONS = 100  # points of half a capsule or an ellipsoid, whose hull is taken
_IDENTITY = Pose([0.0, 0.0, 0.0])


def find_body(arm: Arm, data: mujoco.MjData, snapshot: WorldSnapshot | None, name: str, T_world_tip: Pose) -> HandledBody:
    """A body that can be handled, where it is now, also if a tip carries it.

    UnknownNameError if there is none; InputError if it is fixed, a part of the robot, or a cloud of points.
    """
    bodies = {} if snapshot is None else snapshot.bodies
    if checked_name(name, "body") in bodies and bodies[name].shape is not None:
        return _of_world(bodies[name], T_world_tip)
    model = arm.model
    number = object_id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if number < 1:
        loose = [body_name(model, body) for body in range(1, model.nbody) if is_loose(model, body)]
        raise UnknownNameError.from_known("body to handle", name, [*loose, *bodies])
    if any(is_below(model, number, root) for root in robot_roots(model, arm.joint_map.joints)):
        raise InputError(f"body: {name:.60} is a part of the robot; only a loose body can be picked")
    if not is_loose(model, number):
        if model.body_weldid[number]:
            raise InputError(
                f"body: {name:.60} moves on a joint of the scene, and only a loose body can be picked; gripper.grasp holds it"
            )
        raise InputError(
            f"body: {name:.60} is fixed in the scene; give it a mass in armctl.World.add, or a free joint in its file"
        )
    return _of_model(model, data, int(model.body_rootid[number]))


def _of_world(body: WorldBody, T_world_tip: Pose) -> HandledBody:
    assert body.shape is not None
    if isinstance(body.shape, Points):
        raise InputError(f"body: {body.name:.60} is a cloud of points, which has no sides to hold; add an armctl.Mesh of them")
    solid = mass_distribution(body.shape, 1.0 if body.mass is None else body.mass)
    return HandledBody(
        name=body.name,
        parts=(BodyPart(body.shape, _IDENTITY),),
        pose=body.pose if body.tip is None else T_world_tip @ body.pose,
        number=0,
        members=frozenset([body.name]),
        mass=body.mass,
        center=solid.center,
        inertia=solid.inertia,
    )


def _of_model(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> HandledBody:
    """A loose body of a model, with all that hangs on it."""
    name = body_name(model, root)
    members = [body for body in range(1, model.nbody) if is_below(model, body, root)]
    own = data.xmat[root].reshape(3, 3)
    place = Pose.from_rotation(data.xpos[root], own)
    parts = []
    for geom in np.flatnonzero(np.isin(model.geom_bodyid, members)).tolist():
        shape = geom_shape(model, geom)
        if shape is not None and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            T_world_geom = Pose.from_rotation(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3))
            parts.append(BodyPart(shape, place.inverse() @ T_world_geom))
    if not parts:
        raise InputError(f"body: {name:.60} has no collision shape that a gripper could hold")
    mass = float(model.body_mass[members].sum())
    center = np.array(own.T @ (data.subtree_com[root] - data.xpos[root]))
    return HandledBody(
        name=name,
        parts=tuple(parts),
        pose=place,
        number=root,
        members=frozenset(body_name(model, body) for body in members),
        mass=mass if mass > 0.0 else None,
        center=center,
        inertia=_inertia(model, data, members, root, center),
    )


def geom_shape(model: mujoco.MjModel, geom: int) -> Shape | None:
    """A geom as a shape, in the frame of the geom; what is round otherwise as a hull, None for planes and height fields."""
    kind = int(model.geom_type[geom])
    size = np.array(model.geom_size[geom], np.float64)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return Box(2.0 * size)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return Ball(float(size[0]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return Cylinder(float(size[0]), 2.0 * float(size[1]))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        return Mesh(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64))
    half = half_sphere(_ROUND_DIRECTIONS)
    sphere = np.concatenate([half, -half])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return Mesh(sphere * size)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return Mesh(size[0] * sphere + np.sign(sphere[:, 2:]) * [0.0, 0.0, size[1]])
    return None


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, members: list[int], root: int, center: Array) -> Array:
    """(3, 3) kg m^2 of bodies together, about a point (3,) and in the axes of the root's frame."""
    own = data.xmat[root].reshape(3, 3)
    total = np.zeros((3, 3))
    for body in members:
        axes = own.T @ data.ximat[body].reshape(3, 3)
        offset = own.T @ (data.xipos[body] - data.xpos[root]) - center
        total += axes @ np.diag(model.body_inertia[body]) @ axes.T
        total += float(model.body_mass[body]) * (offset @ offset * np.eye(3) - np.outer(offset, offset))  # parallel axes
    return total
