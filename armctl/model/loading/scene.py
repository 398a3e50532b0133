"""Scene: tables, obstacles and loose objects around a robot."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, ModelError
from armctl.core.pose import Pose
from armctl.core.shapes import Ball, Box, Cylinder, Mesh
from armctl.core.tables import Table
from armctl.core.validation import Array, instance, number, vector
from armctl.model.collision.world_snapshot import WorldBody, WorldLike, read_world
from armctl.model.loading.catalog import Source
from armctl.model.mjmodel.edit import copy_options
from armctl.model.mjmodel.queries import actuator_name

_LOOSE_COLOR = (0.85, 0.45, 0.2, 1.0)  # rgba
_FIXED_COLOR = (0.6, 0.6, 0.65, 1.0)
_MAX_TIMESTEP_S = 1e-3  # in a scene with loose objects
_STIFF_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
_FRICTION_RATIO = 10.0  # stiffness of friction relative to contact, so that a held object does not creep
_MAX_SHOWN_NAMES = 6
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_BALL = mujoco.mjtGeom.mjGEOM_SPHERE
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
# What refers to what by name.
_REFERENCES = (
    ("pairs", ("geomname1", "geomname2"), "geoms"),
    ("excludes", ("bodyname1", "bodyname2"), "bodies"),
    ("equalities", ("name1", "name2"), "equalities"),
)
_CONTACT = ("solref", "solimp", "condim", "priority")
_DEFAULT = mujoco.MjSpec().default.geom


class SceneFile:
    """The bodies, geoms and joints of an MJCF file; what has a free joint is loose."""

    def __init__(self, path: str | os.PathLike[str]):
        """Reads a scene; ModelError if MuJoCo cannot, or if it holds a robot."""
        if not isinstance(path, (str, os.PathLike)) or Path(path).suffix.lower() not in (".xml", ".mjcf"):
            raise InputError(
                f"scene: {path!r} is neither a Scene nor the path of an .xml file; "
                "armctl.Scene().add_box('box', [0.1, 0.1, 0.1], [0.5, 0, 0.05]) is a scene"
            )
        if not Path(path).is_file():
            raise ModelError(f"scene: {path}: no such file")
        source = Source(Path(path).stem, Path(path))
        self._spec = source.read().spec
        self._prefix = f"{source.name}/"
        model = source.compile(self._spec)
        if model.nactuator or model.ntendon:
            what = f"the actuator {actuator_name(model, 0)!r}" if model.nactuator else "a tendon"
            raise ModelError(f"scene: {path} has {what}, so it is a robot; a scene has only bodies, geoms and joints")
        self.bodies = [body.name for body in self._spec.bodies[1:] if body.name]
        self.is_loose = bool((model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any())  # whether anything in it is loose

    def build(self, spec: mujoco.MjSpec, contact: Mapping[str, object]) -> None:
        """Adds everything in it to a specification, except options, sensors and keyframes: the robot's are used.

        `contact` has parameters of loose geoms for which the file keeps MuJoCo's defaults.
        """
        child = self._spec.copy()
        for element in [*child.keys, *child.sensors]:
            child.delete(element)
        for body in child.bodies[1:]:
            if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints):
                for geom in filter(_has_default_contact, body.geoms):
                    for name, value in contact.items():
                        setattr(geom, name, value)
        copy_options(spec, child)
        spec.attach(child, frame=spec.worldbody.add_frame(), prefix=self._prefix)
        names = {kind: self._own_names(getattr(spec, kind)) for kind in ("bodies", "geoms", "joints", "sites")}
        names["equalities"] = names["bodies"] | names["joints"] | names["sites"]
        for elements, attributes, kind in _REFERENCES:
            for element in getattr(spec, elements):
                for attribute in attributes:
                    name = getattr(element, attribute)
                    setattr(element, attribute, names[kind].get(name, name))

    def _own_names(self, elements: Iterable[Any]) -> dict[str, str]:
        """Removes the prefix from the elements' names unless the robot uses the same name; returns old to new names."""
        elements = list(elements)
        taken = {element.name for element in elements}
        renamed: dict[str, str] = {}
        for element in elements:
            before = element.name
            own = before.removeprefix(self._prefix)
            if before != own and own not in taken:
                element.name = own
                renamed[before] = own
        return renamed


def _has_default_contact(geom: mujoco.MjsGeom) -> bool:
    return all(np.array_equal(getattr(geom, name), getattr(_DEFAULT, name)) for name in _CONTACT)


@dataclass(frozen=True, eq=False)
class Item:
    """One object in a scene."""

    name: str
    shape: mujoco.mjtGeom  # its shape, as MuJoCo's geom type
    size: Array  # (3,) m (zero for a mesh), as MuJoCo's geom size: half of each edge, or radius and half the length
    pose: Pose  # T_world_item
    mass: float | None  # kg if it is loose; None if it stands fixed
    vertices: Array | None = None  # (V, 3) m, of a mesh in its own frame


class Scene:
    """The objects around a robot; `armctl.load(robot, scene=scene)` puts the robot among them.

    An object without a mass is fixed, such as a table; an object with a mass is loose. Each `add_...` returns the scene itself.

    Attributes:
        items: What was added to it, in order.
    """

    def __init__(self, file: str | os.PathLike[str] | None = None):
        """A scene.

        Args:
            file: The MJCF file it begins with, whose bodies with a free joint are loose; an empty scene if left out.

        Raises:
            InputError: The file is no path of an .xml file.
            ModelError: MuJoCo cannot read it, or it holds a robot.
        """
        self.items: list[Item] = []
        self._names: set[str] = set()
        self._file = None if file is None else SceneFile(file)

    @classmethod
    def of_world(cls, world: WorldLike) -> Scene:
        """The bodies of a world; those with a mass are loose.

        Args:
            world: A World, or a snapshot of one.

        Returns:
            What later changes of the world do not change.

        Raises:
            InputError: It has points or an attached body, which a simulation cannot have.
        """
        scene = cls()
        snapshot = read_world(world)
        for body in () if snapshot is None else snapshot.bodies.values():
            if body.tip is not None:
                raise InputError(f"scene: {body.name:.60} is attached to a tip; attach it in the world of the simulation")
            scene._add_body(body)
        return scene

    def _add_body(self, body: WorldBody) -> None:
        """Adds a body of a world that stands."""
        shape = body.shape
        if isinstance(shape, Box):
            self.add_box(body.name, shape.size, body.pose, body.mass)
        elif isinstance(shape, Ball):
            self.add_ball(body.name, shape.radius, body.pose, body.mass)
        elif isinstance(shape, Cylinder):
            self.add_cylinder(body.name, shape.radius, shape.length, body.pose, body.mass)
        elif isinstance(shape, Mesh):
            self._add(body.name, mujoco.mjtGeom.mjGEOM_MESH, np.zeros(3), body.pose, body.mass, shape.vertices)
        else:
            raise InputError(
                f"scene: {body.name:.60} is a cloud of points, which has no physics; add it to the world of the simulation"
            )

    def add_box(self, name: str, size: ArrayLike, at: Pose | ArrayLike, mass: float | None = None) -> Scene:
        """Adds a box.

        Args:
            size: (3,) m, its edges.
            at: T_world_box, or (3,) m where its centre is.
            mass: kg if it is loose; left out, it is fixed.

        Raises:
            InputError: A name twice, a size or a mass that is not positive.
        """
        return self._add(name, _BOX, 0.5 * _positive("size", vector("size", size, 3)), at, mass)

    def add_ball(self, name: str, radius: float, at: Pose | ArrayLike, mass: float | None = None) -> Scene:
        """Adds a ball.

        Args:
            radius: m.
            at: T_world_ball, or (3,) m where its centre is.
            mass: kg if it is loose; left out, it is fixed.
        """
        return self._add(name, _BALL, _positive("radius", vector("radius", [radius, 0, 0], 3), 1), at, mass)

    def add_cylinder(self, name: str, radius: float, length: float, at: Pose | ArrayLike, mass: float | None = None) -> Scene:
        """Adds a cylinder along its own z axis.

        Args:
            radius: m.
            length: m.
            at: T_world_cylinder, or (3,) m where its centre is.
            mass: kg if it is loose; left out, it is fixed.
        """
        half_length = number("length", length) / 2
        size = _positive("radius and length", vector("radius and length", [radius, half_length, 0], 3), 2)
        return self._add(name, _CYLINDER, size, at, mass)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Adds everything in it to a specification.

        Raises:
            InputError: It is no specification, or the model has a body or a geom of the same name already.
        """
        instance("spec", spec, mujoco.MjSpec, "mujoco.MjSpec.from_file reads one")
        names = [*(self._file.bodies if self._file else ()), *(item.name for item in self.items)]
        taken = {body.name for body in spec.bodies}
        counts = Counter(names)
        for name in names:
            if name in taken or counts[name] > 1:
                raise InputError(f"scene: the model has a body {name!r} already; choose another name")
        geoms = {geom.name for geom in spec.geoms}
        for item in self.items:
            if item.name in geoms:
                raise InputError(f"scene: the model has a geom {item.name!r} already; choose another name")
        if any(item.mass is not None for item in self.items) or (self._file and self._file.is_loose):
            spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
            spec.option.impratio = max(spec.option.impratio, _FRICTION_RATIO)
            spec.option.timestep = min(spec.option.timestep, _MAX_TIMESTEP_S)
        # The contact is as stiff as the time step allows. Fingers then do not sink in, and a held object hardly creeps in a
        # bend: MuJoCo's friction creeps at the centripetal acceleration x time constant / 2. With condim 4 an object held by
        # two fingers does not spin between them. With priority 1 these parameters hold for every gripper.
        gripped = {"solref": (2 * spec.option.timestep, 1.0), "solimp": _STIFF_SOLIMP, "condim": 4, "priority": 1}
        # Things collide with every shape of the robot, whichever bits its file uses.
        bits = reduce(or_, (geom.contype | geom.conaffinity for geom in spec.geoms), 1)
        collides = {"contype": bits, "conaffinity": bits}
        if self._file:
            self._file.build(spec, gripped)
        for item in self.items:
            body = spec.worldbody.add_body(name=item.name, pos=item.pose.position, quat=item.pose.quat)
            shape: dict[str, Any] = {"type": item.shape, "size": item.size}
            if item.vertices is not None:
                spec.add_mesh(name=item.name, uservert=item.vertices.ravel())
                shape = {"type": item.shape, "meshname": item.name}
            if item.mass is None:
                body.add_geom(name=item.name, rgba=_FIXED_COLOR, **shape, **collides)
                continue
            body.add_freejoint(name=item.name)
            loose = {"rgba": _LOOSE_COLOR, "mass": item.mass, **gripped, **collides}
            body.add_geom(name=item.name, **shape, **loose)

    def __repr__(self) -> str:
        names = [*(self._file.bodies if self._file else ()), *(item.name for item in self.items)]
        more = f" and {len(names) - _MAX_SHOWN_NAMES} more" if len(names) > _MAX_SHOWN_NAMES else ""
        return f"Scene({', '.join(f'{name:.60}' for name in names[:_MAX_SHOWN_NAMES])}{more})"

    def _repr_html_(self) -> str:
        rows = [
            [
                item.name,
                item.shape.name.removeprefix("mjGEOM_").lower(),
                ", ".join(f"{x:g}" for x in item.pose.position),
                "fixed" if item.mass is None else f"{item.mass:g} kg",
            ]
            for item in self.items
        ]
        rows += [[name, "from the file", "", ""] for name in (self._file.bodies if self._file else ())]
        return Table(["object", "shape", "at, m", "mass"], rows).html()

    def _add(
        self,
        name: str,
        shape: mujoco.mjtGeom,
        size: Array,
        at: Pose | ArrayLike,
        mass: float | None,
        vertices: Array | None = None,
    ) -> Scene:
        instance("name", name, str, "such as 'table'")
        if not name or name in self._names:
            raise InputError(f"name: {name!r} is empty or in the scene already; choose another")
        if mass is not None:
            number("mass", mass, 1e-6)
        pose = at if isinstance(at, Pose) else Pose(vector("at", at, 3))
        self._names.add(name)
        self.items.append(Item(name=name, shape=shape, size=size, pose=pose, mass=mass, vertices=vertices))
        return self


def _positive(what: str, value: Array, count: int = 3) -> Array:
    if np.any(value[:count] <= 0):
        raise InputError(f"{what}: expected lengths above 0 m, got {value[:count].tolist()}")
    return value
