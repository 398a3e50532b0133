"""Camera: a view that shows the whole arm and what it is after, without being told where they are."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.robot.arm import Arm

_MARGIN = 1.08  # how much wider than what it shows
_TURNS = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])  # from the model's own azimuth
_SEEN = 24  # points of the way that are looked for
_SIDE_ON = 0.5  # what seeing the way's whole length is worth, against seeing all of it


def frame(arm: Arm, poses: Sequence[mujoco.MjData], way: Array, aspect: float) -> mujoco.MjvCamera:
    """A camera that shows an arm in several states and the way of its tip: the least hidden, the most from the side.

    Args:
        arm: The arm.
        poses: Its states, after forward kinematics.
        way: (k, 3) m, where the tip goes; the last is the target.
        aspect: Width over height.

    Returns:
        A free camera.
    """
    model, corners = arm.model, np.concatenate([*(box_corners(arm, data) for data in poses), way])
    azimuth, elevation = np.radians([model.vis.global_.azimuth, model.vis.global_.elevation])
    views = [_fit(model, corners, azimuth + turn, elevation, aspect) for turn in _TURNS]
    return views[int(np.argmax([_worth(model, poses, way, view) for view in views]))]


def box_corners(arm: Arm, data: mujoco.MjData) -> Array:
    """The corners of the boxes around all that is drawn of a robot.

    Args:
        arm: The arm.
        data: Its state, after forward kinematics.

    Returns:
        (8 k, 3) m, in the world.
    """
    model = arm.model
    geoms = _geoms(arm)
    center, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    local = center[:, None] + signs * half[:, None]
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    return (data.geom_xpos[geoms][:, None] + np.einsum("gij,gkj->gki", rotation, local)).reshape(-1, 3)


def _geoms(arm: Arm) -> IntArray:
    """The robot's geoms that are drawn: those of every body under the one that the arm stands on."""
    model = arm.model
    root = model.body_rootid[model.jnt_bodyid[model.dof_jntid[arm.dof_adr[0]]]]
    drawn = (model.geom_group < 3) & (model.geom_rgba[:, 3] > 0) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    return np.flatnonzero(drawn & (model.body_rootid[model.geom_bodyid] == root))


def _fit(model: mujoco.MjModel, points: Array, azimuth: float, elevation: float, aspect: float) -> mujoco.MjvCamera:
    """The nearest camera in a direction that has all points in its picture."""
    forward, right, up = axes(azimuth, elevation)
    depth, x, y = points @ forward, points @ right, points @ up
    tan_y = np.tan(np.radians(model.vis.global_.fovy) / 2) / _MARGIN
    # A point at depth d from the eye is in the picture where |x - x_eye| <= tan d: four half-planes, two for each direction.
    x_eye, back_x = _between(x, depth, aspect * tan_y)
    y_eye, back_y = _between(y, depth, tan_y)
    back = min(back_x, back_y)
    middle = 0.5 * (depth.min() + depth.max())
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = x_eye * right + y_eye * up + middle * forward
    camera.distance = middle - back
    camera.azimuth, camera.elevation = np.degrees([azimuth, elevation])
    return camera


def _between(x: Array, depth: Array, tan: float) -> tuple[float, float]:
    """Where across and how far back the eye is so that the outermost points on both sides touch the edges of the picture."""
    low, high = (x - tan * depth).max(), (x + tan * depth).min()
    return 0.5 * (low + high), (high - low) / (2 * tan)


def axes(azimuth: float, elevation: float) -> tuple[Array, Array, Array]:
    """The directions of a MuJoCo free camera.

    Args:
        azimuth: rad.
        elevation: rad, negative from above.

    Returns:
        Forward, right and up, each (3,), in the world.
    """
    (ca, sa), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in (azimuth, elevation))
    return np.array([ce * ca, ce * sa, se]), np.array([sa, -ca, 0.0]), np.array([-se * ca, -se * sa, ce])


def _eye(camera: mujoco.MjvCamera) -> Array:
    return camera.lookat - camera.distance * axes(*np.radians([camera.azimuth, camera.elevation]))[0]


def _worth(model: mujoco.MjModel, poses: Sequence[mujoco.MjData], way: Array, view: mujoco.MjvCamera) -> float:
    """How well a view shows a way: the share of its points that is seen, and of its length that is seen from the side."""
    eye, forward = _eye(view), axes(*np.radians([view.azimuth, view.elevation]))[0]
    points = way[np.linspace(0, len(way) - 1, _SEEN).astype(int)]
    seen = [not _is_hidden(model, poses[-1], eye, point) for point in points]
    seen += [not _is_hidden(model, data, eye, way[-1]) for data in poses]
    steps = np.diff(points, axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    across = float(np.linalg.norm(steps - np.outer(steps @ forward, forward), axis=1).sum())
    return float(np.mean(seen)) + _SIDE_ON * across / max(length, 1e-6)


def _is_hidden(model: mujoco.MjModel, data: mujoco.MjData, eye: Array, point: Array) -> bool:
    """Whether anything stands between an eye and a point, short of 5 cm before it."""
    way, groups = point - eye, np.array([1, 1, 1, 0, 0, 0], np.uint8)
    distance, geom = float(np.linalg.norm(way)), np.zeros(1, np.int32)
    hit = mujoco.mj_ray(model, data, eye, way / distance, groups, 1, -1, geom)
    return 0 <= hit < distance - 0.05
