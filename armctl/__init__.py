"""Command robot arms in MuJoCo from Python.

The public names are listed once, in `__init__.pyi`. Each is imported when it is first used, so that `import armctl` stays fast.
"""

from typing import Any

import lazy_loader

from armctl.core import hooks
from armctl.core.distribution import warn_if_foreign_armctl_is_installed
from armctl.core.uninterrupted import uninterrupted_import

__version__ = "0.1.0"

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    with uninterrupted_import():
        return _public(name)


def _open_viewer(arm: Any) -> Any:
    """The page behind `Simulation(viewer=True)`."""
    from armctl.viewer.viewer import Viewer

    return Viewer(arm)


hooks.open_viewer = _open_viewer
warn_if_foreign_armctl_is_installed()
