"""What the tip's path is made of: lines and arcs, the orientation turning along.

Each shape is a function of its own length. Lengths are metres; a turn of the tip counts as an arc of 0.2 m radius where that is
longer than the way of its point, so that turning on the spot has a length too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from armctl.core.errors import InputError
from armctl.core.pose import rotation_from_vector, rotation_vector
from armctl.core.validation import Array

TURN_RADIUS = 0.2  # m: what a radian of turning counts as
MIN_LENGTH = 1e-9  # m


class PathPoint(NamedTuple):
    """A place on a path."""

    position: Array  # (3,) m
    rotation: Array  # (3, 3)
    twist: Array  # (6,) how both change with the length: linear, then angular in world axes


class PathSegment(Protocol):
    """One stretch of a tip's path: its length, m, and the place at a length."""

    @property
    def length(self) -> float: ...

    def at(self, s: float) -> PathPoint: ...


@dataclass(frozen=True, eq=False)
class Turn:
    """The tip's orientation from one to another about a fixed axis (spherical linear interpolation)."""

    start: Array  # (3, 3)
    vector: Array  # (3,) rad, axis times angle, in world axes

    @classmethod
    def between(cls, start: Array, end: Array) -> Turn:
        """The shortest turn between two orientations, each (3, 3)."""
        return cls(start, start @ rotation_vector(start.T @ end))

    @cached_property
    def length(self) -> float:
        """What it counts as, m."""
        return TURN_RADIUS * float(np.linalg.norm(self.vector))

    def at(self, share: float) -> Array:
        """The orientation (3, 3) after a share of it, 0 to 1."""
        return rotation_from_vector(share * self.vector) @ self.start if self.length else self.start


class Straight:
    """A straight line from one point (3,) m to another, with a turn along it."""

    def __init__(self, start: Array, end: Array, turn: Turn):
        self._start = start
        self._way = end - start
        self._turn = turn
        self._change = np.concatenate([self._way, turn.vector])
        self.length = max(float(np.linalg.norm(self._way)), turn.length)

    def at(self, s: float) -> PathPoint:
        share = s / self.length
        return PathPoint(self._start + share * self._way, self._turn.at(share), self._change / self.length)

    def pose_at(self, share: float) -> tuple[Array, Array]:
        """The position (3,), m, and the orientation (3, 3) at a share of the way, 0 to 1; also of a line without length."""
        return self._start + share * self._way, self._turn.at(share)


class Circle:
    """An arc by an angle, rad, from a point (3,) m around a center (3,) m and an axis (3,), with a turn along it."""

    def __init__(self, start: Array, center: Array, axis: Array, angle: float, turn: Turn):
        self._center = center
        self._angle = angle
        self._turn = turn
        self._radius = start - center
        self._ahead = np.cross(axis, self._radius)  # from the center to where a quarter of a turn leads
        self.length = max(angle * float(np.linalg.norm(self._radius)), turn.length)

    @classmethod
    def through(cls, start: Array, via: Array, end: Array, angle: float | None, turn: Turn) -> Circle:
        """The arc from a point (3,) through a second to a third, or by an angle. Raises InputError if they are on one line."""
        a = via - start
        b = end - start
        normal = np.cross(a, b)
        size = float(normal @ normal)
        if size <= 1e-12 * float(a @ a) * float(b @ b) or size == 0.0:
            raise InputError(
                "via: start, via and target are on one line and define no circle; give three points apart, or use a line"
            )
        center = start + np.cross((a @ a) * b - (b @ b) * a, normal) / (2 * size)
        axis = normal / math.sqrt(size)
        if angle is None:
            arm = start - center
            last = end - center
            angle = math.atan2(float(axis @ np.cross(arm, last)), float(arm @ last)) % (2 * math.pi)
        return cls(start, center, axis, angle, turn)

    def at(self, s: float) -> PathPoint:
        share = s / self.length
        cos = math.cos(share * self._angle)
        sin = math.sin(share * self._angle)
        linear = self._angle * (cos * self._ahead - sin * self._radius)
        twist = np.concatenate([linear, self._turn.vector]) / self.length
        return PathPoint(self._center + (cos * self._radius + sin * self._ahead), self._turn.at(share), twist)


@dataclass(frozen=True, eq=False)
class Blend:
    """A rounded corner: the one shape slows down to the corner while the next already leaves it, added up.

    Inside it goes from a `radius` before the corner to a `radius` after it; at both ends it agrees with the shapes in position,
    orientation and their first three derivatives.
    """

    before: PathSegment  # the shape that ends at the corner
    after: PathSegment  # the shape that starts there
    radius: float  # m, along both

    @property
    def length(self) -> float:
        return 2 * self.radius

    def at(self, s: float) -> PathPoint:
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

    shape: PathSegment
    start: float  # m, where it begins on it
    end: float  # m, where it ends

    @property
    def length(self) -> float:
        return self.end - self.start

    def at(self, s: float) -> PathPoint:
        return self.shape.at(self.start + s)


class CompositePath:
    """Shapes one after another."""

    def __init__(self, shapes: list[PathSegment]):
        """Shapes, each of which starts where the one before it ends."""
        self._shapes = [shape for shape in shapes if shape.length > MIN_LENGTH]
        self.ends = np.cumsum([shape.length for shape in self._shapes])

    @property
    def length(self) -> float:
        return float(self.ends[-1]) if len(self.ends) else 0.0

    def at(self, s: float) -> PathPoint:
        k = min(int(np.searchsorted(self.ends, s, side="right")), len(self.ends) - 1)
        shape = self._shapes[k]
        return shape.at(min(s - (self.ends[k] - shape.length), shape.length))


def _ease(u: float) -> tuple[float, float]:
    """From 0 to 1 for u from 0 to 1, arriving at rest, and the speed: 1 at first in lengths of 2, three derivatives smooth.

    The speed is 1 - S(u), S the quintic step 6 u^5 - 15 u^4 + 10 u^3.
    """
    step = u**3 * (10 + u * (6 * u - 15))
    return 2 * u - u**4 * (5 + u * (2 * u - 6)), 1 - step
