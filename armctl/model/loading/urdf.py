"""What MuJoCo leaves out of a URDF: motors, speed limits, and meshes that it does not find."""

import copy
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.note import Note
from armctl.core.validation import Array, shown
from armctl.model.loading.inertias import correct_inertias, inferred_inertias
from armctl.model.loading.joint_limits import JointData, default_speed
from armctl.model.loading.urdf_file import UrdfFile
from armctl.model.mjmodel.queries import joint_name
from armctl.model.mjmodel.transmissions import Transmission

_RIGID = (0.9999, 0.9999, 0.001, 0.5, 2.0)  # MuJoCo's solimp
_MAX_NAMED_MESHES = 6  # in a note
_NOT_FOUND = "not found"
_READABLE = (".stl", ".obj", ".msh")
_DENSITY_KG_M3 = 1000.0


class Description(NamedTuple):
    """A robot as it was read."""

    spec: mujoco.MjSpec
    notes: list[str]  # what was left out, one sentence each
    unread: frozenset[str] = frozenset()  # the bodies whose shapes are in the file, and could not be read
    drawn: frozenset[str] = frozenset()  # the bodies that the file draws by a visual shape that can be read


def read_urdf(file: UrdfFile, *, visual: bool = False) -> Description:
    """A URDF as a specification with a motor on each joint that has one of its own.

    Every link stays a body, so that tool frames keep their names. Meshes are used for collisions only; one that cannot be
    read is left out, because kinematics and dynamics do not need it. With `visual`, links without a shape for collisions that
    can be read have the geoms that the file draws them with; these do not collide.
    """
    root = file.root
    if visual:
        spec = _with_visual_geoms(file)
    else:
        spec = mujoco.MjSpec.from_file(str(file.path)) if file.text is None else mujoco.MjSpec.from_string(file.text)
    spec.compiler.fusestatic = False
    notes, unread = _find_meshes(spec, file.path, root)
    unread |= _only_drawn(spec, root)
    notes = [*file.notes, *notes, *correct_inertias(spec), *inferred_inertias(spec)]
    followers = {joint.get("name") for joint in root.findall("joint") if joint.find("mimic") is not None}
    for mimic in spec.equalities:  # as rigid as MuJoCo allows: a URDF's mimic joints do not give way
        mimic.solref = (2 * spec.option.timestep, 1.0)
        mimic.solimp = _RIGID
    for joint in spec.joints:
        is_scalar = joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        if is_scalar and joint.name not in followers:
            spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    return Description(spec, notes, frozenset(unread), _drawn_links(file))


def speed_limits(file: UrdfFile | None, model: mujoco.MjModel, transmissions: Sequence[Transmission]) -> JointData | None:
    """The speed limits of a URDF, which MuJoCo does not keep; the default for a joint that has none. None if none has one."""
    if file is None:
        return None
    elements = {joint.get("name", ""): joint for joint in file.root.findall("joint")}  # transmissions name them too
    given = {name: joint.find("limit") for name, joint in elements.items()}
    names = {joint: joint_name(model, joint) for each in transmissions for joint in each.coupled}
    speeds = {joint: _speed(name, given.get(name)) for joint, name in names.items()}
    if not any(speed > 0 for speed in speeds.values()):
        return None
    missing = [names[joint] for joint, speed in speeds.items() if speed <= 0]
    speeds = {joint: speed if speed > 0 else default_speed(model, joint) for joint, speed in speeds.items()}
    v_max = np.array([min(speeds[joint] / abs(mimic.ratio) for joint, mimic in each.coupled.items()) for each in transmissions])
    source = f"URDF; default for {', '.join(missing)}" if missing else "URDF"
    near_ends = _limits_near_ends(elements, [names[each.joint] for each in transmissions])
    return JointData(source, v_max, has_defaults=bool(missing), **near_ends)


def _limits_near_ends(elements: Mapping[str, ElementTree.Element], names: Sequence[str]) -> dict[str, Array]:
    """What `position_based_velocity_limits` of joints say, as Franka's URDF of the FR3 has them; empty without any."""
    found = [elements[name].find("position_based_velocity_limits") if name in elements else None for name in names]
    if not any(each is not None for each in found):
        return {}
    defaults = {"deceleration_limit": np.inf, "velocity_offset": 0.0}
    values = {
        key: np.array([_number(name, key, each, default) for name, each in zip(names, found, strict=True)])
        for key, default in defaults.items()
    }
    for key, is_wrong in (
        ("deceleration_limit", ~(values["deceleration_limit"] > 0.0)),
        ("velocity_offset", ~((values["velocity_offset"] >= 0.0) & np.isfinite(values["velocity_offset"]))),
    ):
        if is_wrong.any():
            i = int(is_wrong.argmax())
            raise ModelError(f"joint {names[i]!r}: its {key} {values[key][i]:g} must be a positive number; correct the URDF")
    return values


def _number(joint: str, key: str, element: ElementTree.Element | None, default: float) -> float:
    """A number of an element; the default where there is none."""
    text = None if element is None else element.get(key)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError:
        raise ModelError(f"joint {joint!r}: its {key} {text!r} is not a number") from None


def _speed(joint: str, limit: ElementTree.Element | None) -> float:
    """A joint's speed limit; 0 if it has none."""
    text = "0" if limit is None else limit.get("velocity", "0")
    try:
        speed = float(text)
    except ValueError:
        raise ModelError(f"joint {joint!r}: its velocity limit {text!r} is not a number") from None
    return speed if math.isfinite(speed) else 0.0


def _with_visual_geoms(file: UrdfFile) -> mujoco.MjSpec:
    """The specification with the visual geoms of links whose shapes for collisions cannot be read."""
    root = copy.deepcopy(file.root)
    for link in root.findall("link"):
        if any(_is_readable(file.path, shape) for shape in link.findall("collision")):
            for drawn in link.findall("visual"):
                link.remove(drawn)
    extension = root.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    compiler.set("discardvisual", "false")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    for geom in spec.geoms:
        geom.density = _DENSITY_KG_M3  # as shapes for collisions have it; it counts only for links without an inertial
    return spec


def _drawn_links(file: UrdfFile) -> frozenset[str]:
    """The links that a file draws by a shape that can be read."""
    return frozenset(
        link.get("name", "")
        for link in file.root.findall("link")
        if any(_is_readable(file.path, shape) for shape in link.findall("visual"))
    )


def _is_readable(path: Path, shape: ElementTree.Element) -> bool:
    """Whether an element <collision> or <visual> has a geometry that MuJoCo can read."""
    if shape.find("geometry") is None:
        return False
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return True
    found = _locate(path, mesh.get("filename") or "")
    return found is not None and not _unreadable(found)


def _only_drawn(spec: mujoco.MjSpec, root: ElementTree.Element) -> set[str]:
    """The moving links that a URDF draws, without a shape for collisions and without a mass from which one could see them."""
    moving = {body.name for body in spec.bodies if body.joints}
    return {
        name
        for link in root.findall("link")
        if (name := link.get("name", "")) in moving
        and link.find("visual") is not None
        and link.find("collision") is None
        and link.find("inertial") is None
    }


def _find_meshes(spec: mujoco.MjSpec, path: Path, root: ElementTree.Element) -> tuple[list[str], set[str]]:
    """Points each mesh to its file, or removes it: one sentence for each reason of removal, and the bodies that lost shapes."""
    bodies: set[str] = set()
    names = [mesh.get("filename") or "" for mesh in root.iter("mesh")]
    by_file = {Path(name).name: name for name in names}
    left_out: dict[str, list[str]] = {}
    for mesh in list(spec.meshes):
        file = Path(mesh.file).name
        found = _locate(path, by_file.get(file) or mesh.file)
        reason = _NOT_FOUND if found is None else _unreadable(found)
        if found is not None and not reason:
            mesh.file = str(found.resolve())
            continue
        left_out.setdefault(reason, []).append(file)
        for geom in list(spec.geoms):
            if geom.meshname == mesh.name:
                if geom.contype:  # it is no visual geom
                    bodies.add(geom.parent.name)
                spec.delete(geom)
        spec.delete(mesh)
    notes: list[str] = []
    for reason, files in left_out.items():
        different = [shown(file) for file in dict.fromkeys(files)]
        more = f" and {len(different) - _MAX_NAMED_MESHES} more" if len(different) > _MAX_NAMED_MESHES else ""
        noun = "mesh" if len(different) == 1 else "meshes"
        names = ", ".join(different[:_MAX_NAMED_MESHES])
        advice = f"{'copy the meshes beside the file, or ' if reason == _NOT_FOUND else ''}convert them to .stl or .obj"
        notes.append(Note(f"collision {noun} {names}{more} left out: {reason:.240}", advice))
    return notes, bodies


def _unreadable(mesh: Path) -> str:
    """Why MuJoCo cannot use a mesh; empty if it can."""
    if mesh.suffix.lower() not in _READABLE:
        return f"MuJoCo reads {', '.join(_READABLE)}, not {mesh.suffix}"
    probe = mujoco.MjSpec()
    probe.add_mesh(name="mesh", file=str(mesh))
    probe.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    try:
        probe.compile()
    except ValueError as error:
        return " ".join(str(error).split()).partition(" Element name")[0]
    return ""


def _locate(path: Path, name: str) -> Path | None:
    """The file of a mesh by its path or its ROS package: package://name/rest is searched in every folder above the URDF."""
    package, _, rest = name.removeprefix("package://").removeprefix("model://").partition("/")
    tails = (Path(package, rest), Path(rest or package)) if "://" in name and "file://" not in name else ()
    direct = Path(name.removeprefix("file://"))
    candidates = [path.parent / direct, path.parent / direct.name]
    candidates += [folder / tail for folder in path.resolve().parents for tail in tails]
    return next((candidate for candidate in candidates if candidate.is_file()), None)
