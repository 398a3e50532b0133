"""Lighten: a model with no more triangles than a page shows, so that it is sent and drawn in no time."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

_GRID = 5e-4  # of the model's extent: corners of triangles nearer than this become one


def decimated(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy to draw: without collision shapes and sites, which MuJoCo does not draw by default either, its meshes simplified.

    Meshes are simplified by clustering their vertices on a grid (Rossignac and Borrel, 1993).

    Args:
        model: The model.

    Returns:
        The copy, its hulls left out.
    """
    model, hidden = copy.copy(model), model.geom_group > 2
    model.geom_rgba[hidden, 3] = 0.0
    model.site_group[:] = 5
    model.mesh_polynum[:] = 0
    for mesh in np.unique(model.geom_dataid[~hidden & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))]):
        _cluster(model, mesh, _GRID * model.stat.extent)
    return model


def _cluster(model: mujoco.MjModel, mesh: int, grid: float) -> None:
    """Makes one vertex of all in a cell of the grid, and leaves out the triangles that vanish."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices, corners = model.mesh_vert[first : first + count], model.mesh_face[start : start + faces]
    cells = ((vertices - vertices.min(axis=0)) / grid).astype(np.int64) @ np.array([1 << 42, 1 << 21, 1])
    _, kept, cell_of = np.unique(cells, return_index=True, return_inverse=True)
    merged = cell_of[corners]
    solid = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    kept_faces = int(solid.sum())
    model.mesh_vert[first : first + len(kept)], model.mesh_vertnum[mesh] = vertices[kept], len(kept)
    model.mesh_face[start : start + kept_faces], model.mesh_facenum[mesh] = merged[solid], kept_faces
    textured = model.mesh_facetexcoord[start : start + faces]
    model.mesh_facetexcoord[start : start + kept_faces] = textured[solid]
