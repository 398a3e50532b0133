"""Motions as ROS messages of type trajectory_msgs/JointTrajectory, in JSON and YAML files."""

import json
import numbers
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armctl.core.atomic import file_path, write_text
from armctl.core.defaults import MAX_FILE_VALUE
from armctl.core.errors import InputError, import_extra
from armctl.core.file_reading import read_bytes, reading
from armctl.core.validation import Array, integer, number, shown, vector
from armctl.plan.motion.trajectory.piecewise import JointSamples, Pieces, hermite, standing

ENDINGS = (".json", ".yaml", ".yml")
_MAX_BYTES = 200_000_000
_MAX_SECONDS = 1e6
_MAX_NESTING = 4  # of messages around a trajectory
_FLOATING = "multi_dof_joint_trajectory"
_SAME_TIME_S = 5e-10  # half of the unit of a stamp
_REPEATED = 1e-9  # rad, rad/s, ...: by which a repeated point, or a joint that stands, may differ
_SECONDS = ("sec", "secs")  # of ROS 2, of ROS 1
_NANOSECONDS = ("nanosec", "nsecs", "nsec")
# Rates and values of coarse points agree to a factor of two or so; degrees differ by 57, and milliseconds by 1000.
_MAX_RATE_RATIO = 10.0
_MIN_CHECKED_WAY = 0.1  # rad or m (rad/s or m/s): rates of less may be noise
_MIN_CHECKED_POINTS = 3
_PER_DEGREE = 57.3


class Waypoints(NamedTuple):
    """The points of a message in the order of its joints: times (T,) s from 0, positions, and the rates if it contains them."""

    joint_names: tuple[str, ...]
    times: Array
    q: Array
    v: Array | None
    a: Array | None


def message(joint_names: Sequence[str], times: Array, samples: JointSamples) -> dict[str, Any]:
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
    """The points of a message, or of the only one inside a message around it; InputError for whatever is no JointTrajectory."""
    content = _unwrapped(content)
    names = _as_list(content.get("joint_names"))
    points = _as_list(content.get("points"))
    if not isinstance(names, Sequence) or isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise InputError("message: it is not a JointTrajectory, since it has no list of joint_names")
    if not isinstance(points, Sequence) or isinstance(points, str) or not points:
        raise InputError("message: it is not a JointTrajectory, since it has no points")
    if len(set(names)) < len(names):
        raise InputError("message: joint_names: a name is given twice")
    times = np.array([_seconds(k, _entry(k, point, "time_from_start")) for k, point in enumerate(points)])
    table = {
        kind: [_entry(k, point, kind) for k, point in enumerate(points)]
        for kind in ("positions", "velocities", "accelerations")
    }
    v = _rates("velocities", table["velocities"], len(names))
    a = None if v is None else _rates("accelerations", table["accelerations"], len(names))
    return _distinct(Waypoints(tuple(names), times, _rows("positions", table["positions"], len(names)), v, a))


def _as_list(value: object) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _unwrapped(content: object) -> Mapping[str, Any]:
    """The JointTrajectory in a RobotTrajectory, a DisplayTrajectory, a goal of an action, or another message with only one."""
    found = list(_trajectories_in(content, _MAX_NESTING))
    if len(found) > 1:
        raise InputError(f"message: it has {len(found)} trajectories; give one of them, such as message['trajectory'][0]")
    if not found:
        raise InputError("message: it is not a JointTrajectory, since it has no list of joint_names")
    return found[0]


def _trajectories_in(content: object, depth: int) -> Iterator[Mapping[str, Any]]:
    if isinstance(content, Mapping):
        other = content.get(_FLOATING)
        if isinstance(other, Mapping) and other.get("points"):
            raise InputError(f"message: {_FLOATING}: it moves joints of several degrees of freedom, which an arm does not have")
        if "joint_names" in content:
            yield content
        elif depth > 0:
            for name, value in content.items():
                if name != _FLOATING:
                    yield from _trajectories_in(value, depth - 1)
    elif depth > 0 and isinstance(content, Sequence) and not isinstance(content, str):
        for value in content:
            yield from _trajectories_in(value, depth - 1)


def _distinct(points: Waypoints) -> Waypoints:
    """The points without those that repeat the one before: same time, same place, same rates. InputError for other times."""
    steps = np.diff(points.times)
    if len(steps) and not points.times.any():
        raise InputError("message: time_from_start is 0 in all points; armctl.move_through(arm, positions) chooses their times")
    keep = np.ones(len(points.times), dtype=bool)
    for k in np.flatnonzero(steps < _SAME_TIME_S) + 1:
        columns = [column for column in (points.q, points.v, points.a) if column is not None]
        repeats = abs(steps[k - 1]) < _SAME_TIME_S and all(
            np.abs(column[k] - column[k - 1]).max() <= _REPEATED for column in columns
        )
        if not repeats:
            raise InputError(
                f"message: point {k}: its time_from_start, {points.times[k]:g} s, is not after that of the point before; "
                "remove one of the two, or correct its time"
            )
        keep[k] = False
    rates = [None if column is None else column[keep] for column in (points.v, points.a)]
    return Waypoints(points.joint_names, points.times[keep] - points.times[0], points.q[keep], *rates)


def joint_order(points: Waypoints, joint_names: Sequence[str]) -> list[int]:
    """Where the joints of an arm are in a message. Others may be in it if they do not move, such as those of a gripper."""
    given = points.joint_names
    missing = [name for name in joint_names if name not in given]
    if missing:
        prefix = _common_prefix(given, joint_names)
        remedy = f"; remove the prefix {prefix!r:.60} from its names" if prefix else ""
        raise InputError(
            f"message: it is for the joints {', '.join(given):.120}, but the arm has {', '.join(joint_names):.120}{remedy}"
        )
    for k, name in enumerate(given):
        if name not in joint_names and np.ptp(points.q[:, k]) > _REPEATED:
            raise InputError(
                f"message: {name:.80} is no joint of the arm, and it moves by {np.ptp(points.q[:, k]):.3g}; remove it from "
                "joint_names and from each point, and move it by itself, such as sim.gripper.move(width)"
            )
    return [given.index(name) for name in joint_names]


def _common_prefix(given: Sequence[str], joint_names: Sequence[str]) -> str:
    """What stands before the arm's names in all of those names that end with them; empty if they differ."""
    prefixes = {name[: -len(own)] for own in joint_names for name in given if name.endswith(own) and len(name) > len(own)}
    return prefixes.pop() if len(prefixes) == 1 else ""


def check_rates(points: Waypoints) -> None:
    """Refuses velocities and accelerations that are not those of the positions, as numbers in degrees or milliseconds are."""
    if len(points.times) < _MIN_CHECKED_POINTS or points.v is None:
        return
    position_ways = np.ptp(points.q, axis=0)
    velocity_ways = _ways(points.times, points.v)
    _refuse_other_units(points.joint_names, "velocities", velocity_ways, "positions", position_ways)
    moving = position_ways > _MIN_CHECKED_WAY
    ratios = _PER_DEGREE * velocity_ways[moving] / position_ways[moving]
    if len(ratios) and (ratios > 0.5).all() and (ratios < 2.0).all():
        raise InputError(
            f"message: the positions move {1 / np.median(ratios / _PER_DEGREE):.3g} times as far as the velocities lead; are "
            "they degrees? messages of ROS have rad, rad/s and s, and may leave velocities out"
        )
    if points.a is not None:
        _refuse_other_units(
            points.joint_names, "accelerations", _ways(points.times, points.a), "velocities", np.ptp(points.v, axis=0)
        )


def _ways(times: Array, rates: Array) -> Array:
    """(n,) the range of the integral of each joint's rate, by the trapezoidal rule."""
    steps = 0.5 * np.diff(times)[:, None] * (rates[1:] + rates[:-1])
    return np.ptp(np.vstack([np.zeros_like(rates[:1]), np.cumsum(steps, axis=0)]), axis=0)


def _refuse_other_units(names: Sequence[str], rate: str, by_rate: Array, value: str, by_value: Array) -> None:
    wrong = (by_rate > _MIN_CHECKED_WAY) & (by_rate > _MAX_RATE_RATIO * by_value)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise InputError(
            f"message: {names[k]:.80}: its {rate} add up to {by_rate[k]:.3g}, but its {value} change by {by_value[k]:.3g}; "
            f"degrees or milliseconds? messages of ROS have rad, rad/s, rad/s^2 and s, and may leave {rate} out"
        )


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
    a = accelerations_at(points.times, points.q, v) if points.a is None else points.a
    return hermite(points.times, points.q, v, a)


def accelerations_at(t: Array, q: Array, v: Array) -> Array:
    """(T, n) accelerations of a motion with positions and velocities (T, n) at times (T,): the mean of both cubics."""
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
    value = point.get(name)
    return () if value is None else value


def _rates(name: str, rows: list[Any], n: int) -> Array | None:
    """The rows, or None if every row is empty; a message leaves out what it does not know."""
    if all(isinstance(row, Sequence | np.ndarray) and not len(row) for row in rows):
        return None
    return _rows(name, rows, n)


def _rows(name: str, rows: list[Any], n: int) -> Array:
    table = np.array([vector(f"message: point {k}: {name}", row, n) for k, row in enumerate(rows)])
    if (np.abs(table) > MAX_FILE_VALUE).any():
        raise InputError(f"message: {name}: a number is above {MAX_FILE_VALUE:g}; expected rad or m, and seconds")
    return table


def _seconds(k: int, stamp: object) -> float:
    what = f"message: point {k}: time_from_start"
    if isinstance(stamp, numbers.Real):
        return number(f"{what}: s", float(stamp) if not isinstance(stamp, bool) else stamp, 0.0, _MAX_SECONDS)
    if not isinstance(stamp, Mapping):
        raise InputError(f"{what}: expected seconds, or a stamp with sec and nanosec, got {shown(stamp)}")
    unknown = [name for name in stamp if name not in _SECONDS + _NANOSECONDS]
    if unknown or not stamp:
        raise InputError(f"{what}: expected sec and nanosec, got {shown(unknown[0]) if unknown else 'an empty table'}")
    whole = next((stamp[name] for name in _SECONDS if name in stamp), 0)
    rest = next((stamp[name] for name in _NANOSECONDS if name in stamp), 0)
    return number(f"{what}: sec", whole, 0.0, _MAX_SECONDS) + 1e-9 * integer(f"{what}: nanosec", rest, 0, 999_999_999)
