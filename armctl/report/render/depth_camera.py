"""Cameras in a scene: colour, depth and points, as a depth camera gives them; and points from any depth picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.validation import Array, frozen, instance, number, shown
from armctl.model.mjmodel.queries import object_id
from armctl.report.render.renderer import Image, Renderer

_MIN_FOVY_RAD = 0.01
_MAX_FOVY_RAD = 3.0
# From MuJoCo's camera, which looks along -z with y up, to that of depth cameras and of ROS: z forward, y down.
_MUJOCO_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0])


def points_from_depth(
    depth: ArrayLike,
    *,
    fovy: float | None = None,
    intrinsics: ArrayLike | None = None,
    T_world_camera: Pose | None = None,
) -> Array:
    """The points of a depth picture, one for each pixel that has a depth.

    The camera is the pinhole of every driver: x to the right, y down, z forward; the depth is measured along z. For a pixel in
    row v and column u, x = (u - c_x) z / f_x and y = (v - c_y) z / f_y (Hartley and Zisserman, "Multiple View Geometry", 6.1).

    Args:
        depth: (height, width) m. Pixels that are 0, negative or not finite have no depth, and are left out.
        fovy: rad, the vertical angle of view, of square pixels whose optical axis is in the middle.
        intrinsics: (3, 3), the camera matrix in pixels, with f_x, f_y, c_x and c_y; pixel centers are whole numbers. Exactly
            one of both is given.
        T_world_camera: Where the camera is; left out, the points are those of the camera's frame.

    Returns:
        (N, 3) m, in the world.

    Raises:
        InputError: It is no picture of numbers, both or neither of fovy and intrinsics are given, or one is impossible.
    """
    picture = _read_depth(depth)
    height, width = picture.shape
    if (fovy is None) == (intrinsics is None):
        raise InputError("points_from_depth: give either fovy, rad, or intrinsics, (3, 3) pixels")
    if fovy is not None:
        angle = number("fovy", fovy, _MIN_FOVY_RAD, _MAX_FOVY_RAD)
        focal = 0.5 * height / np.tan(0.5 * angle)
        matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    else:
        matrix = _read_intrinsics(intrinsics)
    rows, columns = np.nonzero(np.isfinite(picture) & (picture > 0.0))
    z = picture[rows, columns]
    x = (columns - matrix[0, 2] - matrix[0, 1] * (rows - matrix[1, 2]) / matrix[1, 1]) * z / matrix[0, 0]
    y = (rows - matrix[1, 2]) * z / matrix[1, 1]
    points = np.stack([x, y, z], axis=1)
    if T_world_camera is None:
        return points
    instance("T_world_camera", T_world_camera, Pose, "Pose([0, 0, 1]) is one")
    return points @ T_world_camera.rotation.T + T_world_camera.position


@dataclass(frozen=True)
class Camera:
    """A camera that a model need not have: on a body, such as at the wrist, or in the world.

    Attributes:
        at: T_body_camera, or T_world_camera: z forward, y down.
        on: The body or site that carries it; empty for the world.
        fovy: rad, its vertical angle of view.
        name: What its pictures are called where there are several, as in environments.
    """

    at: Pose
    on: str = ""
    fovy: float = 1.0
    name: str = "camera"

    def __post_init__(self) -> None:
        instance("at", self.at, Pose, "Pose([0, 0, 1], rpy=[np.pi, 0, 0]) looks down")
        instance("on", self.on, str, "the name of a body")
        number("fovy", self.fovy, _MIN_FOVY_RAD, _MAX_FOVY_RAD)
        instance("name", self.name, str, "'wrist' is a name")
        if not self.name:
            raise InputError("name: it is empty; 'wrist' is a name")


def camera_names(cameras: object) -> dict[str, str | Camera]:
    """A caller's cameras by their names: each is that of a camera of the model, or a Camera with a name of its own."""
    if isinstance(cameras, (str, Camera)) or not isinstance(cameras, Sequence):
        raise InputError(f"cameras: expected a list of names and Cameras, got {shown(cameras)}")
    found: dict[str, str | Camera] = {}
    for camera in cameras:
        if not isinstance(camera, (str, Camera)):
            raise InputError(f"cameras: expected a list of names and Cameras, got {shown(camera)} in it")
        name = camera if isinstance(camera, str) else camera.name
        if name in found:
            raise InputError(f"cameras: two are called {name!r:.60}; give each Camera a name= of its own")
        found[name] = camera
    return found


@dataclass(frozen=True, eq=False)
class CameraImage:
    """What a camera sees.

    Attributes:
        colour: (height, width, 3), 0 to 255.
        depth: (height, width) m along the optical axis; infinite where nothing is seen.
        fovy: rad, the vertical angle of view.
        T_world_camera: Where the camera is: z forward, y down.
    """

    colour: Image
    depth: NDArray[np.float32]
    fovy: float
    T_world_camera: Pose

    @cached_property
    def points(self) -> Array:
        """(N, 3) m in the world, one for each pixel that sees something, in the order of the pixels."""
        return frozen(points_from_depth(self.depth, fovy=self.fovy, T_world_camera=self.T_world_camera))

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """(height, width) which pixels have a point."""
        return np.isfinite(self.depth)


class Eyes:
    """The cameras of one scene, with a renderer for each size of picture that was asked for."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def look(self, data: mujoco.MjData, camera: str | Camera, size: tuple[int, int]) -> CameraImage:
        """What a camera of the model, or one of its own, sees after forward kinematics.

        Raises:
            InputError: The size is out of bounds, or the camera's optical axis is not in the middle.
            UnknownNameError: The model has no such camera, or no body or site that carries it.
            NotInstalledError: OpenGL is missing.
        """
        pose, fovy = placed(self._model, data, camera)
        if size not in self._renderers:
            self._renderers[size] = Renderer(self._model, size)
        colour, depth = self._renderers[size].seen(data, pose.position, pose.rotation, fovy)
        return CameraImage(colour=colour, depth=depth, fovy=fovy, T_world_camera=pose)

    def close(self) -> None:
        """Releases the memory."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()


def placed(model: mujoco.MjModel, data: mujoco.MjData, camera: str | Camera) -> tuple[Pose, float]:
    """T_world_camera, z forward, and the vertical angle of view, rad."""
    if isinstance(camera, Camera):
        return _carrier(model, data, camera.on) @ camera.at, camera.fovy
    if not isinstance(camera, str):
        raise InputError(f"camera: expected a name or a Camera, got {shown(camera)}")
    index = object_id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    if index < 0:
        raise UnknownNameError.from_known("camera", camera, [model.camera(i).name for i in range(model.ncam)])
    fovy = float(np.radians(model.cam_fovy[index]))
    if model.cam_sensorsize[index].any():
        focal = model.cam_intrinsic[index]
        if np.abs(focal[2:]).max() > 0.0:
            raise InputError(f"camera: {camera!r:.60} has its optical axis beside the middle; give a Camera instead")
        fovy = float(2.0 * np.arctan(0.5 * model.cam_sensorsize[index][1] / focal[1]))
    rotation = data.cam_xmat[index].reshape(3, 3) @ _MUJOCO_FROM_OPTICAL
    return Pose.from_rotation(data.cam_xpos[index], rotation), fovy


def _carrier(model: mujoco.MjModel, data: mujoco.MjData, on: str) -> Pose:
    """Where a body or site is."""
    if not on:
        return Pose(np.zeros(3))
    body = object_id(model, mujoco.mjtObj.mjOBJ_BODY, on)
    if body >= 0:
        return Pose.from_rotation(data.xpos[body], data.xmat[body].reshape(3, 3))
    site = object_id(model, mujoco.mjtObj.mjOBJ_SITE, on)
    if site < 0:
        names = [model.body(i).name for i in range(1, model.nbody)] + [model.site(i).name for i in range(model.nsite)]
        raise UnknownNameError.from_known("body or site of the camera", on, names)
    return Pose.from_rotation(data.site_xpos[site], data.site_xmat[site].reshape(3, 3))


def _read_depth(depth: ArrayLike) -> Array:
    try:
        picture = np.asarray(depth, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"depth: {shown(depth)} is not a picture of numbers") from None
    if picture.ndim != 2 or not picture.size:
        raise InputError(f"depth: expected shape (height, width), got {picture.shape}")
    return picture


def _read_intrinsics(intrinsics: ArrayLike | None) -> Array:
    try:
        matrix = np.asarray(intrinsics, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"intrinsics: {shown(intrinsics)} is not a matrix of numbers") from None
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0.0:
        raise InputError("intrinsics: expected (3, 3) finite numbers with f_x and f_y above 0, in pixels")
    return matrix
