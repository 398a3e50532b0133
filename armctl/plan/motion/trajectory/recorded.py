"""Motions of CSV files: as `JointTrajectory.to_csv` writes them, as a log has them, or as another program recorded them."""

import csv
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armctl.core.errors import InputError, LimitError
from armctl.core.file_reading import check_size, reading
from armctl.core.limits import Limits
from armctl.core.log_csv import MAX_TABLE_BYTES, read_header, read_numbers
from armctl.core.validation import Array
from armctl.plan.motion.trajectory.ros import Waypoints

_MIN_ROWS_OF_MOTION = 2
_SPEED_TOLERANCE = 1e-3  # of a limit: the derivative of a spline through samples of a motion at its limit


def read_waypoints(path: Path, joint_names: Sequence[str]) -> Waypoints:
    """The rows of a file for these joints, with velocities and accelerations if it has them. InputError if there are none."""
    with reading(path, "no motion"):
        check_size(os.path.getsize(path), MAX_TABLE_BYTES)
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, delimiter = read_header(file)
            if len(set(header)) < len(header):
                raise InputError("its first row has two columns of one name")
            columns = _columns(header, joint_names)
            rows = csv.reader(file, delimiter=delimiter)
            table = read_numbers(rows, [0 if k is None else k for k in columns], len(header), _MIN_ROWS_OF_MOTION)
        n = len(joint_names)
        times = table[:, 0] - table[0, 0]
        if (np.diff(times) <= 0.0).any():
            row = int((np.diff(times) <= 0.0).argmax()) + 2
            raise InputError(f"row {row}: its time, {table[row - 1, 0]:g} s, is not after that of the row before")
        has_velocities = columns[1 + n] is not None
        has_accelerations = has_velocities and columns[1 + 2 * n] is not None
        return Waypoints(
            joint_names=tuple(joint_names),
            times=times,
            q=table[:, 1 : 1 + n],
            v=table[:, 1 + n : 1 + 2 * n] if has_velocities else None,
            a=table[:, 1 + 2 * n :] if has_accelerations else None,
        )


def _columns(header: Sequence[str], joint_names: Sequence[str]) -> list[int | None]:
    """The columns of the time, and of the positions, velocities and accelerations of joints; None where there are none."""
    if "t" not in header:
        raise InputError(f"there is no column 't' for the time, s; its columns are {', '.join(header):.120}")
    columns: list[int | None] = [header.index("t")]
    for kind in "qva":
        names = [f"{kind}_{joint}" for joint in joint_names]
        of_log = [f"{kind}/{joint}" for joint in joint_names]
        if set(of_log) & set(header):
            names = of_log
        elif kind == "q" and not set(names) & set(header) and set(joint_names) & set(header):
            names = list(joint_names)  # other programs name a column as the joint
        missing = [name for name in names if name not in header]
        if missing and kind == "q":
            raise InputError(f"there is no column {missing[0]!r:.60}; its columns are {', '.join(header):.120}")
        columns += [None] * len(names) if missing else [header.index(name) for name in names]
    return columns


def check_recorded(points: Waypoints, speeds: Array, limits: Limits, units: Sequence[str], speed: float) -> None:
    """Refuses a recording that is outside the position or velocity limits at one of its rows, (T, n). Raises LimitError."""
    outside = np.maximum(points.q - limits.q_max, limits.q_min - points.q)
    k, i = np.unravel_index(int(outside.argmax()), outside.shape)
    name = points.joint_names[int(i)]
    if outside[k, i] > 0.0:
        raise LimitError(
            f"path: {name} is at {points.q[k, i]:.6g} {units[int(i)]} at {points.times[k]:.6g} s, outside its range "
            f"[{limits.q_min[i]:.6g}, {limits.q_max[i]:.6g}]; clip the recording, or record it inside"
        )
    shares = np.abs(speeds) / limits.v_max
    k, i = np.unravel_index(int(shares.argmax()), shares.shape)
    if speed * shares[k, i] > 1 + _SPEED_TOLERANCE:
        raise LimitError(
            f"speed: at {speed:g}, {points.joint_names[int(i)]} needs {100 * speed * shares[k, i]:.4g} % of its speed limit, "
            f"{limits.v_max[i]:g} {units[int(i)]}/s, at {points.times[k]:.6g} s; speed={1 / shares[k, i]:.3g} keeps it"
        )
