"""Trajectories in files: exactly, as npz, and as a table of samples, as CSV."""

from __future__ import annotations

import csv
import os
from dataclasses import asdict, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from armctl.core import units
from armctl.core.errors import InputError
from armctl.core.trajectory import Limits
from armctl.core.validation import Array, number
from armctl.motion.slowdown import Slowdown
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.motion.trajectory.piecewise import DEGREE

_FORMAT = 1


def save(trajectory: JointTrajectory, path: str | os.PathLike[str]) -> Path:
    """Writes a motion, exactly, as a NumPy archive.

    Args:
        trajectory: The motion.
        path: Where to; its folder is made, and the name gets the ending .npz if it has none.

    Returns:
        The file.
    """
    file = Path(path)
    file = file if file.suffix == ".npz" else file.with_name(file.name + ".npz")
    file.parent.mkdir(parents=True, exist_ok=True)
    slowed = trajectory.slowed
    np.savez(
        file,
        format=_FORMAT,
        knots=trajectory.knots,
        coefficients=trajectory.coefficients,
        joint_names=np.array(trajectory.joint_names, dtype=str),
        units=np.array(trajectory.units, dtype=str),
        slowed=np.array([] if slowed is None else [str(value) for value in asdict(slowed).values()], dtype=str),
        **{field.name: getattr(trajectory.limits, field.name) for field in fields(Limits)},
    )
    return file


def load(path: str | os.PathLike[str]) -> JointTrajectory:
    """Reads a motion that `save` wrote.

    Args:
        path: The file.

    Returns:
        The motion.

    Raises:
        InputError: There is no such file, or it holds no motion.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            limits = Limits(**{field.name: data[field.name] for field in fields(Limits)})
            slowed = [str(value) for value in data["slowed"]]
            knots, coefficients = data["knots"], data["coefficients"]
            pieces, powers, joints = coefficients.shape
            if (
                knots.shape != (pieces + 1,)
                or powers != DEGREE + 1
                or {joints} != {len(data["joint_names"]), len(limits.q_min)}
            ):
                raise InputError("its parts do not fit each other")
            return JointTrajectory(
                knots,
                coefficients,
                tuple(str(name) for name in data["joint_names"]),
                limits,
                Slowdown(float(slowed[0]), slowed[1], float(slowed[2])) if slowed else None,
                tuple(str(unit) for unit in data.get("units", [])),
            )
    except (OSError, BadZipFile, KeyError, ValueError, EOFError) as error:
        raise InputError(f"{os.fspath(path)}: it holds no trajectory ({error}); give a file that save() wrote") from None


def to_csv(trajectory: JointTrajectory, path: str | os.PathLike[str], dt: float) -> Path:
    """Writes samples of a motion as a table: t, then q, v and a of each joint, named in the first row.

    Args:
        trajectory: The motion.
        path: Where to; its folder is made.
        dt: s, from sample to sample; the end is always one.

    Returns:
        The file.

    Raises:
        InputError: dt is not greater than 0.
    """
    times = sample_times(trajectory, number("dt", dt, 1e-9))
    names = [f"{kind}_{joint}" for kind in "qva" for joint in trajectory.joint_names]
    table = np.column_stack([times, *trajectory.sample(times)[:3]])
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(["t", *names])
        writer.writerows([[repr(value) for value in row] for row in table.tolist()])
    return file


def sample_times(trajectory: JointTrajectory, dt: float) -> Array:
    """Times dt apart, from the start of a motion to its end.

    Args:
        trajectory: The motion.
        dt: s.

    Returns:
        (T,) s.
    """
    return np.append(np.arange(0.0, trajectory.duration - 1e-9 * dt, dt), trajectory.duration)


def plot(trajectory: JointTrajectory, path: str | os.PathLike[str] | None = None) -> object:
    """Draws position, velocity, acceleration and jerk of every joint over time, each as a share of its limit.

    Args:
        trajectory: The motion.
        path: Where to save the picture; left out, it is not saved.

    Returns:
        Matplotlib's figure.
    """
    from matplotlib.figure import Figure

    times = sample_times(trajectory, max(trajectory.duration / 1000, 1e-6))
    q, v, a = trajectory.sample(times)[:3]
    limits = trajectory.limits
    rows = (
        (f"position, {units.label(trajectory.units)}", q),
        ("velocity / limit", v / limits.v_max),
        ("acceleration / limit", a / limits.a_max),
        ("jerk / limit", trajectory.jerk(times) / limits.j_max),
    )
    figure = Figure(figsize=(8, 9), layout="constrained")
    for axes, (label, values) in zip(figure.subplots(len(rows), 1, sharex=True), rows, strict=True):
        axes.plot(times, values, label=trajectory.joint_names)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(ncols=4, fontsize="small")
    figure.axes[-1].set_xlabel("time, s")
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure
