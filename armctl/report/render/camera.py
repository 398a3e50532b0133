"""A camera that shows the whole arm, its target, and the path between them."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.report.render.stick_figure import StickFigure, drawn_geoms, has_shapes

_MARGIN = 1.08  # width of the picture over width of its contents
_NOTHING_M = np.empty((0, 3))
_TURNS_RAD = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])  # from the model's own azimuth
_PATH_POINTS = 24  # that are tested for visibility
_SIDE_VIEW_WEIGHT = 0.5  # of seeing the path's full length, against seeing all of its points
_HIDING_DISTANCE_M = 0.05  # what is nearer to a point than this does not hide it


class Axes(NamedTuple):
    """The directions of a camera, each (3,) in world axes."""

    forward: Array
    right: Array
    up: Array


def fitted_camera(
    arm: Arm, states: Sequence[mujoco.MjData], path: Array, aspect: float, also: Array = _NOTHING_M
) -> mujoco.MjvCamera:
    """A free camera that shows an arm in several states, the path of its tip, and further points (k, 3) m.

    Of twelve azimuths it takes the one with the fewest hidden points and the most of the path seen from the side.
    """
    model = arm.model
    corners = np.concatenate([*(box_corners(arm, data) for data in states), path, also])
    azimuth = np.radians(model.vis.global_.azimuth)
    elevation = np.radians(model.vis.global_.elevation)
    cameras = [fitted_view(model, corners, azimuth + turn, elevation, aspect) for turn in _TURNS_RAD]
    return cameras[int(np.argmax([_visibility(model, states, path, camera) for camera in cameras]))]


def box_corners(arm: Arm, data: mujoco.MjData) -> Array:
    """(k, 3) m, the corners of the bounding boxes of the visible geoms of a robot, after forward kinematics.

    Of a robot without shapes, these are the ends of its stick figure.
    """
    if not has_shapes(arm):
        return StickFigure(arm).segments(data).reshape(-1, 3)
    model = arm.model
    root = model.body_rootid[model.jnt_bodyid[model.dof_jntid[arm.dof_adr[0]]]]
    drawn = drawn_geoms(model) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    geoms = np.flatnonzero(drawn & (model.body_rootid[model.geom_bodyid] == root))
    center = model.geom_aabb[geoms, :3]
    half = model.geom_aabb[geoms, 3:]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    local = center[:, None] + signs * half[:, None]
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    return (data.geom_xpos[geoms][:, None] + np.einsum("gij,gkj->gki", rotation, local)).reshape(-1, 3)


def fitted_view(model: mujoco.MjModel, points: Array, azimuth: float, elevation: float, aspect: float) -> mujoco.MjvCamera:
    """The nearest camera with a direction that has all points in its picture."""
    forward, right, up = axes(azimuth, elevation)
    depth = points @ forward
    tan_y = np.tan(np.radians(model.vis.global_.fovy) / 2) / _MARGIN
    # A point at depth d from the eye is in the picture if |x - x_eye| <= tan d: four half-planes, two for each direction.
    x_eye, back_x = _between(points @ right, depth, aspect * tan_y)
    y_eye, back_y = _between(points @ up, depth, tan_y)
    back = min(back_x, back_y)
    middle = 0.5 * (depth.min() + depth.max())
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = x_eye * right + y_eye * up + middle * forward
    camera.distance = middle - back
    camera.azimuth = np.degrees(azimuth)
    camera.elevation = np.degrees(elevation)
    return camera


def _between(x: Array, depth: Array, tan: float) -> tuple[float, float]:
    """Position of the eye across and along the view, at which the outermost points touch both edges of the picture."""
    low = (x - tan * depth).max()
    high = (x + tan * depth).min()
    return 0.5 * (low + high), (high - low) / (2 * tan)


def axes(azimuth: float, elevation: float) -> Axes:
    """The directions of a MuJoCo free camera; azimuth and elevation in rad, the elevation negative from above."""
    ca = np.cos(azimuth)
    sa = np.sin(azimuth)
    ce = np.cos(elevation)
    se = np.sin(elevation)
    return Axes(np.array([ce * ca, ce * sa, se]), np.array([sa, -ca, 0.0]), np.array([-se * ca, -se * sa, ce]))


def _visibility(model: mujoco.MjModel, states: Sequence[mujoco.MjData], path: Array, camera: mujoco.MjvCamera) -> float:
    """How well a camera shows a path: the fraction of visible points, and the fraction of its length seen from the side."""
    forward = axes(np.radians(camera.azimuth), np.radians(camera.elevation)).forward
    eye = camera.lookat - camera.distance * forward
    points = path[np.linspace(0, len(path) - 1, _PATH_POINTS).astype(int)]
    visible = [not _is_hidden(model, states[-1], eye, point) for point in points]
    visible += [not _is_hidden(model, data, eye, path[-1]) for data in states]
    steps = np.diff(points, axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    across = float(np.linalg.norm(steps - np.outer(steps @ forward, forward), axis=1).sum())
    return float(np.mean(visible)) + _SIDE_VIEW_WEIGHT * across / max(length, 1e-6)


def _is_hidden(model: mujoco.MjModel, data: mujoco.MjData, eye: Array, point: Array) -> bool:
    """Whether a geom is between the eye and a point."""
    ray = point - eye
    distance = float(np.linalg.norm(ray))
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    geom = np.zeros(1, np.int32)
    hit = mujoco.mj_ray(model, data, eye, ray / distance, groups, 1, -1, geom)
    return 0 <= hit < distance - _HIDING_DISTANCE_M
