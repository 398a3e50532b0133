"""Command robot arms in MuJoCo from Python.

The public names are listed once, in `__init__.pyi`. Each is imported when it is first used, so that `import armctl` stays fast.
"""

import difflib
from typing import Any

import lazy_loader

from armctl.core import hooks
from armctl.core.distribution import warn_if_foreign_armctl_is_installed
from armctl.core.uninterrupted import uninterrupted_import

__version__ = "0.1.0"

# Names that other libraries use.
_OTHER_NAMES = {
    "inverse_kinematics": "solve_ik",
    "plan_path": "move_free",
    "PID": "ComputedTorqueObserver",
    "Sim": "Simulation",
}
# Names that armctl had: what to write instead.
_FORMER_NAMES = {
    "load_arms": "armctl.load(robot, tips=[...]), which returns one arm with several tips",
    "LeRobotArm": "sim.streaming(), or that of a Robot, and stream.push(t, q) with the positions of an action, in rad",
    "Team": "armctl.Simulation(arm) with an arm of several tips, which takes targets by tip",
}

# Packages that are imported by themselves, for they need extras.
_PACKAGES = ("envs", "jax")

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        if name == "Scene":
            from armctl.model.collision.former_scene import Scene

            return Scene
        if name in _PACKAGES:
            raise AttributeError(
                f"armctl has no attribute {name!r} before it is imported; write: import armctl.{name}", name=name
            )
        if name in _FORMER_NAMES:
            raise AttributeError(f"armctl has no attribute {name!r}; use {_FORMER_NAMES[name]}", name=name)
        near = _OTHER_NAMES.get(name) or ", ".join(
            difflib.get_close_matches(name, __all__, n=2, cutoff=0.5) or [k for k in __all__ if name.lower() in k.lower()]
        )
        hint = f"; similar: {near}" if near and name[0] != "_" else ""
        raise AttributeError(f"armctl has no attribute {name!r}{hint}", name=name)
    with uninterrupted_import():
        return _public(name)


def _open_viewer(arm: Any) -> Any:
    """The page behind `Simulation(viewer=True)`."""
    from armctl.view.viewer import Viewer

    return Viewer(arm)


def _instability(*case: Any) -> str:
    from armctl.lab.loops.linearization import instability

    return instability(*case)


def _why_not_borne(*case: Any) -> str:
    """Why the link to a robot cannot bear a controller."""
    from armctl.lab.loops.link_margins import why_not_borne

    return why_not_borne(*case)


hooks.open_viewer = _open_viewer
hooks.instability = _instability
hooks.why_not_borne = _why_not_borne
warn_if_foreign_armctl_is_installed()
