"""Offscreen images of a model, fast enough for software rendering."""

from __future__ import annotations

import copy
import ctypes.util
import importlib
import os
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError, NotInstalledError
from armctl.core.validation import Array, choice, integer, shown

Image = NDArray[np.uint8]
QUALITIES = ("fast", "full")
MIN_PIXELS = 16
MAX_PIXELS = 8192  # OpenGL promises renderbuffers of this size, or hardly less

_SEEN_SHARE = 0.999  # of the farthest depth that is drawn: what is beyond it is the sky
_TRACE_COLOR = np.array([0.902, 0.624, 0.0, 1.0], np.float32)  # orange of Okabe and Ito, as in the plots
_TRACE_RADIUS = 0.0025  # of the model's extent
_STICK_COLOR = np.array([0.75, 0.78, 0.82, 1.0], np.float32)
_STICK_RADIUS = 0.0075  # of the model's extent
_MAX_TRACE_SEGMENTS = 400
_MIN_TRACE_SEGMENT_M = 5e-4
_MIN_TRACE_LENGTH_M = 1e-6
INSTALL = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri"
_LIBRARY_OF_BACKEND = {"egl": "EGL", "osmesa": "OSMesa"}  # in the order of preference


def check_size(size: tuple[int, int]) -> tuple[int, int]:
    """The checked width and height of a picture, in pixels."""
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise InputError(f"size: expected width and height in pixels, such as (640, 480), got {shown(size)}")
    return integer("width", size[0], MIN_PIXELS, MAX_PIXELS), integer("height", size[1], MIN_PIXELS, MAX_PIXELS)


class Renderer:
    """Draws states of one model into images. Close it, or use it in a `with`.

    In software, shadows, reflections and smooth edges take ten times longer than the rest, so the fast quality omits them.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int] = (640, 480), quality: str = "fast"):
        """A renderer that keeps a copy of the model; `size` is width and height in pixels, `quality` "fast" or "full"."""
        self._fast = choice("quality", quality, QUALITIES) == "fast"
        self.width, self.height = check_size(size)
        self._model = copy.copy(model)
        self._model.vis.global_.offwidth = self.width
        self._model.vis.global_.offheight = self.height
        self._model.vis.quality.offsamples = 0 if self._fast else 4
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self._model, maxgeom=max(1000, 2 * model.ngeom) + _MAX_TRACE_SEGMENTS + model.nbody)
        self._context: mujoco.MjrContext | None = None
        self._gl = gl_context(self.width, self.height)
        self._gl.make_current()
        try:
            self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_150)
        except mujoco.FatalError as error:
            self._gl.free()
            raise InputError(f"size: OpenGL cannot draw {self.width} x {self.height} pixels ({error})") from None
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Releases the memory; further calls have no effect."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._context = None

    def image(
        self, data: mujoco.MjData, camera: mujoco.MjvCamera, trace: Array | None = None, sticks: Array | None = None
    ) -> Image:
        """Draws a state, after forward kinematics: (height, width, 3).

        `trace` (k, 3) m is a path to draw as a line, `sticks` (k, 2, 3) m are the ends of the lines of a stick figure.
        """
        if self._context is None:
            raise InputError("renderer: it is closed; make another")
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, everything, self._scene)
        if trace is not None:
            self._add_capsules(pairwise(thinned(trace, _MAX_TRACE_SEGMENTS)), _TRACE_RADIUS, _TRACE_COLOR)
        if sticks is not None:
            self._add_capsules(sticks, _STICK_RADIUS, _STICK_COLOR)
        if self._fast:
            self._scene.flags[[int(mujoco.mjtRndFlag.mjRND_SHADOW), int(mujoco.mjtRndFlag.mjRND_REFLECTION)]] = 0
        out = np.empty((self.height, self.width, 3), np.uint8)
        whole = mujoco.MjrRect(0, 0, self.width, self.height)
        self._gl.make_current()
        mujoco.mjr_render(whole, self._scene, self._context)
        mujoco.mjr_readPixels(out, None, whole, self._context)
        return out[::-1]

    def seen(self, data: mujoco.MjData, eye: Array, rotation: Array, fovy: float) -> tuple[Image, NDArray[np.float32]]:
        """What a pinhole camera sees: the picture, and the depth (height, width) m, infinite where there is nothing.

        It is at `eye` (3,) m, and the columns of `rotation` (3, 3) are its directions right, down and forward; `fovy` in rad.
        """
        if self._context is None:
            raise InputError("renderer: it is closed; make another")
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(self._model, data, self._option, None, mujoco.MjvCamera(), everything, self._scene)
        if self._fast:
            self._scene.flags[[int(mujoco.mjtRndFlag.mjRND_SHADOW), int(mujoco.mjtRndFlag.mjRND_REFLECTION)]] = 0
        self._scene.flags[int(mujoco.mjtRndFlag.mjRND_SKYBOX)] = 0  # a sky would have a depth
        near = float(self._scene.camera[0].frustum_near)
        far = float(self._scene.camera[0].frustum_far)
        for camera in self._scene.camera:
            camera.pos[:] = eye
            camera.forward[:] = rotation[:, 2]
            camera.up[:] = -rotation[:, 1]
            camera.frustum_center = 0.0
            camera.frustum_width = 0.0
            camera.frustum_top = near * np.tan(0.5 * fovy)
            camera.frustum_bottom = -camera.frustum_top
        whole = mujoco.MjrRect(0, 0, self.width, self.height)
        colour = np.empty((self.height, self.width, 3), np.uint8)
        buffer = np.empty((self.height, self.width), np.float32)
        self._gl.make_current()
        mujoco.mjr_render(whole, self._scene, self._context)
        mujoco.mjr_readPixels(colour, buffer, whole, self._context)
        # The buffer of OpenGL's perspective projection, 0 at the near plane and 1 at the far one.
        depth = near / (1.0 - buffer.astype(np.float64) * (1.0 - near / far))
        depth[depth > _SEEN_SHARE * far] = np.inf
        return colour[::-1], depth[::-1].astype(np.float32)

    def _add_capsules(self, ends: Iterable[Sequence[Array]], radius: float, color: NDArray[np.float32]) -> None:
        """Adds capsules between two points each, as many as a picture can show; the radius is that of an extent of 1 m."""
        radius *= min(self._model.stat.extent, 2.0)
        scene = self._scene
        capsule = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
        for start, end in ends:
            if scene.ngeom == scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), color)
            mujoco.mjv_connector(geom, capsule, radius, start, end)
            geom.emission = 0.3
            geom.specular = 0.0
            scene.ngeom += 1


def thinned(points: Array, max_segments: int) -> Array:
    """At most `max_segments + 1` of the points of a line, evenly spaced along it; its ends stay."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    total = float(lengths.sum())
    if total < _MIN_TRACE_LENGTH_M:
        return points[:1]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    count = int(min(max_segments, max(1, total / _MIN_TRACE_SEGMENT_M)))
    return points[np.unique(np.searchsorted(along, np.linspace(0.0, total, count + 1)).clip(0, len(points) - 1))]


class GlContext(Protocol):
    """The common methods of MuJoCo's backends."""

    def make_current(self) -> None: ...  # directs OpenGL calls of this thread to this context

    def free(self) -> None: ...  # releases the memory


def gl_context(width: int, height: int) -> GlContext:
    """An offscreen OpenGL context, not yet current. `MUJOCO_GL` selects the backend; unset, the first one that is installed.

    `mujoco.Renderer` selects its backend while mujoco is imported, and by default one that needs a screen on Linux.
    """
    backend = os.environ.get("MUJOCO_GL", "").strip().lower() or _installed_backend()
    try:
        return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
    except Exception as error:  # each backend raises other types
        why = " ".join(str(error).split()) or type(error).__name__
        raise NotInstalledError(f"OpenGL by {backend} produces no picture ({why:.200}); on Debian: {INSTALL}") from None


def _installed_backend() -> str:
    if sys.platform == "darwin":
        return "cgl"
    installed = [backend for backend, library in _LIBRARY_OF_BACKEND.items() if ctypes.util.find_library(library)]
    return installed[0] if installed else "glfw"
