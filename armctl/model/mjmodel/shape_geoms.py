"""Shapes of a world as geoms of MuJoCo, and how the mass of a uniform body is distributed in them."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from armctl.core.shapes import Ball, Box, Cylinder, Mesh, Shape
from armctl.core.validation import Array


class GeomForm(NamedTuple):
    """A shape as MuJoCo describes it."""

    kind: mujoco.mjtGeom
    size: Array  # (3,) m: half of each edge, or radius and half the length; zero for a mesh


def geom_form(shape: Shape) -> GeomForm:
    """The form of a shape other than points."""
    if isinstance(shape, Box):
        return GeomForm(mujoco.mjtGeom.mjGEOM_BOX, 0.5 * shape.size)
    if isinstance(shape, Ball):
        return GeomForm(mujoco.mjtGeom.mjGEOM_SPHERE, np.array([shape.radius, 0.0, 0.0]))
    if isinstance(shape, Cylinder):
        return GeomForm(mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([shape.radius, 0.5 * shape.length, 0.0]))
    assert isinstance(shape, Mesh)
    return GeomForm(mujoco.mjtGeom.mjGEOM_MESH, np.zeros(3))


def add_shape(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, shape: Shape, **options: Any) -> None:
    """Adds a shape other than points to a body, in the body's frame; a mesh becomes an asset of the geom's name."""
    form = geom_form(shape)
    if isinstance(shape, Mesh):
        spec.add_mesh(name=name, uservert=shape.vertices.ravel())
        body.add_geom(name=name, type=form.kind, meshname=name, **options)
    else:
        body.add_geom(name=name, type=form.kind, size=form.size, **options)


class MassDistribution(NamedTuple):
    """Where the mass of a body is, in the frame of its shape."""

    center: Array  # (3,) m
    inertia: Array  # (3, 3) kg m^2 about the center


def mass_distribution(shape: Shape, mass: float) -> MassDistribution:
    """That of a body of uniform density and a mass, kg, by MuJoCo."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="body")
    add_shape(spec, body, "body", shape, mass=mass)
    model = spec.compile()
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    R = axes.reshape(3, 3)
    return MassDistribution(model.body_ipos[1].copy(), R @ np.diag(model.body_inertia[1]) @ R.T)
