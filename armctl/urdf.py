"""What MuJoCo leaves out of a URDF: motors, speed limits, and meshes that are found by package or in formats it cannot read."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

from armctl.elements import Chain, joint_name
from armctl.motors import JointData

_READABLE = (".stl", ".obj", ".msh")


def read_urdf(path: Path) -> tuple[mujoco.MjSpec, list[str]]:
    """A URDF as a specification with a motor on each joint that has one of its own.

    Every link stays a body, so that tool frames keep their names. Meshes serve collisions only; one that cannot be had is
    left out, since kinematics and dynamics do not need it.

    Args:
        path: The file.

    Returns:
        The specification, and what was left out, one sentence each.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    root = ElementTree.parse(path).getroot()
    notes = _find_meshes(spec, path, root)
    followers = {joint.get("name") for joint in root.iter("joint") if joint.find("mimic") is not None}
    for joint in spec.joints:
        is_scalar = joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        if is_scalar and joint.name not in followers:
            spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    return spec, notes


def speed_limits(path: Path, model: mujoco.MjModel, joints: Chain) -> JointData | None:
    """The speed limits of a URDF, which MuJoCo does not keep.

    Args:
        path: The file.
        model: The model compiled from it.
        joints: The chain.

    Returns:
        The limits; None where a joint has none, or the file is no URDF.
    """
    if path.suffix.lower() != ".urdf":
        return None
    limits = {j.get("name"): j.find("limit") for j in ElementTree.parse(path).getroot().iter("joint")}
    given = [limits.get(joint_name(model, joint)) for joint in joints]
    speeds = np.array([float(limit.get("velocity", 0)) if limit is not None else 0.0 for limit in given])
    return JointData("URDF", v_max=speeds) if np.all(speeds > 0) else None


def _find_meshes(spec: mujoco.MjSpec, path: Path, root: ElementTree.Element) -> list[str]:
    """Points each mesh to its file, or takes it out; says which were taken out."""
    names = [mesh.get("filename") or "" for mesh in root.iter("mesh")]
    wanted = {Path(name).name: name for name in names}
    notes = []
    for mesh in list(spec.meshes):
        file = Path(mesh.file).name
        found = _locate(path, wanted.get(file) or mesh.file)
        if found is not None and found.suffix.lower() in _READABLE:
            mesh.file = str(found)
            continue
        why = "not found" if found is None else f"MuJoCo reads {', '.join(_READABLE)}, not {found.suffix}"
        notes.append(f"collision mesh {file!r} left out: {why}")
        for geom in list(spec.geoms):
            if geom.meshname == mesh.name:
                spec.delete(geom)
        spec.delete(mesh)
    return notes


def _locate(path: Path, name: str) -> Path | None:
    """A mesh by its path or by its ROS package: package://name/rest is sought in every folder above the URDF."""
    package, _, rest = name.removeprefix("package://").removeprefix("model://").partition("/")
    tails = (Path(package, rest), Path(rest or package)) if "://" in name and "file://" not in name else ()
    direct = Path(name.removeprefix("file://"))
    candidates = [path.parent / direct, path.parent / direct.name]
    candidates += [folder / tail for folder in path.resolve().parents for tail in tails]
    return next((candidate for candidate in candidates if candidate.is_file()), None)
