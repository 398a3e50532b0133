"""SceneParts: tables, obstacles and loose objects around a robot, in its MuJoCo model."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.core.shapes import Points
from armctl.model.collision.world_snapshot import HasSnapshot, WorldBody, WorldLike, WorldSnapshot, read_world
from armctl.model.loading.catalog import Source
from armctl.model.mjmodel.edit import copy_options
from armctl.model.mjmodel.queries import actuator_name
from armctl.model.mjmodel.shape_geoms import add_shape

_LOOSE_COLOR = (0.85, 0.45, 0.2, 1.0)  # rgba
_FIXED_COLOR = (0.6, 0.6, 0.65, 1.0)
_MAX_TIMESTEP_S = 1e-3  # in a scene with loose objects
_STIFF_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
_FRICTION_RATIO = 10.0  # stiffness of friction relative to contact, so that a held object does not creep
# What refers to what by name.
_REFERENCES = (
    ("pairs", ("geomname1", "geomname2"), "geoms"),
    ("excludes", ("bodyname1", "bodyname2"), "bodies"),
    ("equalities", ("name1", "name2"), "equalities"),
)
_CONTACT = ("solref", "solimp", "condim", "priority")
_DEFAULT = mujoco.MjSpec().default.geom


class SceneFile:
    """The bodies, geoms and joints of an MJCF file; what has a joint moves: a loose body, a door, a drawer."""

    def __init__(self, path: str | os.PathLike[str]):
        """Reads a scene; ModelError if MuJoCo cannot, or if it holds a robot."""
        if not isinstance(path, (str, os.PathLike)) or Path(path).suffix.lower() not in (".xml", ".mjcf"):
            raise InputError(
                f"scene: {path!r} is neither a World nor the path of an .xml file; "
                "armctl.World().add('box', armctl.Box([0.1, 0.1, 0.1]), [0.5, 0, 0.05]) is a world"
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
        self.moves = model.njnt > 0  # whether anything in it does

    def build(self, spec: mujoco.MjSpec, contact: Mapping[str, object]) -> None:
        """Adds everything in it to a specification, except options, sensors and keyframes: the robot's are used.

        `contact` has parameters of geoms that move, for which the file keeps MuJoCo's defaults.
        """
        child = self._spec.copy()
        for element in [*child.keys, *child.sensors]:
            child.delete(element)
        for body in child.bodies[1:]:
            if _moves(body):
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


def _moves(body: mujoco.MjsBody) -> bool:
    """Whether a joint moves a body."""
    return bool(body.joints) or (body.parent is not None and body.parent.name != "world" and _moves(body.parent))


def _has_default_contact(geom: mujoco.MjsGeom) -> bool:
    return all(np.array_equal(getattr(geom, name), getattr(_DEFAULT, name)) for name in _CONTACT)


ScenePart: TypeAlias = WorldLike | str | os.PathLike[str]


class SceneParts:
    """What stands and lies around a robot, as `load` takes it: worlds, as they are now, and MJCF files."""

    def __init__(self, *parts: ScenePart):
        """The parts. In worlds, bodies with a mass are loose; in files, those with a free joint, and others may have joints.

        Raises:
            InputError: A world has points or an attached body, which physics cannot have, or a part is neither.
            ModelError: MuJoCo cannot read a file, or it holds a robot.
        """
        self._bodies: list[WorldBody] = []
        self._files: list[SceneFile] = []
        for part in parts:
            if isinstance(part, (HasSnapshot, WorldSnapshot)):
                snapshot = read_world(part)
                self._bodies += () if snapshot is None else map(_checked, snapshot.bodies.values())
            else:
                self._files.append(SceneFile(part))

    def build(self, spec: mujoco.MjSpec) -> None:
        """Adds everything to a specification; InputError if the model has a body or a geom of the same name already."""
        names = [*(name for file in self._files for name in file.bodies), *(body.name for body in self._bodies)]
        taken = {body.name for body in spec.bodies}
        counts = Counter(names)
        for name in names:
            if name in taken or counts[name] > 1:
                raise InputError(f"scene: the model has a body {name!r} already; choose another name")
        geoms = {geom.name for geom in spec.geoms}
        for body in self._bodies:
            if body.name in geoms:
                raise InputError(f"scene: the model has a geom {body.name!r} already; choose another name")
        if any(body.mass is not None for body in self._bodies) or any(file.moves for file in self._files):
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
        for file in self._files:
            file.build(spec, gripped)
        for each in self._bodies:
            assert each.shape is not None
            body = spec.worldbody.add_body(name=each.name, pos=each.pose.position, quat=each.pose.quat)
            if each.mass is None:
                add_shape(spec, body, each.name, each.shape, rgba=_FIXED_COLOR, **collides)
                continue
            body.add_freejoint(name=each.name)
            add_shape(spec, body, each.name, each.shape, rgba=_LOOSE_COLOR, mass=each.mass, **gripped, **collides)


def _checked(body: WorldBody) -> WorldBody:
    """A body that physics can have."""
    if body.tip is not None:
        raise InputError(f"scene: {body.name:.60} is attached to a tip; attach it in the world of the simulation")
    if isinstance(body.shape, Points):
        raise InputError(
            f"scene: {body.name:.60} is a cloud of points, which has no physics; add it to the world of the simulation"
        )
    return body


SceneLike: TypeAlias = SceneParts | ScenePart | list[ScenePart] | tuple[ScenePart, ...]


def read_scene(scene: SceneLike) -> SceneParts:
    """The argument `scene` of `load`."""
    if isinstance(scene, SceneParts):
        return scene
    return SceneParts(*scene) if isinstance(scene, (list, tuple)) else SceneParts(scene)
