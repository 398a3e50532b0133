"""SRDF, the file beside a URDF that names pairs of links that may touch, groups of joints, and configurations such as home."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from armctl.core.errors import ArmctlError, ModelError
from armctl.core.file_reading import shown_path
from armctl.model.loading.urdf_file import UrdfFile, model_bytes, parse_xml

# Names under which MoveIt and Pinocchio's packages store the configuration that a robot starts from; the first found is used.
_HOME_STATES = ("home", "ready", "half_sitting", "standing")
_FOLDERS = (".", "../srdf", "../config")  # where packages keep the SRDF, from the folder of the URDF
_QPOS_SIZES = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}


@dataclass(frozen=True, eq=False)
class Srdf:
    """What an SRDF says about a robot."""

    path: Path
    disabled: frozenset[tuple[str, str]]  # the pairs of links whose contacts are switched off, each sorted by name
    groups: dict[str, tuple[str, str]]  # the base link and the tip link of each group that is a chain
    # Positions of joints, rad or m, in each named state; those of several groups are merged
    states: dict[str, dict[str, float]]

    @property
    def home(self) -> tuple[str, dict[str, float]] | None:
        """The name and the positions of the state that is taken as home; None if there is none."""
        return next(((name, self.states[name]) for name in _HOME_STATES if name in self.states), None)


def find_srdf(urdf: UrdfFile) -> Srdf | None:
    """The SRDF that belongs to a URDF: of the same file name, or else the only one nearby of the same robot name."""
    folders = [(urdf.path.parent / folder).resolve() for folder in _FOLDERS]
    stem = urdf.path.stem.removesuffix(".urdf")
    for folder in folders:
        same_name = folder / f"{stem}.srdf"
        if same_name.is_file():
            return read_srdf(same_name)
    found = []
    for path in (path for folder in folders if folder.is_dir() for path in sorted(folder.glob("*.srdf"))):
        try:
            root = parse_xml(model_bytes(path), path)
        except ArmctlError:
            continue  # of another robot, perhaps; only a file of the right name must be readable
        if root.get("name") and root.get("name") == urdf.root.get("name"):
            found.append(path)
    return read_srdf(found[0]) if len(found) == 1 else None


def read_srdf(path: Path) -> Srdf:
    """Reads an SRDF; ModelError if it is none."""
    root = parse_xml(model_bytes(path), path)
    if root.tag != "robot":
        raise ModelError(f"{shown_path(path)}: no SRDF: its first element is <{root.tag:.40}>, not <robot>")
    disabled = {_pair(element) for element in root.iter("disable_collisions")}
    enabled = {_pair(element) for element in root.iter("enable_collisions")}
    groups = {}
    for group in root.findall("group"):
        chain = group.find("chain")
        if chain is not None:
            groups[group.get("name", "")] = (chain.get("base_link", ""), chain.get("tip_link", ""))
    states: dict[str, dict[str, float]] = {}
    for state in root.findall("group_state"):
        positions = states.setdefault(state.get("name", "").lower(), {})
        positions.update(_positions(state, path))
    return Srdf(path=path, disabled=frozenset(disabled - enabled), groups=groups, states=states)


def apply_srdf(spec: mujoco.MjSpec, srdf: Srdf) -> list[str]:
    """Excludes the contacts that an SRDF disables and makes its home the keyframe `home`, in place; a sentence for each.

    What it says about links and joints that the robot does not have is left out.
    """
    bodies = {body.name for body in spec.bodies}
    present = {tuple(sorted((exclude.bodyname1, exclude.bodyname2))) for exclude in spec.excludes}
    pairs = [pair for pair in sorted(srdf.disabled) if set(pair) <= bodies and pair not in present and pair[0] != pair[1]]
    for first, second in pairs:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    notes = [f"{shown_path(srdf.path)}: contacts of {len(pairs)} pairs of links left out"] if pairs else []
    home = srdf.home
    has_home = any(key.name == "home" for key in spec.keys)
    if home is not None and not has_home:
        name, positions = home
        spec.add_key(name="home", qpos=_qpos(spec, positions))
        notes.append(f"{shown_path(srdf.path)}: home is its state {name!r:.40}")
    return notes


def _pair(element: ElementTree.Element) -> tuple[str, str]:
    first, second = sorted((element.get("link1", ""), element.get("link2", "")))
    return first, second


def _positions(state: ElementTree.Element, path: Path) -> Iterator[tuple[str, float]]:
    """The joints of a state that have one position, and that position."""
    for joint in state.findall("joint"):
        name = joint.get("name", "")
        texts = joint.get("value", "").split()
        if len(texts) != 1:
            continue  # of a floating base, which has seven
        try:
            value = float(texts[0])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ModelError(f"{shown_path(path)}: joint {name!r:.80}: its position {texts[0]!r:.40} is not a finite number")
        yield name, value


def _qpos(spec: mujoco.MjSpec, positions: dict[str, float]) -> np.ndarray:
    """(nq,) the whole model with some joints at given positions and the others as they are drawn."""
    parts: list[list[float]] = []
    for body in _depth_first(spec.worldbody):
        for joint in body.joints:
            size = _QPOS_SIZES.get(joint.type, 1)
            if size == 1:
                parts.append([positions.get(joint.name, float(joint.ref))])
            elif size == 4:
                parts.append([1.0, 0.0, 0.0, 0.0])
            else:
                parts.append([*body.pos, *body.quat])
    return np.array([x for part in parts for x in part])


def _depth_first(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """A body and those behind it in the order in which MuJoCo numbers them."""
    yield body
    for child in body.bodies:
        yield from _depth_first(child)
