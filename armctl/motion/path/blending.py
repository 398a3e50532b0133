"""Shapes of a tip's path one after another, the corners between them rounded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armctl.motion.path.geometry import PathPoint, Shape

_MIN_LENGTH = 1e-9  # m


@dataclass(frozen=True, eq=False)
class Blend:
    """A rounded corner: the one shape slows down to the corner while the next already leaves it, added up.

    Inside it goes from a `radius` before the corner to a `radius` after it; at both ends it agrees with the shapes in position,
    orientation and their first three derivatives.
    """

    before: Shape  # the shape that ends at the corner
    after: Shape  # the shape that starts there
    radius: float  # m, along both

    @property
    def length(self) -> float:
        """Its length, m."""
        return 2 * self.radius

    def at(self, s: float) -> PathPoint:
        """The place at a length, m."""
        u = s / self.length
        done, speed = _ease(u)
        ahead, ahead_speed = _ease(1 - u)
        a = self.before.at(self.before.length - self.radius * (1 - done))
        b = self.after.at(self.radius * (1 - ahead))
        corner = self.after.at(0.0)
        turned = a.rotation @ corner.rotation.T
        twist = a.twist * speed + np.concatenate([b.twist[:3], turned @ b.twist[3:]]) * ahead_speed
        return PathPoint(a.position + b.position - corner.position, turned @ b.rotation, twist)


@dataclass(frozen=True, eq=False)
class SubPath:
    """Part of a shape."""

    shape: Shape
    start: float  # m, where it begins on it
    end: float  # m, where it ends

    @property
    def length(self) -> float:
        """Its length, m."""
        return self.end - self.start

    def at(self, s: float) -> PathPoint:
        """The place at a length, m."""
        return self.shape.at(self.start + s)


class CompositePath:
    """Shapes one after another."""

    def __init__(self, shapes: list[Shape]):
        """Shapes, each of which starts where the one before it ends."""
        self._shapes = [shape for shape in shapes if shape.length > _MIN_LENGTH]
        self.ends = np.cumsum([shape.length for shape in self._shapes])

    @property
    def length(self) -> float:
        """Its length, m."""
        return float(self.ends[-1]) if len(self.ends) else 0.0

    def at(self, s: float) -> PathPoint:
        """The place at a length, m."""
        k = min(int(np.searchsorted(self.ends, s, side="right")), len(self.ends) - 1)
        shape = self._shapes[k]
        return shape.at(min(s - (self.ends[k] - shape.length), shape.length))


def _ease(u: float) -> tuple[float, float]:
    """From 0 to 1 for u from 0 to 1, arriving at rest, and the speed: 1 at first in lengths of 2, three derivatives smooth.

    The speed is 1 - S(u), S the quintic step 6 u^5 - 15 u^4 + 10 u^3.
    """
    step = u**3 * (10 + u * (6 * u - 15))
    return 2 * u - u**4 * (5 + u * (2 * u - 6)), 1 - step
