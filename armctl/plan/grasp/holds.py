"""Holds: where two pads can press on a shape from opposite sides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from armctl.core.pose import Pose
from armctl.core.shapes import Ball, Box, Cylinder, Mesh, Shape
from armctl.core.validation import Array

# Where on a side the pads press, in shares of its half extent from the center.
_PLACES = (0.0, 0.3, -0.3, 0.6, -0.6, 0.85, -0.85)
_DIRECTIONS_AROUND = 8  # of the closing direction, over half a turn around a cylinder
_DIRECTIONS = 24  # over half a sphere
_FACES = 24  # of a hull, the largest
# Pads of rubber or of MuJoCo's default friction hold on faces that are tilted by less than this against the closing direction.
_MAX_TILT_RAD = 0.3
_ALONG_FACE = 1e-9  # the sine of an angle below which a line is along a face
_PARALLEL = 0.985  # cosine, above which two directions count as one


class Hold(NamedTuple):
    """Two pads on opposite sides of a body, in the frame of the body."""

    point: Array  # (3,) m, the middle between the pads
    closing: Array  # (3,) unit, from one pad to the other
    width: float  # m, between the pads


@dataclass(frozen=True, eq=False)
class BodyPart:
    """A shape that belongs to a body.

    Attributes:
        shape: A Box, Ball, Cylinder or Mesh.
        place: T_body_shape.
    """

    shape: Shape
    place: Pose


def holds_of(parts: Sequence[BodyPart]) -> list[Hold]:
    """All holds of a body, in its frame, whatever their width."""
    found = []
    for part in parts:
        R = part.place.rotation
        for hold in _holds_of_shape(part.shape):
            found.append(Hold(part.place.transform(hold.point), R @ hold.closing, hold.width))
    return found


def center_of(parts: Sequence[BodyPart]) -> Array:
    """(3,) m, the middle of a body's extent, in its frame."""
    points = np.concatenate([part.place.position + corners(part.shape) @ part.place.rotation.T for part in parts])
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def radius_of(parts: Sequence[BodyPart], center: Array) -> float:
    """m, from a point (3,) to what is farthest of a body."""
    points = np.concatenate([part.place.position + corners(part.shape) @ part.place.rotation.T for part in parts])
    return float(np.linalg.norm(points - center, axis=1).max())


def corners(shape: Shape) -> Array:
    """(k, 3) m, points whose convex hull contains a shape; those of a mesh are its vertices."""
    if isinstance(shape, Mesh):
        return shape.vertices
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    if isinstance(shape, Box):
        return signs * shape.size
    assert isinstance(shape, (Ball, Cylinder))
    length = shape.length if isinstance(shape, Cylinder) else 2.0 * shape.radius
    return signs * [2.0 * shape.radius, 2.0 * shape.radius, length]


def _holds_of_shape(shape: Shape) -> Iterator[Hold]:
    if isinstance(shape, Box):
        yield from _box_holds(shape)
    elif isinstance(shape, Cylinder):
        yield from _cylinder_holds(shape)
    elif isinstance(shape, Ball):
        for closing in half_sphere(_DIRECTIONS):
            yield Hold(np.zeros(3), closing, 2.0 * shape.radius)
    else:
        assert isinstance(shape, Mesh)
        yield from _hull_holds(shape)


def _box_holds(box: Box) -> Iterator[Hold]:
    for axis in range(3):
        closing = np.eye(3)[axis]
        first = (axis + 1) % 3
        second = (axis + 2) % 3
        for one in _PLACES:
            for other in _PLACES:
                point = np.zeros(3)
                point[first] = 0.5 * one * box.size[first]
                point[second] = 0.5 * other * box.size[second]
                yield Hold(point, closing, float(box.size[axis]))


def _cylinder_holds(cylinder: Cylinder) -> Iterator[Hold]:
    for angle in np.pi / _DIRECTIONS_AROUND * np.arange(_DIRECTIONS_AROUND):
        closing = np.array([np.cos(angle), np.sin(angle), 0.0])
        for place in _PLACES:
            yield Hold(np.array([0.0, 0.0, 0.5 * place * cylinder.length]), closing, 2.0 * cylinder.radius)
    yield Hold(np.zeros(3), np.array([0.0, 0.0, 1.0]), cylinder.length)


def _hull_holds(mesh: Mesh) -> Iterator[Hold]:
    """Holds of a convex hull: lines through it whose ends are on faces that are nearly across the line."""
    hull = _Hull.of(mesh)
    for closing in [*hull.directions, *half_sphere(_DIRECTIONS)]:
        sides = _across(closing)
        extents = hull.points @ sides.T
        middle = 0.5 * (extents.min(axis=0) + extents.max(axis=0))
        half = 0.5 * np.ptp(extents, axis=0)
        for one in _PLACES:
            for other in _PLACES:
                start = (middle + half * [one, other]) @ sides
                ends = hull.crossed(start, closing)
                if ends is not None:
                    yield Hold(start + 0.5 * (ends[0] + ends[1]) * closing, closing, ends[1] - ends[0])


class _Hull(NamedTuple):
    """A convex hull as half spaces."""

    points: Array  # (P, 3) m, its corners
    normals: Array  # (F, 3) outwards
    distances: Array  # (F,) m, of the faces from the origin along their normals
    directions: Array  # (d, 3) from one large face to the opposite one, each direction once

    @classmethod
    def of(cls, mesh: Mesh) -> _Hull:
        from scipy.spatial import ConvexHull

        hull = ConvexHull(mesh.vertices)
        corners = hull.points[hull.simplices]
        areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        normals = hull.equations[:, :3]
        planes, members = np.unique(np.round(normals, 3), axis=0, return_inverse=True)
        order = np.argsort(-np.bincount(members.ravel(), areas), kind="stable")
        largest = planes[order[:_FACES]]
        directions: list[Array] = []
        for one, other in combinations(largest, 2):  # the direction to which both faces are tilted alike
            closing = one - other
            length = float(np.linalg.norm(closing))
            if length < 2.0 * np.cos(_MAX_TILT_RAD):
                continue
            if all(abs(closing @ known) < _PARALLEL * length for known in directions):
                directions.append(closing / length)
        return cls(hull.points[hull.vertices], normals, -hull.equations[:, 3], np.array(directions).reshape(-1, 3))

    def crossed(self, start: Array, direction: Array) -> tuple[float, float] | None:
        """Where a line from a point (3,) enters and leaves, m along the direction (3,).

        None if it misses the hull, or crosses a face that is too oblique to hold it there.
        """
        slopes = self.normals @ direction
        with np.errstate(divide="ignore", invalid="ignore"):
            ways = (self.distances - self.normals @ start) / slopes
        along = np.abs(slopes) <= _ALONG_FACE
        if (self.distances - self.normals @ start)[along].min(initial=0.0) < 0.0:
            return None
        leaves = np.where(slopes > _ALONG_FACE, ways, np.inf)
        enters = np.where(slopes < -_ALONG_FACE, ways, -np.inf)
        last = int(leaves.argmin())
        first = int(enters.argmax())
        if leaves[last] <= enters[first] or min(slopes[last], -slopes[first]) < np.cos(_MAX_TILT_RAD):
            return None
        return float(enters[first]), float(leaves[last])


def _across(direction: Array) -> Array:
    """(2, 3) two directions across another and each other."""
    first = np.cross(direction, np.eye(3)[int(np.abs(direction).argmin())])
    first = first / np.linalg.norm(first)
    return np.array([first, np.cross(direction, first)], np.float64)


def half_sphere(count: int) -> Array:
    """(count, 3) directions that are evenly spread over half a sphere: a Fibonacci lattice.

    J. H. Hannay, J. F. Nye, "Fibonacci numerical integration on a sphere", J. Phys. A 37 (2004).
    """
    k = np.arange(count) + 0.5
    z = 1.0 - k / count
    radius = np.sqrt(1.0 - z * z)
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
