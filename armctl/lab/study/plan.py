"""StudyPlan: what a study consists of, and its runs, as plain data."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from armctl.core.atomic import file_path
from armctl.core.errors import InputError, UnknownNameError
from armctl.core.file_reading import read_bytes, reading
from armctl.core.target import TOLERANCE
from armctl.core.validation import choice, instance, integer, number, shown
from armctl.lab.study.factors import MAX_RUNS, SAMPLINGS, design_points, factor_table, read_factor
from armctl.lab.study.study_runner import CONTROLLER_FACTOR, OTHER_FACTORS, PLANT_FACTORS, StudyRun, StudyRunner, versions
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

_NAME = re.compile(r"[\w.+-]{1,100}")
_DISTANCE_RAD = 0.6  # of the motion "out-and-back"
_MAX_FILE_BYTES = 10_000_000


@dataclass(frozen=True, eq=False)
class StudyPlan:
    """What a study consists of, as plain data. `Study` documents it and makes the runs.

    Attributes:
        name: Names the study and its files.
        robot: The arguments of `load`.
        controllers: The controllers by label, each a dict of "controller" and its arguments.
        motion: The motion: its "kind", and what that kind needs.
        factors: The factors by name, each a tuple of values, a `Range`, a `Normal` or a `Choice`.
        repeats: The number of runs at each point.
        samples: The number of samples of the distributions among the factors.
        sampling: "sobol", "lhs" or "saltelli".
        dwell: s to hold the end of the motion.
        tolerance: m, the largest distance at which the tip is at its goal.
    """

    name: str
    robot: Any
    controllers: Any = ("pd-gravity", "computed-torque")
    motion: Any = "out-and-back"
    factors: Mapping[str, Any] = field(default_factory=dict)
    repeats: int = 1
    samples: int = 64
    sampling: str = "sobol"
    seed: int = 0
    dwell: float = 0.25
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        instance("name", self.name, str, "'payload' is one")
        if not _NAME.fullmatch(self.name):
            raise InputError(f"name: expected letters, digits and . _ + - (it names files), got {shown(self.name)}")
        instance("factors", self.factors, Mapping, "{'payload': armctl.Range(0, 2)} is one")
        checked = {
            "robot": _robot(self.robot),
            "controllers": _controllers(self.controllers),
            "motion": _motion(self.motion),
            "factors": {_factor_name(name): read_factor(name, value) for name, value in self.factors.items()},
            "repeats": integer("repeats", self.repeats, 1, MAX_RUNS),
            "samples": integer("samples", self.samples, 1, MAX_RUNS),
            "sampling": choice("sampling", self.sampling, SAMPLINGS),
            "seed": integer("seed", self.seed, 0),
            "dwell": number("dwell", self.dwell, 0.0),
            "tolerance": number("tolerance", self.tolerance, 0.0),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if (self.motion["kind"] == "reach") != ("target" in self.factors):
            raise InputError("motion: 'reach' and the factor 'target' belong together; give both or neither")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """A study from plain data, as `to_dict` gives it.

        Args:
            values: The arguments by name. A distribution is a dict: {"low", "high"}, {"mean", "std"} or {"values"}.

        Raises:
            InputError: A name or a value is wrong.
            UnknownNameError: There is no such argument.
        """
        instance("study", values, Mapping, "Study.to_dict() returns one")
        known = set(cls.__dataclass_fields__)
        unknown = sorted(set(values) - known, key=str)
        if unknown:
            raise UnknownNameError.from_known("entry of a study", str(unknown[0]), sorted(known))
        missing = [name for name in ("name", "robot") if name not in values]
        if missing:
            raise InputError(f"study: there is no {missing[0]!r}")
        return cls(**values)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """Reads a study from a .toml file whose entries are the arguments of `Study`.

        Args:
            path: The file. The paths in it are relative to its folder.

        Raises:
            InputError: The file cannot be read, or an entry is wrong.
        """
        path = file_path("path", path, (".toml",))
        with reading(path, "no valid TOML"):
            values = tomllib.loads(read_bytes(path, _MAX_FILE_BYTES).decode())
        for name in ("robot", "motion"):
            value = values.get(name)
            if isinstance(value, str) and (path.parent / value).is_file():
                values[name] = str(path.parent / value)
        try:
            return cls.from_dict(values)
        except (InputError, UnknownNameError) as error:
            raise InputError(f"{path!s:.160}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """The study as plain data, for JSON."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        values["factors"] = {name: factor_table(factor) for name, factor in self.factors.items()}
        return json.loads(json.dumps(values))

    @cached_property
    def runs(self) -> tuple[StudyRun, ...]:
        """All runs, in the order of the table.

        Raises:
            InputError: There are too many, or the number of samples does not fit the sampling.
            ArmctlError: The robot cannot be loaded.
        """
        points = design_points(self.factors, self.samples, self.sampling, self.seed)
        count = len(points) * self.repeats * len(self.controllers)
        if count > MAX_RUNS:
            raise InputError(f"repeats: the study would have {count} runs, at most {MAX_RUNS} are possible")
        shared = json.dumps([{**self.setup, "controllers": None}])
        specs = {label: json.dumps(_with_source(spec)) for label, spec in self.controllers.items()}
        found = []
        for point in points:
            described = json.dumps(point, sort_keys=True)
            noise = json.dumps({k: v for k, v in point.items() if not k.startswith(CONTROLLER_FACTOR)}, sort_keys=True)
            for repeat in range(self.repeats):
                seed = int(_digest(self.name, str(self.seed), noise, str(repeat))[:8], 16)
                for label, spec in specs.items():
                    key = _digest(shared, label, spec, described, str(repeat), str(seed))
                    found.append(StudyRun(key, label, point, repeat, seed))
        return tuple(found)

    @property
    def run_count(self) -> int:
        """The number of runs, without loading the robot."""
        points = design_points(self.factors, self.samples, self.sampling, self.seed)
        return len(points) * self.repeats * len(self.controllers)

    @cached_property
    def runner(self) -> StudyRunner:
        """The arm and everything else that the runs share, loaded in this process."""
        return StudyRunner({**self._plain_setup, "controllers": self.controllers})

    @cached_property
    def setup(self) -> dict[str, Any]:
        """What the runs share, as plain data for workers; `model` tells whether they load the same robot."""
        return {**self._plain_setup, "controllers": self.controllers, "model": self.runner.digest, "versions": versions()}

    @property
    def _plain_setup(self) -> dict[str, Any]:
        return {"robot": self.robot, "motion": self.motion, "dwell": self.dwell, "tolerance": self.tolerance}


def _digest(*parts: str) -> str:
    return hashlib.blake2b("\0".join(parts).encode(), digest_size=16).hexdigest()


def _robot(value: Any) -> dict[str, Any]:
    robot = dict(value) if isinstance(value, Mapping) else {"robot": value}
    for name, each in robot.items():
        if isinstance(each, os.PathLike):
            robot[name] = os.fspath(each)
    given = robot.get("robot")
    if not isinstance(given, str):
        raise InputError(f"robot: expected a name, a file or a dict of the arguments of load, got {shown(value)}")
    if os.path.isfile(given):
        robot["robot"] = os.path.abspath(given)
    return robot


def _controllers(value: Any) -> dict[str, dict[str, Any]]:
    """The controllers by label, each as a dict of "controller" and its arguments."""
    if isinstance(value, str):
        value = (value,)
    if isinstance(value, Mapping):
        labelled = dict(value)
    elif isinstance(value, Sequence) and all(isinstance(each, str) for each in value):
        labelled = {each: each for each in value}
    else:
        raise InputError(f"controllers: expected names, or a dict of labels and names with arguments, got {shown(value)}")
    out = {}
    for label, spec in labelled.items():
        spec = {"controller": spec} if isinstance(spec, str) else spec
        if not isinstance(label, str) or not isinstance(spec, Mapping) or not isinstance(spec.get("controller"), str):
            raise InputError(
                f"controllers: {shown(label)}: expected a dict such as {{'controller': 'pd', 'damping': 9}}, got {shown(spec)}"
            )
        try:
            out[label] = json.loads(json.dumps(dict(spec)))
        except (TypeError, ValueError):
            raise InputError(f"controllers: {label:.80}: expected numbers, texts and lists, got {shown(spec)}") from None
    if not out:
        raise InputError("controllers: expected at least one, such as ['pd', 'computed-torque'], got none")
    return out


def _with_source(spec: Mapping[str, Any]) -> dict[str, Any]:
    """A controller and, if it is one of the user's own, the digest of its module: a changed one makes other runs."""
    module = spec["controller"].partition(":")[0] if ":" in spec["controller"] else ""
    found = importlib.util.find_spec(module) if module else None
    if found is None or found.origin is None or not os.path.isfile(found.origin):
        return dict(spec)
    return {**spec, "source": hashlib.blake2b(Path(found.origin).read_bytes(), digest_size=16).hexdigest()}


def _motion(value: Any) -> dict[str, Any]:
    if isinstance(value, Mapping) and value.get("kind") == "trajectory":
        return dict(value)
    if isinstance(value, Mapping) and value.get("kind") == "out-and-back":
        return {"kind": "out-and-back", "distance": number("motion: distance", value.get("distance", _DISTANCE_RAD))}
    if value == "out-and-back":
        return {"kind": "out-and-back", "distance": _DISTANCE_RAD}
    if value == "reach" or value == {"kind": "reach"}:
        return {"kind": "reach"}
    if isinstance(value, (str, os.PathLike)) and Path(value).suffix == ".npz":
        value = JointTrajectory.load(value)
    if not isinstance(value, JointTrajectory):
        raise InputError(f"motion: expected 'out-and-back', 'reach', a .npz file or a JointTrajectory, got {shown(value)}")
    return {
        "kind": "trajectory",
        "joint_names": list(value.joint_names),
        "knots": value.knots.tolist(),
        "coefficients": value.coefficients.tolist(),
    }


def _factor_name(name: Any) -> str:
    known = [*PLANT_FACTORS, *OTHER_FACTORS]
    if not isinstance(name, str) or not (name in known or name.startswith(CONTROLLER_FACTOR)):
        raise UnknownNameError.from_known("factor", name, known)
    return name
