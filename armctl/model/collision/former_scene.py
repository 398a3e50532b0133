"""Scene: the former name of World, with its former methods, for programs that were written before. It goes with version 0.2."""

from __future__ import annotations

import warnings

from numpy.typing import ArrayLike

from armctl.core.pose import Pose
from armctl.core.shapes import Ball, Box, Cylinder
from armctl.model.collision.world import World


class Scene(World):
    """A World with the former methods. Use `armctl.World().add(name, armctl.Box(size), at, mass)`."""

    def __init__(self) -> None:
        """An empty world."""
        text = "armctl.Scene goes with version 0.2; use armctl.World().add(name, armctl.Box(size), at, mass)"
        warnings.warn(DeprecationWarning(text), stacklevel=2)
        super().__init__()

    def add_box(self, name: str, size: ArrayLike, at: Pose | ArrayLike, mass: float | None = None) -> Scene:
        """As `add` with a Box, its edges (3,) m."""
        self.add(name, Box(size), at, mass)
        return self

    def add_ball(self, name: str, radius: float, at: Pose | ArrayLike, mass: float | None = None) -> Scene:
        """As `add` with a Ball, its radius in m."""
        self.add(name, Ball(radius), at, mass)
        return self

    def add_cylinder(self, name: str, radius: float, length: float, at: Pose | ArrayLike, mass: float | None = None) -> Scene:
        """As `add` with a Cylinder, its radius and length in m."""
        self.add(name, Cylinder(radius, length), at, mass)
        return self
