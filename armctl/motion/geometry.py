"""What the tip's path is made of: lines, arcs, and the blends that round the corners between them.

Each shape is a function of its own length. Lengths are metres; a turn of the tip counts as an arc of 0.2 m radius where that is
longer than the way of its point, so that turning on the spot has a length too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from armctl.arrays import Array
from armctl.errors import InputError
from armctl.pose import rotation_from_vector, rotation_vector

TURN_RADIUS = 0.2  # m: what a radian of turning counts as
_COINCIDE = 1e-9  # m


class TipState(NamedTuple):
    """A place on a path.

    Attributes:
        position: (3,) m.
        rotation: (3, 3).
        twist: (6,) how both change with the length: linear, then angular in world axes.
    """

    position: Array
    rotation: Array
    twist: Array


class Shape(Protocol):
    """One stretch of a tip's path."""

    @property
    def length(self) -> float:
        """Its length, m."""
        ...

    def at(self, s: float) -> TipState:
        """The place at a length.

        Args:
            s: m from its start.

        Returns:
            The place.
        """
        ...


@dataclass(frozen=True, eq=False)
class Turn:
    """The tip's orientation from one to another about a fixed axis (spherical linear interpolation).

    Attributes:
        start: (3, 3).
        vector: (3,) rad, axis times angle, in world axes.
    """

    start: Array
    vector: Array

    @classmethod
    def between(cls, start: Array, end: Array) -> Turn:
        """The shortest turn.

        Args:
            start: (3, 3).
            end: (3, 3).

        Returns:
            The turn.
        """
        return cls(start, start @ rotation_vector(start.T @ end))

    @property
    def length(self) -> float:
        """What it counts as, m."""
        return TURN_RADIUS * float(np.linalg.norm(self.vector))

    def at(self, share: float) -> Array:
        """The orientation after a share of it.

        Args:
            share: 0 to 1.

        Returns:
            (3, 3).
        """
        return rotation_from_vector(share * self.vector) @ self.start


@dataclass(frozen=True, eq=False)
class Straight:
    """A straight line.

    Attributes:
        start: (3,) m.
        end: (3,) m.
        turn: How the orientation goes along.
    """

    start: Array
    end: Array
    turn: Turn

    @property
    def length(self) -> float:
        """Its length, m."""
        return max(float(np.linalg.norm(self.end - self.start)), self.turn.length)

    def at(self, s: float) -> TipState:
        """The place at a length.

        Args:
            s: m from its start.

        Returns:
            The place.
        """
        share, way = s / self.length, self.end - self.start
        twist = np.concatenate([way, self.turn.vector]) / self.length
        return TipState(self.start + share * way, self.turn.at(share), twist)


@dataclass(frozen=True, eq=False)
class Circle:
    """An arc of a circle.

    Attributes:
        start: (3,) m.
        center: (3,) m.
        axis: (3,) unit vector that it turns about.
        angle: rad, how far.
        turn: How the orientation goes along.
    """

    start: Array
    center: Array
    axis: Array
    angle: float
    turn: Turn

    @classmethod
    def through(cls, start: Array, via: Array, end: Array, angle: float | None, turn: Turn) -> Circle:
        """The arc from a point through a second to a third.

        Args:
            start: (3,) m.
            via: (3,) m.
            end: (3,) m.
            angle: rad, how far to go on the circle; None stops at the third point.
            turn: How the orientation goes along.

        Returns:
            The arc.

        Raises:
            InputError: The points are on one line, so no circle goes through them.
        """
        a, b = via - start, end - start
        normal = np.cross(a, b)
        size = float(normal @ normal)
        if size <= 1e-12 * float(a @ a) * float(b @ b) or size == 0.0:
            raise InputError("via: start, via and target are on one line, so no circle goes through them; use a line")
        center = start + np.cross((a @ a) * b - (b @ b) * a, normal) / (2 * size)
        axis = normal / math.sqrt(size)
        if angle is None:
            arm, last = start - center, end - center
            angle = math.atan2(float(axis @ np.cross(arm, last)), float(arm @ last)) % (2 * math.pi)
        return cls(start, center, axis, angle, turn)

    @property
    def length(self) -> float:
        """Its length, m."""
        return max(self.angle * float(np.linalg.norm(self.start - self.center)), self.turn.length)

    def at(self, s: float) -> TipState:
        """The place at a length.

        Args:
            s: m from its start.

        Returns:
            The place.
        """
        share = s / self.length
        arm = rotation_from_vector(share * self.angle * self.axis) @ (self.start - self.center)
        linear = np.cross(self.axis, arm) * self.angle
        return TipState(self.center + arm, self.turn.at(share), np.concatenate([linear, self.turn.vector]) / self.length)


@dataclass(frozen=True, eq=False)
class Blend:
    """A rounded corner: the one shape slows down to the corner while the next already leaves it, added up.

    Inside it goes from a `radius` before the corner to a `radius` after it; at both ends it agrees with the shapes in position,
    orientation and their first three derivatives.

    Attributes:
        before: The shape that ends at the corner.
        after: The shape that starts there.
        radius: m, along both.
    """

    before: Shape
    after: Shape
    radius: float

    @property
    def length(self) -> float:
        """Its length, m."""
        return 2 * self.radius

    def at(self, s: float) -> TipState:
        """The place at a length.

        Args:
            s: m from its start.

        Returns:
            The place.
        """
        u = s / self.length
        done, speed = _ease(u)
        ahead, ahead_speed = _ease(1 - u)
        a = self.before.at(self.before.length - self.radius * (1 - done))
        b = self.after.at(self.radius * (1 - ahead))
        corner = self.after.at(0.0)
        turned = a.rotation @ corner.rotation.T
        twist = a.twist * speed + np.concatenate([b.twist[:3], turned @ b.twist[3:]]) * ahead_speed
        return TipState(a.position + b.position - corner.position, turned @ b.rotation, twist)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Part of a shape.

    Attributes:
        shape: The shape.
        start: m, where it begins on it.
        end: m, where it ends.
    """

    shape: Shape
    start: float
    end: float

    @property
    def length(self) -> float:
        """Its length, m."""
        return self.end - self.start

    def at(self, s: float) -> TipState:
        """The place at a length.

        Args:
            s: m from its start.

        Returns:
            The place.
        """
        return self.shape.at(self.start + s)


class Chained:
    """Shapes one after another."""

    def __init__(self, shapes: list[Shape]):
        """The shapes in a row.

        Args:
            shapes: Each starts where the one before it ends.
        """
        self._shapes = [shape for shape in shapes if shape.length > _COINCIDE]
        self.ends = np.cumsum([shape.length for shape in self._shapes])

    @property
    def length(self) -> float:
        """Its length, m."""
        return float(self.ends[-1]) if len(self.ends) else 0.0

    def at(self, s: float) -> TipState:
        """The place at a length.

        Args:
            s: m from its start.

        Returns:
            The place.
        """
        k = min(int(np.searchsorted(self.ends, s, side="right")), len(self.ends) - 1)
        shape = self._shapes[k]
        return shape.at(min(s - (self.ends[k] - shape.length), shape.length))


def _ease(u: float) -> tuple[float, float]:
    """From 0 to 1 for u from 0 to 1, arriving at rest, and the speed: 1 at first in lengths of 2, three derivatives smooth.

    The speed is 1 - S(u), S the quintic step 6 u^5 - 15 u^4 + 10 u^3.
    """
    step = u**3 * (10 + u * (6 * u - 15))
    return 2 * u - u**4 * (5 + u * (2 * u - 6)), 1 - step
