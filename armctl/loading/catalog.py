"""From a name to a file: the bundled arm, a robot of MuJoCo Menagerie, or a path."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import getproxies

import mujoco

from armctl.core.errors import InputError, ModelError, UnknownNameError
from armctl.loading.datasheets import ALIASES, BY_CATEGORY, BY_ROBOT, ROWS, Row
from armctl.loading.urdf import read_urdf

if TYPE_CHECKING:
    import mujoco_menagerie as menagerie

BUNDLED = "robot_arm_3dof"
_PATIENCE = 3.0  # s for the server of MuJoCo Menagerie to answer


@dataclass(frozen=True)
class Source:
    """Where a robot's description is.

    Attributes:
        name: What the arm will be called.
        path: Its MJCF or URDF file.
        row: Its data-sheet row, or None.
    """

    name: str
    path: Path
    row: Row | None = None

    def read(self) -> tuple[mujoco.MjSpec, list[str]]:
        """The description as a specification that can still be changed.

        Returns:
            The specification, and what was left out of it, one sentence each.

        Raises:
            ModelError: MuJoCo cannot read it.
        """
        try:
            if self.path.suffix.lower() == ".urdf":
                return read_urdf(self.path)
            return mujoco.MjSpec.from_file(str(self.path)), []
        except (ValueError, OSError) as error:
            raise ModelError(f"{self.path}: MuJoCo cannot read it: {_one_line(error)}") from None

    def compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """The model of a specification that was read from here.

        Args:
            spec: The specification.

        Returns:
            The model.

        Raises:
            ModelError: MuJoCo cannot compile it, or its names are not in UTF-8.
        """
        try:
            model = spec.compile()
            model.names.decode()
        except UnicodeDecodeError:
            raise ModelError(f"{self.path}: it has names that are not in UTF-8; save it as UTF-8") from None
        except (ValueError, OSError) as error:
            raise ModelError(f"{self.path}: MuJoCo cannot compile it: {_one_line(error)}") from None
        return model


def locate(name: str | os.PathLike[str], *, tool: bool = False) -> Source:
    """Where the description of a robot is; downloads a Menagerie robot on first use.

    Args:
        name: As for `armctl.load`.
        tool: Whether it is one to be mounted on an arm: it then comes bare, not in the scene that Menagerie has it in.

    Returns:
        The place.

    Raises:
        InputError: It is neither a name nor a path.
        UnknownNameError: No robot, or no tool, has that name.
        ModelError: There is no such file, or the robot could not be downloaded.
    """
    import mujoco_menagerie as menagerie

    if not isinstance(name, (str, os.PathLike)) or not os.fspath(name):
        example = "tool='robotiq_2f85'" if tool else "armctl.load('panda')"
        raise InputError(f"{'tool' if tool else 'robot'}: {name!r} is neither a name nor a path; try {example}")
    given = os.fspath(name)
    if given.lower().endswith((".xml", ".mjcf", ".urdf")) or isinstance(name, os.PathLike):
        path = Path(given)
        if not path.is_file():
            raise ModelError(f"{given}: no such file")
        return Source(path.stem, path)
    if given == BUNDLED:
        return Source(given, bundled_models() / f"{BUNDLED}.xml")
    family, _, entry = given.partition("/")
    robot = ALIASES.get(family, family)
    if robot not in menagerie.names():
        if Path(given).exists():
            raise ModelError(
                f"{given}: {'a folder' if Path(given).is_dir() else 'its name does not end in .xml or .urdf'}, no model"
            )
        if tool:
            raise UnknownNameError.of("tool", given, [r.name for r in menagerie.robots("end_effector")])
        raise UnknownNameError.of("robot", given, [BUNDLED, *ALIASES, *menagerie.names()], "`armctl robots`")
    row = menagerie.get(robot)
    if entry and entry not in row.entry_names:
        raise UnknownNameError.of(f"entry point of {robot}", entry, row.entry_names)
    try:
        _check_network(row)
        path = row.xml(entry or (row.default_model if tool else row.default_scene))
    except (menagerie.MenagerieError, OSError) as error:
        raise ModelError(
            f"{given}: its model is not at hand ({_one_line(error)}); with a network run `mujoco-menagerie prefetch {robot}`, "
            "or set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie"
        ) from error
    if not path.is_file():
        raise ModelError(f"{given}: {path} does not exist; this copy of MuJoCo Menagerie is older than its index")
    return Source(given, path, ROWS.get(robot))


def bundled_models() -> Path:
    """The folder of the models that come with armctl, in a checkout as in an installed package."""
    package = Path(str(files("armctl")))
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def robots() -> dict[str, str]:
    """Every robot that `load` knows by name, and what armctl can do with it; nothing is downloaded for that.

    Returns:
        Name, the alias where there is one, to a line of text: the bundled arm, then all of MuJoCo Menagerie.
    """
    import mujoco_menagerie as menagerie

    short = {name: alias for alias, name in ALIASES.items()}
    ability = {r: BY_ROBOT.get(r.name, BY_CATEGORY.get(r.category, "see armctl chains")) for r in menagerie.robots()}
    known = {BUNDLED: "bundled, the tutorial's: an arm: load"}
    return known | {short.get(r.name, r.name): f"{r.display_name}: {text}" for r, text in ability.items()}


def _check_network(robot: menagerie.Robot) -> None:
    """Finds out at once whether a robot that is not here can be downloaded: the download itself would try for seconds."""
    import mujoco_menagerie as menagerie

    cache = menagerie.Cache()
    server = urlsplit(cache.base_url)
    if cache.root or cache.is_cached(robot) or getproxies() or not server.hostname:
        return
    port = server.port or {"http": 80}.get(server.scheme, 443)
    try:
        socket.create_connection((server.hostname, port), timeout=_PATIENCE).close()
    except OSError as error:
        raise OSError(f"{cache.base_url}: {error}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
