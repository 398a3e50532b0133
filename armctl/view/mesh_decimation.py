"""Mesh decimation: a model with few enough triangles that a page loads and draws it fast."""

import copy

import mujoco
import numpy as np

from armctl.report.render.stick_figure import drawn_geoms

# Of the model's extent: vertices in one cell become one. Coarse meshes are loaded first.
FINE_CELL = 5e-4
PLAIN_CELL = 5e-3  # for a browser without graphics card, which draws more pictures a second of these
COARSE_CELL = 1.2e-2
_HIDDEN_SITE_GROUP = 5
_CELL_KEY_WEIGHTS = np.array([1 << 42, 1 << 21, 1])  # makes one integer of three cell indices below 2^21


def decimated(model: mujoco.MjModel, cell: float = FINE_CELL, hidden_body: int = -1) -> mujoco.MjModel:
    """A copy for drawing, without collision shapes, sites, hulls and the geoms of one body.

    Vertices are clustered in cells of `cell` times the extent (Rossignac and Borrel, 1993).
    """
    model = copy.copy(model)
    hidden = ~drawn_geoms(model) | (model.geom_bodyid == hidden_body)
    model.geom_rgba[hidden, 3] = 0.0
    model.site_group[:] = _HIDDEN_SITE_GROUP
    model.mesh_polynum[:] = 0
    for mesh in np.unique(model.geom_dataid[~hidden & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))]):
        _cluster_vertices(model, mesh, cell * model.stat.extent)
    return model


def _cluster_vertices(model: mujoco.MjModel, mesh: int, cell_size: float) -> None:
    """Merges all vertices in a cell of the grid into one, and removes the triangles that become degenerate."""
    first_vertex = model.mesh_vertadr[mesh]
    first_face = model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[first_vertex : first_vertex + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]]
    texture_faces = model.mesh_facetexcoord[first_face : first_face + model.mesh_facenum[mesh]]
    cells = ((vertices - vertices.min(axis=0)) / cell_size).astype(np.int64) @ _CELL_KEY_WEIGHTS
    _, kept, cell_of_vertex = np.unique(cells, return_index=True, return_inverse=True)
    merged = cell_of_vertex[faces]
    solid = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    kept_faces = int(solid.sum())
    model.mesh_vert[first_vertex : first_vertex + len(kept)] = vertices[kept]
    model.mesh_vertnum[mesh] = len(kept)
    model.mesh_face[first_face : first_face + kept_faces] = merged[solid]
    model.mesh_facetexcoord[first_face : first_face + kept_faces] = texture_faces[solid]
    model.mesh_facenum[mesh] = kept_faces
