"""OpenGL without a screen: which of MuJoCo's backends there is, and one sentence where there is none."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from typing import Protocol

from armctl.core.errors import NotInstalledError

INSTALL = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri"
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # in the order of preference


class GlContext(Protocol):
    """What MuJoCo's backends have in common."""

    def make_current(self) -> None:
        """Draws go here from now on."""
        ...

    def free(self) -> None:
        """Gives the memory back."""
        ...


def gl_context(width: int, height: int) -> GlContext:
    """An OpenGL context to draw in offscreen. `MUJOCO_GL` decides the backend; unset, the first that is there.

    Args:
        width: Pixels.
        height: Pixels.

    Returns:
        The context, not yet current.

    Raises:
        NotInstalledError: There is no OpenGL here that works without a screen.
    """
    backend = os.environ.get("MUJOCO_GL", "").strip().lower() or _found()
    try:
        return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
    except Exception as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise NotInstalledError(f"OpenGL by {backend} gives no picture ({why}); on Debian: {INSTALL}") from None


def _found() -> str:
    if sys.platform == "darwin":
        return "cgl"
    there = [backend for backend, library in _LIBRARIES.items() if ctypes.util.find_library(library)]
    return there[0] if there else "glfw"
