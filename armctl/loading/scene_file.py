"""SceneFile: a scene in an MJCF file, to be put around a robot."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.loading.catalog import Source
from armctl.mjmodel.edit import copy_options
from armctl.mjmodel.queries import actuator_name

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
        self._spec, _ = source.read()
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
