"""Renderer: offscreen images of a model, also where only software draws."""

from __future__ import annotations

import copy
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError
from armctl.core.validation import Array
from armctl.render.gl import gl_context

Image = NDArray[np.uint8]
QUALITIES = ("fast", "full")

_TRACE_COLOR = np.array([0.902, 0.624, 0.0, 1.0], np.float32)  # orange of Okabe and Ito, as in the plots
_TRACE_RADIUS = 0.0025  # of the model's extent
_TRACE_PIECES = 400


class Renderer:
    """Draws states of one model into images. Close it, or use it in a `with`.

    Software draws shadows, reflections and smooth edges ten times slower than the rest, so the fast quality leaves them out.

    Attributes:
        width: Pixels.
        height: Pixels.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 640, height: int = 480, quality: str = "fast"):
        """A renderer for a model.

        Args:
            model: The model; it keeps a copy.
            width: Pixels.
            height: Pixels.
            quality: "fast" or "full".

        Raises:
            InputError: A size below 16 pixels, or there is no such quality.
            NotInstalledError: There is no OpenGL here that works without a screen.
        """
        if quality not in QUALITIES:
            raise InputError(f"quality: {quality!r} given, one of {', '.join(QUALITIES)} wanted")
        if min(width, height) < 16:
            raise InputError(f"size: {width} x {height} pixels given, at least 16 x 16 wanted")
        self.width, self.height, self._fast = width, height, quality == "fast"
        self._model = copy.copy(model)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        self._model.vis.quality.offsamples = 0 if self._fast else 4
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self._model, maxgeom=max(1000, 2 * model.ngeom) + _TRACE_PIECES)
        self._gl = gl_context(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Gives the memory back. Once is enough, twice does no harm."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._context = None

    def image(self, data: mujoco.MjData, camera: mujoco.MjvCamera, trace: Array | None = None) -> Image:
        """Draws a state.

        Args:
            data: The state, after forward kinematics.
            camera: Where it is seen from.
            trace: (k, 3) m, a way to draw as a line, such as the tip's; nothing if left out.

        Returns:
            (height, width, 3), red, green and blue.

        Raises:
            InputError: The renderer is closed.
        """
        if self._context is None:
            raise InputError("renderer: it is closed; make another")
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, everything, self._scene)
        if trace is not None:
            self._add_trace(trace)
        if self._fast:
            self._scene.flags[[int(mujoco.mjtRndFlag.mjRND_SHADOW), int(mujoco.mjtRndFlag.mjRND_REFLECTION)]] = 0
        out, whole = np.empty((self.height, self.width, 3), np.uint8), mujoco.MjrRect(0, 0, self.width, self.height)
        self._gl.make_current()
        mujoco.mjr_render(whole, self._scene, self._context)
        mujoco.mjr_readPixels(out, None, whole, self._context)
        return out[::-1]

    def _add_trace(self, points: Array) -> None:
        """Capsules between points, thinned out to what a picture can show."""
        radius = _TRACE_RADIUS * min(self._model.stat.extent, 2.0)
        points, scene, capsule = thinned(points, _TRACE_PIECES), self._scene, int(mujoco.mjtGeom.mjGEOM_CAPSULE)
        for start, end in pairwise(points):
            if scene.ngeom == scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), _TRACE_COLOR)
            mujoco.mjv_connector(geom, capsule, radius, start, end)
            geom.emission, geom.specular = 0.3, 0.0
            scene.ngeom += 1


def thinned(points: Array, pieces: int) -> Array:
    """A line through fewer points, evenly spaced along it, its ends kept.

    Args:
        points: (k, 3) m.
        pieces: How many straight pieces at most.

    Returns:
        At most (pieces + 1, 3) of the points; one alone where they all are one.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    total = float(lengths.sum())
    if total < 1e-6:
        return points[:1]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    # A point each half millimetre shows any way; a still tip needs no more than its place.
    count = int(min(pieces, max(1, total / 5e-4)))
    return points[np.unique(np.searchsorted(along, np.linspace(0.0, total, count + 1)).clip(0, len(points) - 1))]
