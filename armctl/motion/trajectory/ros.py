"""Motions as ROS messages of type trajectory_msgs/JointTrajectory, in JSON and YAML files."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armctl.core.atomic import file_path, write_text
from armctl.core.errors import InputError, import_extra
from armctl.core.file_reading import read_bytes, reading
from armctl.core.validation import Array, integer, number, shown, vector
from armctl.motion.trajectory.piecewise import Pieces, Samples, hermite, standing

ENDINGS = (".json", ".yaml", ".yml")
_MAX_BYTES = 200_000_000
_MAX_SECONDS = 1e6
_MAX_VALUE = 1e9  # SI units; more is a damaged number


class Waypoints(NamedTuple):
    """The points of a message in the order of its joints: times (T,) s from 0, positions, and the rates if it contains them."""

    joint_names: tuple[str, ...]
    times: Array
    q: Array
    v: Array | None
    a: Array | None


def message(joint_names: Sequence[str], times: Array, samples: Samples) -> dict[str, Any]:
    """The message as nested tables and lists, as `rosidl_runtime_py.set_message_fields` takes it."""
    points = []
    for time, q, v, a in zip(times.tolist(), *(column.tolist() for column in samples), strict=True):
        nanoseconds = round(1e9 * time)
        stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        points.append({"positions": q, "velocities": v, "accelerations": a, "effort": [], "time_from_start": stamp})
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": list(joint_names), "points": points}


def save(path: str | os.PathLike[str], content: Mapping[str, Any]) -> Path:
    path = file_path("path", path, ENDINGS)
    if path.suffix == ".json":
        write_text(path, json.dumps(content) + "\n")
    else:
        write_text(path, _yaml().safe_dump(dict(content), sort_keys=False, default_flow_style=None))
    return path


def load(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    """Reads a message from .json or .yaml; of several YAML documents, as `ros2 topic echo` prints them, the first."""
    path = file_path("path", path, ENDINGS)
    with reading(path, f"no {path.suffix[1:].upper()}"):
        text = read_bytes(path, _MAX_BYTES).decode()
        return json.loads(text) if path.suffix == ".json" else _first_document(text)


def _first_document(text: str) -> Any:
    yaml = _yaml()
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    if "*" in text and any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, loader)):
        raise InputError("it has an alias, with which a few lines can stand for billions of numbers; write the numbers")
    return next(iter(yaml.load_all(text, loader)), None)


def _yaml() -> Any:
    return import_extra("yaml", "YAML files need PyYAML", "ros")


def waypoints(content: object) -> Waypoints:
    """The points of a message; raises InputError for whatever is no JointTrajectory."""
    names = content.get("joint_names") if isinstance(content, Mapping) else None
    points = content.get("points") if isinstance(content, Mapping) else None
    if not isinstance(names, Sequence) or isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise InputError("message: it is not a JointTrajectory, since it has no list of joint_names")
    if not isinstance(points, Sequence) or isinstance(points, str) or not points:
        raise InputError("message: it is not a JointTrajectory, since it has no points")
    if len(set(names)) < len(names):
        raise InputError("message: joint_names: a name is given twice")
    times = np.array([_seconds(k, _entry(k, point, "time_from_start")) for k, point in enumerate(points)])
    if (np.diff(times) <= 0.0).any():
        k = int((np.diff(times) <= 0.0).argmax()) + 1
        raise InputError(f"message: point {k}: its time_from_start, {times[k]:g} s, is not after that of the point before")
    table = {
        kind: [_entry(k, point, kind) for k, point in enumerate(points)]
        for kind in ("positions", "velocities", "accelerations")
    }
    v = _rates("velocities", table["velocities"], len(names))
    a = None if v is None else _rates("accelerations", table["accelerations"], len(names))
    return Waypoints(tuple(names), times - times[0], _rows("positions", table["positions"], len(names)), v, a)


def pieces(points: Waypoints) -> Pieces:
    """A motion through the points that is continuous in position, velocity and acceleration.

    Accelerations that the message does not contain are, at each point, the mean of those of the cubics on both sides, and 0 at
    the ends. Without velocities, the motion is the cubic spline that starts and ends at rest.
    """
    if len(points.times) == 1:
        return standing(points.q[0])
    v = points.v
    if v is None:
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(points.times, points.q, bc_type="clamped")
        return hermite(points.times, points.q, spline(points.times, 1), spline(points.times, 2))
    a = _accelerations(points.times, points.q, v) if points.a is None else points.a
    return hermite(points.times, points.q, v, a)


def _accelerations(t: Array, q: Array, v: Array) -> Array:
    h = np.diff(t)[:, None]
    slope = np.diff(q, axis=0) / h
    at_start = (6 * slope - 4 * v[:-1] - 2 * v[1:]) / h  # of the cubic Hermite polynomial
    at_end = (-6 * slope + 2 * v[:-1] + 4 * v[1:]) / h
    out = np.zeros_like(q)
    out[1:-1] = 0.5 * (at_end[:-1] + at_start[1:])
    return out


def _entry(k: int, point: object, name: str) -> Any:
    if not isinstance(point, Mapping):
        raise InputError(f"message: point {k}: {shown(point)} is not a table")
    return point.get(name, ())


def _rates(name: str, rows: list[Any], n: int) -> Array | None:
    """The rows, or None if every row is empty; a message leaves out what it does not know."""
    if all(isinstance(row, Sequence) and not row for row in rows):
        return None
    return _rows(name, rows, n)


def _rows(name: str, rows: list[Any], n: int) -> Array:
    table = np.array([vector(f"message: point {k}: {name}", row, n) for k, row in enumerate(rows)])
    if (np.abs(table) > _MAX_VALUE).any():
        raise InputError(f"message: {name}: a number is above {_MAX_VALUE:g}; expected rad or m, and seconds")
    return table


def _seconds(k: int, stamp: object) -> float:
    what = f"message: point {k}: time_from_start"
    if not isinstance(stamp, Mapping):
        raise InputError(f"{what}: expected a stamp with sec and nanosec, got {shown(stamp)}")
    whole = number(f"{what}: sec", stamp.get("sec", stamp.get("secs", 0)), 0.0, _MAX_SECONDS)
    return whole + 1e-9 * integer(f"{what}: nanosec", stamp.get("nanosec", stamp.get("nsecs", 0)), 0, 999_999_999)
