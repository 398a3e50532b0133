"""Shapes are checked when they are made, and do not change afterwards."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from armctl import Ball, Box, Cylinder, InputError, Mesh, Points
from armctl.core.shapes import MAX_POINTS

TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
CUBE_OBJ = """
v 0 0 0
v 100 0 0
v 0 100 0
v 0 0 100
f 1 3 2
f 1 2 4
f 2 3 4
"""


def test_shapes_hold_what_was_given_and_do_not_change():
    box = Box([0.1, 0.2, 0.3])
    assert box.size.tolist() == [0.1, 0.2, 0.3]
    assert (Ball(0.1).radius, Cylinder(0.1, 0.2).length) == (0.1, 0.2)
    given = np.zeros((5, 3))
    cloud = Points(given, 0.01)
    given[:] = 1.0
    assert len(cloud) == 5
    assert not cloud.points.any()
    for array in (box.size, cloud.points, Mesh(TETRAHEDRON).vertices):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0.0
    with pytest.raises(AttributeError):
        box.size = np.ones(3)  # type: ignore[misc]


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "a box without a height": (lambda: Box([0.1, 0.1, 0.0]), r"size: expected a length from 1e-06 m to 10000 m, got 0"),
    "a box of two edges": (lambda: Box([0.1, 0.1]), "size: expected 3 numbers, got 2"),
    "a ball inside out": (lambda: Ball(-0.1), "radius: expected a length from .*, got -0.1"),
    "a ball of NaN": (lambda: Ball(math.nan), "radius: expected a finite number, got nan"),
    "a cylinder without a length": (lambda: Cylinder(0.1, 0.0), "length: expected a length from .*, got 0"),
    "a mesh of a triangle": (lambda: Mesh(TETRAHEDRON[:3]), "vertices: expected 4 to .* vertices, got 3"),
    "a flat mesh": (lambda: Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), "vertices: all of them are in one plane"),
    "a mesh with a hole": (lambda: Mesh(TETRAHEDRON, FACES[:3]), "faces: the mesh has holes, 3 edges with a face on one side"),
    "a face of no vertices": (lambda: Mesh(TETRAHEDRON, [[0, 1, 4]]), "faces: expected numbers of vertices from 0 to 3"),
    "a file of another kind": (lambda: Mesh.from_file("cup.step"), "path: 'cup.step' is not the path of a file of the kinds"),
    "a file that is not there": (lambda: Mesh.from_file("no_such_cup.stl"), "path: no_such_cup.stl: no such file"),
    "no points": (lambda: Points(np.empty((0, 3))), "points: the cloud is empty; World.remove"),
    "points of NaN": (
        lambda: Points([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]),
        "points: 1 of 2 are NaN or infinite, the first in row 1; points.np.isfinite",
    ),
    "columns of points": (lambda: Points(np.zeros((3, 5))), r"points: expected rows of 3 numbers, .* shape \(3, 5\)"),
    "points in micrometres": (lambda: Points([[5e5, 0.0, 0.0]]), "points: one is 500000 m away, .*millimetres"),
    "words for points": (lambda: Points([["a", "b", "c"]]), "points: .* is not an array of numbers"),
    "too many points": (lambda: Points(np.zeros((MAX_POINTS + 1, 3))), "points: at most 1,000,000 fit into .* got 1,000,001"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_shape_is_one_clear_sentence(name):
    make, message = WRONG[name]
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert len(str(caught.value)) <= 400


def test_a_mesh_is_read_in_the_units_of_its_file_and_in_its_frame(tmp_path):
    path = tmp_path / "corner.obj"
    path.write_text(CUBE_OBJ + "f 1 4 3\n")
    mesh = Mesh.from_file(path, scale=1e-3)
    rounded = np.round(mesh.vertices, 6) + 0.0
    assert np.array_equal(np.unique(rounded, axis=0), np.unique(TETRAHEDRON, axis=0))
    path = tmp_path / "open.obj"
    path.write_text(CUBE_OBJ)
    with pytest.raises(InputError, match="the mesh has holes"):
        Mesh.from_file(path, scale=1e-3)


def test_a_cloud_on_a_grid_covers_every_ball_that_was_given():
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.2, 0.2, (2000, 3))
    cloud = Points.on_grid(points, 0.05, radius=0.01)
    assert len(cloud) <= 9**3
    nearest = np.linalg.norm(points[:, None] - cloud.points, axis=2).min(axis=1)
    assert (nearest + 0.01 <= cloud.radius + 1e-12).all()
