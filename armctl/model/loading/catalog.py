"""From a name to a file: the bundled arm, a robot of MuJoCo Menagerie, or a path."""

from __future__ import annotations

import os
import socket
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import getproxies
from xml.parsers import expat

import mujoco

from armctl.core.errors import ArmctlError, InputError, ModelError, UnknownNameError
from armctl.core.file_reading import shown_path
from armctl.core.validation import shown
from armctl.model.loading.datasheets import ALIASES, BY_CATEGORY, BY_ROBOT, ROWS, Row
from armctl.model.loading.inertias import correct_inertias
from armctl.model.loading.urdf import Description, read_urdf
from armctl.model.loading.urdf_file import UrdfFile, is_urdf, read_urdf_file

if TYPE_CHECKING:
    import mujoco_menagerie as menagerie

import importlib
import importlib.util
import pkgutil
import re

BUNDLED = "robot_arm_3dof"
_CONNECT_TIMEOUT_S = 3.0  # for the server of MuJoCo Menagerie
_ENDINGS = (".xml", ".mjcf", ".urdf", ".xacro", ".sdf", ".usd", ".usda", ".usdc", ".usdz")
_CONVERTERS = {
    ".sdf": "sdformat2mjcf (pip install sdformat-mjcf)",
    ".usd": "usd_to_urdf (pip install nvidia-srl-usd-to-urdf)",
}
_REFERRING = ("actuators", "sensors", "equalities", "tendons", "pairs", "excludes", "keys", "skins")
_DEFAULT_ARENA_BYTES = 16 << 20  # for contacts and constraints
_BODIES_OF_DEFAULT_ARENA = 1000
_FEW_PIXELS = 8  # width of a texture that nothing is drawn with
_MUJOCO_ERRORS = (ValueError, OSError, mujoco.FatalError, mujoco.UnexpectedError)
_MISMATCHED_TAG = 7  # expat's XML_ERROR_TAG_MISMATCH
_PACKAGE = "robot_descriptions"
_NAME = re.compile(r"\w+_description")
_PATHS = ("MJCF_PATH", "URDF_PATH", "XACRO_PATH")  # an MJCF says most


@dataclass(frozen=True, eq=False)
class Source:
    """Where a robot's description is."""

    name: str  # what the arm will be called
    path: Path | None  # its MJCF or URDF file; None for a specification
    row: Row | None = None  # its data-sheet row, or None
    spec: mujoco.MjSpec | None = None  # a specification that a caller gave; None for a file

    @cached_property
    def urdf(self) -> UrdfFile | None:
        """The file as XML if it is a URDF or a xacro, else None; ModelError if it is one and cannot be read."""
        return read_urdf_file(self.path) if self.path is not None and is_urdf(self.path) else None

    def read(self, *, visual: bool = False) -> Description:
        """The description as a new specification; ModelError if it is none. `visual` is that of `read_urdf`."""
        if self.path is None:
            copied = self.copied_spec()
            return Description(copied, correct_inertias(copied))
        try:
            if self.urdf is not None:
                return read_urdf(self.urdf, visual=visual)
            spec = mujoco.MjSpec.from_file(str(self.path))
            return Description(spec, correct_inertias(spec))
        except _MUJOCO_ERRORS as error:
            if "'mujocoinclude'" in str(error):
                raise ModelError(f"{self._label}: a part of an MJCF; load the file that includes it") from None
            raise ModelError(f"{self._label}: MuJoCo cannot read it: {_xml_fault(self.path) or _one_line(error)}") from None

    def compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """The model of a specification that was read from here; ModelError if MuJoCo cannot compile it."""
        memory = arena_bytes(len(spec.bodies))
        if memory:
            spec.memory = max(spec.memory, memory)
        try:
            model = spec.compile()
            model.names.decode()
        except UnicodeDecodeError:
            raise ModelError(f"{self._label}: it has names that are not in UTF-8; save it as UTF-8") from None
        except _MUJOCO_ERRORS as error:
            raise ModelError(f"{self._label}: MuJoCo cannot compile it: {_one_line(error)}") from None
        return model

    def compile_without_textures(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """As `compile`, but generated textures have few pixels: with meshes in the cache they take most of the time."""
        generated = [texture for texture in spec.textures if texture.builtin != mujoco.mjtBuiltin.mjBUILTIN_NONE]
        sizes = [(texture.width, texture.height) for texture in generated]
        for texture in generated:
            texture.width = _FEW_PIXELS
            texture.height = _FEW_PIXELS
        try:
            return self.compile(spec)
        finally:
            for texture, (width, height) in zip(generated, sizes, strict=True):
                texture.width = width
                texture.height = height

    def copied_spec(self) -> mujoco.MjSpec:
        """A copy of the caller's specification. MjSpec.copy silently drops elements that refer to others that do not exist."""
        assert self.spec is not None
        copy = self.spec.copy()
        for kind in _REFERRING:
            if len(getattr(copy, kind)) != len(getattr(self.spec, kind)):
                raise ModelError(f"{self.name}: one of its {kind} refers to an element that the specification does not have")
        return copy

    @property
    def _label(self) -> str:
        return shown_path(self.path) if self.path is not None else self.name


def arena_bytes(bodies: int) -> int:
    """The memory that MuJoCo needs to search contacts among some bodies; 0 if its default is enough.

    MuJoCo reserves room for all pairs of bodies twice, an int each: 4 bytes times the square of the number (measured with
    MuJoCo 3: `maxuse_arena` is 64.8 MB for 4000 bodies, 402 MB for 10 000). Only what is used takes memory of the machine.
    """
    return 4 * bodies**2 + _DEFAULT_ARENA_BYTES if bodies > _BODIES_OF_DEFAULT_ARENA else 0


def locate(robot: str | os.PathLike[str] | mujoco.MjSpec, *, tool: bool = False) -> Source:
    """Where the description of a robot is; downloads a Menagerie robot on first use. Errors as those of `armctl.load`.

    A tool to be mounted on an arm comes without the scene that Menagerie shows it in.
    """
    if isinstance(robot, mujoco.MjSpec):
        spec: mujoco.MjSpec = robot
        return Source(spec.modelname or "model", None, spec=spec)
    if not isinstance(robot, (str, os.PathLike)) or not os.fspath(robot):
        example = "tool='robotiq_2f85'" if tool else "armctl.load('panda')"
        raise InputError(f"{'tool' if tool else 'robot'}: {shown(robot)} is neither a name nor a path; try {example}")
    given = os.fspath(robot)
    if not isinstance(given, str):
        raise InputError(f"{'tool' if tool else 'robot'}: {shown(robot)} is a path in bytes; give it as text")
    if given.lower().endswith(_ENDINGS) or isinstance(robot, os.PathLike):
        path = Path(given)
        if not os.path.isfile(path):
            raise ModelError(f"{shown_path(path)}: no such file")
        _refuse_other_formats(path)
        return Source(path.stem.removesuffix(".urdf"), path)
    if given == BUNDLED:
        return Source(given, bundled_models() / f"{BUNDLED}.xml")
    if is_description_name(given):
        return Source(given, description_file(given))
    return _in_menagerie(given, tool)


def _refuse_other_formats(path: Path) -> None:
    """Refuses the formats that MuJoCo cannot read, and names a converter."""
    ending = path.suffix.lower()[:4]
    if ending in _CONVERTERS:
        format_name = ending[1:].upper()
        raise ModelError(
            f"{shown_path(path)}: MuJoCo reads no {format_name}; convert it first, for example by {_CONVERTERS[ending]}"
        )


def bundled_models() -> Path:
    """The folder of the models that come with armctl, in a checkout as in an installed package."""
    package = resources.files("armctl")
    installed = package / "models"
    return Path(str(installed if installed.is_dir() else package / ".." / "models")).resolve()


def _in_menagerie(given: str, tool: bool) -> Source:
    """A robot of MuJoCo Menagerie by its name, an alias, or name/entry point."""
    import mujoco_menagerie as menagerie

    family, _, entry = given.partition("/")
    name = ALIASES.get(family, family)
    if name not in menagerie.names():
        raise _unknown(given, tool)
    row = menagerie.get(name)
    if entry and entry not in row.entry_names:
        raise UnknownNameError.from_known(f"entry point of {name}", entry, row.entry_names)
    try:
        _check_network(row)
        path = row.xml(entry or (row.default_model if tool else row.default_scene))
    except (menagerie.MenagerieError, OSError) as error:
        raise ModelError(
            f"{given}: its model is not installed ({_one_line(error)}); with a network run `mujoco-menagerie prefetch {name}`, "
            f"or set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie; {BUNDLED!r} comes with armctl"
        ) from None
    if not path.is_file():
        raise ModelError(f"{given}: {shown_path(path)} does not exist; this copy of MuJoCo Menagerie is older than its index")
    return Source(given, path, ROWS.get(name))


def _unknown(given: str, tool: bool) -> ArmctlError:
    """The error for a name that is no robot's."""
    import mujoco_menagerie as menagerie

    path = Path(given)
    if os.path.isfile(path):
        return ModelError(f"{shown_path(path)}: the name of a model ends in .xml or .urdf")
    if os.path.isdir(path):
        return ModelError(f"{shown_path(path)}: a folder, not an .xml or .urdf file")
    if tool:
        return UnknownNameError.from_known("tool", given, [r.name for r in menagerie.robots("end_effector")])
    return UnknownNameError.from_known("robot", given, [BUNDLED, *ALIASES, *menagerie.names()], "`armctl robots`")


def robots() -> dict[str, str]:
    """All robots that `load` finds by name, sorted, the bundled one first, and what armctl can do with them.

    Downloads nothing.
    """
    import mujoco_menagerie as menagerie

    short = {name: alias for alias, name in ALIASES.items()}
    ability = {r: BY_ROBOT.get(r.name, BY_CATEGORY.get(r.category, "see armctl chains")) for r in menagerie.robots()}
    known = {short.get(r.name, r.name): f"{r.display_name}: {text}" for r, text in ability.items()}
    return {BUNDLED: "bundled, the tutorial's: an arm: load"} | dict(sorted(known.items()))


def datasheet_of(name: str) -> Row | None:
    """The data sheet of a robot by a name of the catalog, with or without an entry point; None if there is none."""
    robot = name.partition("/")[0]
    return ROWS.get(ALIASES.get(robot, robot))


def installed_robots() -> list[str]:
    """The names in MuJoCo Menagerie of the robots that need no download, and the bundled arm's."""
    import mujoco_menagerie as menagerie

    cache = menagerie.Cache()
    known = menagerie.robots()
    return [BUNDLED, *(r.name for r in known if ((cache.root / r.name).is_dir() if cache.root else cache.is_cached(r)))]


def _check_network(robot: menagerie.Robot) -> None:
    """Raises at once if a robot that is not installed cannot be downloaded; the download itself would retry for seconds."""
    import mujoco_menagerie as menagerie

    cache = menagerie.Cache()
    server = urlsplit(cache.base_url)
    if cache.root or cache.is_cached(robot) or getproxies() or not server.hostname:
        return
    port = server.port or {"http": 80}.get(server.scheme, 443)
    try:
        socket.create_connection((server.hostname, port), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise OSError(f"{cache.base_url}: {error}") from None


def _one_line(error: Exception) -> str:
    """The first 200 characters of a message, in one line."""
    return f"{' '.join(str(error).split()):.200}"


def _xml_fault(path: Path) -> str:
    """Where a file is no well-formed XML, in plain words; empty if it is."""
    try:
        ElementTree.parse(path)
    except ElementTree.ParseError as error:
        line, column = error.position
        what = expat.ErrorString(error.code)
        if error.code == _MISMATCHED_TAG:
            what = f"an element before it is not closed: each <body> needs a </body> ({what})"
        return f"no well-formed XML, line {line}, column {column}: {what}"
    except (OSError, ValueError, LookupError):
        return ""
    return ""


def is_description_name(name: str) -> bool:
    """Whether a name has the form that names of robot_descriptions have, such as "panda_mj_description"."""
    return _NAME.fullmatch(name) is not None


def description_file(name: str) -> Path:
    """The file of a robot by its name in robot_descriptions; downloaded on first use."""
    package = importlib.util.find_spec(_PACKAGE)
    if package is None:
        raise ModelError(
            f"{name:.80}: a name of the package robot_descriptions, which is not installed: `pip install {_PACKAGE}`"
        )
    known = [
        module.name for module in pkgutil.iter_modules(package.submodule_search_locations) if is_description_name(module.name)
    ]
    if name not in known:
        raise UnknownNameError.from_known("robot of robot_descriptions", name, known)
    try:
        module = importlib.import_module(f"{_PACKAGE}.{name}")
    except Exception as error:  # importing it clones a repository, which can fail in any way
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ModelError(f"{name}: robot_descriptions cannot provide it: {reason:.200}") from None
    found = [getattr(module, path) for path in _PATHS if hasattr(module, path)]
    if not found:
        raise ModelError(f"{name}: robot_descriptions has neither an MJCF nor a URDF of it")
    path = Path(found[0])
    if not path.is_file():
        raise ModelError(f"{name}: robot_descriptions says that its file is {path}, which does not exist")
    return path
