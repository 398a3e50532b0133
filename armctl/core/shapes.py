"""Shapes: boxes, balls, cylinders, meshes and clouds of points, each in its own frame. A World has them around a robot."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, shown
from armctl.core.validation import Array, IntArray, as_array, frozen, matrix, number, vector

MIN_SIZE_M = 1e-6  # of an edge or a radius; what is smaller is a mistake in the units
MAX_LENGTH_M = 1e4
MAX_POINTS = 1_000_000  # in one cloud, whose tree then takes about 100 MB
MAX_GIVEN_POINTS = 50_000_000  # that a grid thins out
MAX_MESH_VERTICES = 200_000
_MIN_THICKNESS = 1e-6  # of a mesh, relative to its extent: what is flatter has no convex hull of three dimensions
_MESH_FILES = (".obj", ".stl", ".msh")


@dataclass(frozen=True, eq=False, init=False)
class Box:
    """A box around its own frame.

    Attributes:
        size: (3,) m, its edges.
    """

    size: Array

    def __init__(self, size: ArrayLike):
        """A box.

        Args:
            size: (3,) m, its edges.

        Raises:
            InputError: An edge that is not positive, or longer than 10 km.
        """
        edges = vector("size", size, 3)
        for edge in edges.tolist():
            _length("size", edge)
        object.__setattr__(self, "size", edges)


@dataclass(frozen=True)
class Ball:
    """A ball around its own frame.

    Attributes:
        radius: m.
    """

    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", _length("radius", self.radius))


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along the z axis of its frame, which is at its centre.

    Attributes:
        radius: m.
        length: m, the whole one.
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", _length("radius", self.radius))
        object.__setattr__(self, "length", _length("length", self.length))


@dataclass(frozen=True, eq=False, init=False)
class Mesh:
    """The convex hull of the vertices of a mesh, as in MuJoCo's contacts: what is concave is filled.

    Divide a concave body into convex meshes, or give it as `Points`.

    Attributes:
        vertices: (V, 3) m.
        faces: (F, 3) the vertices of each triangle; None if only the vertices are known.
    """

    vertices: Array
    faces: IntArray | None

    def __init__(self, vertices: ArrayLike, faces: ArrayLike | None = None):
        """A mesh.

        Args:
            vertices: (V, 3) m.
            faces: (F, 3) the vertices of each triangle. They have to close: a mesh with holes is a part of a body.

        Raises:
            InputError: Vertices in one plane, or faces with holes.
        """
        vertices = matrix("vertices", vertices, 3)
        if not 4 <= len(vertices) <= MAX_MESH_VERTICES:
            raise InputError(f"vertices: expected 4 to {MAX_MESH_VERTICES} vertices, got {len(vertices)}")
        _check_extent("vertices", vertices)
        singular = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
        if singular[2] <= _MIN_THICKNESS * singular[0]:
            raise InputError(
                "vertices: all of them are in one plane; armctl.Box has a thickness, or give armctl.Points a radius"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", None if faces is None else _closed_faces(faces, len(vertices)))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], scale: float = 1.0) -> Mesh:
        """The mesh of a file.

        Args:
            path: An STL, OBJ or MSH file.
            scale: m for each unit of the file: 0.001 for millimetres.

        Raises:
            InputError: Another kind of file, no such file, one that MuJoCo cannot read, or a mesh with holes.
        """
        import mujoco

        scale = number("scale", scale, 1e-9, 1e9)
        if not isinstance(path, (str, os.PathLike)) or Path(path).suffix.lower() not in _MESH_FILES:
            raise InputError(f"path: {shown(path)} is not the path of a file of the kinds {', '.join(_MESH_FILES)}")
        if not Path(path).is_file():
            raise InputError(f"path: {path}: no such file")
        spec = mujoco.MjSpec()
        spec.add_mesh(name="mesh", file=str(Path(path).resolve()), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        try:
            model = spec.compile()
        except ValueError as error:
            raise InputError(f"path: MuJoCo cannot read {path}: {str(error).splitlines()[0]:.200}") from None
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
        vertices = model.mesh_pos[0] + model.mesh_vert.astype(np.float64) @ rotation.reshape(3, 3).T
        return cls(scale * vertices, model.mesh_face.astype(np.int64))


@dataclass(frozen=True, eq=False, init=False)
class Points:
    """A cloud of points, each of which is a ball, as a depth camera gives them.

    Attributes:
        points: (N, 3) m.
        radius: m, of each ball. Half the spacing of the points times the root of 2 leaves no hole in a surface.
    """

    points: Array
    radius: float

    def __init__(self, points: ArrayLike, radius: float = 0.0):
        """A cloud.

        Args:
            points: (N, 3) m.
            radius: m, of each ball.

        Raises:
            InputError: No points, more than a million, points that are not finite or more than 10 km away.
        """
        object.__setattr__(self, "points", _point_rows(points, MAX_POINTS))
        object.__setattr__(self, "radius", number("radius", radius, 0.0, MAX_LENGTH_M))

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def on_grid(cls, points: ArrayLike, spacing: float, radius: float = 0.0) -> Points:
        """One ball for each cube of a grid that has points, so large that all balls of that cube are in it.

        Args:
            points: (N, 3) m, any number of them.
            spacing: m, the edge of the cubes.
            radius: m, of the balls that are given.

        Returns:
            The cloud of the centres of the cubes, whose radius is larger by half the diagonal of a cube.

        Raises:
            InputError: Points that are not finite, none, or of too many cubes.
        """
        spacing = number("spacing", spacing, MIN_SIZE_M, MAX_LENGTH_M)
        rows = _point_rows(points, MAX_GIVEN_POINTS)
        cells = np.unique(np.floor(rows / spacing).astype(np.int64), axis=0)
        return cls((cells + 0.5) * spacing, number("radius", radius, 0.0, MAX_LENGTH_M) + 0.5 * math.sqrt(3.0) * spacing)


Shape: TypeAlias = Box | Ball | Cylinder | Mesh | Points


def _length(what: str, value: float) -> float:
    length = number(what, value)
    if not MIN_SIZE_M <= length <= MAX_LENGTH_M:
        raise InputError(f"{what}: expected a length from {MIN_SIZE_M:g} m to {MAX_LENGTH_M:g} m, got {length:g}")
    return length


def _check_extent(what: str, points: Array) -> None:
    farthest = float(np.abs(points).max())
    if farthest > MAX_LENGTH_M:
        raise InputError(f"{what}: one is {farthest:g} m away, at most {MAX_LENGTH_M:g} m; are they in millimetres?")


def _point_rows(value: ArrayLike, most: int) -> Array:
    """Checked points (N, 3), read-only."""
    given = as_array("points", value)
    if given.ndim != 2 or given.shape[1] != 3:
        raise InputError(f"points: expected rows of 3 numbers, (N, 3) m, got an array of shape {given.shape}")
    if len(given) == 0:
        raise InputError("points: the cloud is empty; World.remove(name) takes a body away")
    if len(given) > most:
        raise InputError(
            f"points: at most {most:,} fit into one cloud, got {len(given):,}; "
            "armctl.Points.on_grid(points, 0.005) keeps one for each cube of 5 mm"
        )
    if given.dtype.kind not in "fiu":
        raise InputError(f"points: {shown(value)} is not an array of numbers")
    points = np.array(given, np.float64)
    if not np.isfinite(points).all():
        bad = ~np.isfinite(points).all(axis=1)
        raise InputError(
            f"points: {int(bad.sum())} of {len(points)} are NaN or infinite, the first in row {int(bad.argmax())}; "
            "points[np.isfinite(points).all(axis=1)] has the others"
        )
    _check_extent("points", points)
    return frozen(points)


def _closed_faces(value: ArrayLike, count: int) -> IntArray:
    """Checked triangles (F, 3); InputError if an edge has another number of faces than two."""
    given = as_array("faces", value)
    if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "iu":
        raise InputError(f"faces: expected rows of 3 whole numbers, (F, 3), got {shown(value)}")
    faces = np.array(given, np.int64)
    if not len(faces) or faces.min() < 0 or faces.max() >= count:
        raise InputError(f"faces: expected numbers of vertices from 0 to {count - 1} in at least one face")
    edges = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    shared = np.unique(edges, axis=0, return_counts=True)[1]
    open_edges = int((shared % 2).sum())
    if open_edges:
        raise InputError(
            f"faces: the mesh has holes, {open_edges} edges with a face on one side only; armctl.Mesh(vertices) is the convex "
            "hull without regard to faces, armctl.Points(vertices, radius) the surface"
        )
    return frozen(faces)
