"""An OpenGL context without a screen.

`mujoco.Renderer` selects its backend while mujoco is imported, and by default one that needs a screen on Linux. armctl selects
it when the first picture is drawn.
"""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from typing import Protocol

from armctl.core.errors import NotInstalledError

INSTALL = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri"
_LIBRARY_OF_BACKEND = {"egl": "EGL", "osmesa": "OSMesa"}  # in the order of preference


class GlContext(Protocol):
    """The common methods of MuJoCo's backends."""

    def make_current(self) -> None:
        """Directs OpenGL calls of this thread to this context."""
        ...

    def free(self) -> None:
        """Releases the memory."""
        ...


def gl_context(width: int, height: int) -> GlContext:
    """An offscreen OpenGL context, not yet current. `MUJOCO_GL` selects the backend; unset, the first one that is installed.

    Raises NotInstalledError if no OpenGL works here without a screen.
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
