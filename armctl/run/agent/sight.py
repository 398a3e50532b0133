"""What an agent sees of a scene: bodies with their poses, points of a camera, and pictures."""

from __future__ import annotations

import io
from typing import Any

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.shapes import Ball, Box, Cylinder, Mesh, Shape
from armctl.core.validation import Array
from armctl.model.collision.robot_filter import robot_filter
from armctl.model.mjmodel.queries import is_below, is_loose, object_id, robot_roots
from armctl.model.mjmodel.target_marker import TARGET
from armctl.report.render.camera import fitted_camera
from armctl.report.render.renderer import Image, Renderer
from armctl.run.agent.answer import pose_values, rounded
from armctl.run.execution.commands import Commands
from armctl.run.sim.simulation import Simulation

_MAX_BODIES = 50
_MAX_POINTS = 200
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def bodies(robot: Commands) -> dict[str, Any]:
    """The bodies around an arm, the nearest to its tip first, and what is seen besides."""
    model = robot.model
    data = robot.data
    mujoco.mj_kinematics(model, data)
    tip = robot.tip.position
    found = sorted(_around(robot), key=lambda body: float(np.linalg.norm(data.xpos[body] - tip)))
    seen = []
    for name in robot.world.names:
        body = robot.world[name]
        carried = {} if body.tip is None else {"carried_by": body.tip or robot.arm.tip}
        seen.append({"name": name, "shape": _shape_text(body.shape), **pose_values(body.pose), **carried})
    return {
        "bodies": [_body_values(model, data, body) for body in found[:_MAX_BODIES]],
        "bodies_left_out": max(0, len(found) - _MAX_BODIES),
        "fixed_geoms": _fixed_geoms(model)[:_MAX_BODIES],
        "seen_besides": seen[:_MAX_BODIES],
        "cameras": [model.camera(i).name for i in range(model.ncam)],
    }


def points(robot: Commands, camera: str) -> dict[str, Any]:
    """The points that a camera of a simulation sees and that are not on the robot; some of them, evenly chosen."""
    cloud = _simulation(robot).camera(camera).points
    if len(cloud):
        cloud = robot_filter(robot.arm, robot.arm.limits.clamp(robot.state.q), cloud)
    some = cloud[np.linspace(0, len(cloud) - 1, min(_MAX_POINTS, len(cloud))).astype(int)]
    box = {} if not len(cloud) else {"low": rounded(cloud.min(axis=0)), "high": rounded(cloud.max(axis=0))}
    return {"camera": camera, "count": len(cloud), **box, "points": [rounded(point) for point in some]}


class Eye:
    """Draws the scene of an arm, from a camera of the model or from where the arm is seen best."""

    def __init__(self, robot: Commands):
        self._robot = robot
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def picture(self, camera: str | None, size: tuple[int, int]) -> bytes:
        """A PNG."""
        if camera is None:
            return _png(self._whole(size))
        return _png(_simulation(self._robot).camera(camera, size).colour)

    def _whole(self, size: tuple[int, int]) -> Image:
        robot = self._robot
        data = robot.data
        mujoco.mj_kinematics(robot.model, data)
        mujoco.mj_comPos(robot.model, data)
        mujoco.mj_camlight(robot.model, data)
        loose = [body for body in _around(robot) if is_loose(robot.model, body)]
        also = np.concatenate([robot.tip.position[None], data.xpos[loose]])
        view = fitted_camera(robot.arm, [data], robot.tip.position[None], size[0] / size[1], also)
        if size not in self._renderers:
            self._renderers[size] = Renderer(robot.model, size)
        return self._renderers[size].image(data, view)


def _simulation(robot: Commands) -> Simulation:
    if not isinstance(robot, Simulation):
        raise InputError("camera: the cameras of the model are simulated, and a robot has none of them; leave it out")
    return robot


def _around(robot: Commands) -> list[int]:
    """The bodies that are not the robot, and have a shape."""
    model = robot.model
    roots = robot_roots(model, robot.arm.joint_map.joints)
    with_shape = sorted({int(body) for body in model.geom_bodyid if body})
    marker = object_id(model, mujoco.mjtObj.mjOBJ_BODY, TARGET)
    return [body for body in with_shape if body != marker and not any(is_below(model, body, root) for root in roots)]


def _body_values(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> dict[str, Any]:
    low, high = _extent(model, body)
    kind = "loose" if is_loose(model, body) else "fixed" if model.body_weldid[body] == 0 else "moving"
    return {
        "name": model.body(body).name,
        "kind": kind,
        "position": rounded(data.xpos[body]),
        "quat": rounded(data.xquat[body]),
        "box_low": rounded(low),
        "box_high": rounded(high),
    }


def _extent(model: mujoco.MjModel, body: int) -> tuple[Array, Array]:
    """The corners, (3,) m each, of the box around a body's geoms in the body's frame."""
    geoms = np.flatnonzero(model.geom_bodyid == body)
    rotation = np.zeros((len(geoms), 9))
    for row, geom in zip(rotation, geoms, strict=True):
        mujoco.mju_quat2Mat(row, model.geom_quat[geom])
    local = model.geom_aabb[geoms, :3][:, None] + _CORNERS * model.geom_aabb[geoms, 3:][:, None]
    corners = model.geom_pos[geoms][:, None] + np.einsum("gij,gkj->gki", rotation.reshape(-1, 3, 3), local)
    return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


def _fixed_geoms(model: mujoco.MjModel) -> list[dict[str, Any]]:
    """The named shapes of the world itself, such as a floor."""
    found = []
    for geom in np.flatnonzero(model.geom_bodyid == 0).tolist():
        if model.geom(geom).name:
            kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
            place = {"position": rounded(model.geom_pos[geom]), "quat": rounded(model.geom_quat[geom])}
            found.append({"name": model.geom(geom).name, "shape": kind, "size": rounded(model.geom_size[geom]), **place})
    return found


def _shape_text(shape: Shape | None) -> str:
    if isinstance(shape, Box):
        return f"box of {' x '.join(f'{edge:.3g}' for edge in shape.size)} m"
    if isinstance(shape, Ball):
        return f"ball of radius {shape.radius:.3g} m"
    if isinstance(shape, Cylinder):
        return f"cylinder of radius {shape.radius:.3g} m and length {shape.length:.3g} m"
    if isinstance(shape, Mesh):
        return f"mesh of {len(shape.vertices)} vertices"
    return "body of the model" if shape is None else f"{len(shape.points)} points of radius {shape.radius:.3g} m"


def _png(image: Image) -> bytes:
    from PIL import Image as Picture

    stream = io.BytesIO()
    Picture.fromarray(image).save(stream, format="PNG")
    return stream.getvalue()
