"""The options of the moves along a path that avoid contact."""

from __future__ import annotations

from collections.abc import Iterable

from armctl.core.faces import with_options
from armctl.plan.motion.move_cartesian import PATH_DEFAULTS, PathOptions


class PathMoveOptions(PathOptions, total=False):
    """Options of `Simulation.move_l`, `move_c` and `move_path`, besides those of `PathOptions`.

    Attributes:
        avoid: Whether a motion that would touch something is refused; True if left out.
        allow: Pairs of names of bodies or geoms that may touch; none if left out.
    """

    avoid: bool
    allow: Iterable[tuple[str, str]]


shows_options = with_options(PathMoveOptions, {**PATH_DEFAULTS, "avoid": True, "allow": ()})
