"""Trajectories in files: exact arrays as npz, samples as CSV, and a plot. All files are replaced atomically."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from armctl.core import units
from armctl.core.atomic import atomic_path, file_path
from armctl.core.errors import InputError
from armctl.core.file_reading import read_npz, reading
from armctl.core.limits import Limits
from armctl.core.plotting import FONTS, checked_axes, checked_size, draw_axes
from armctl.core.validation import Array, shown
from armctl.plan.motion.trajectory.piecewise import JointSamples, Pieces, check_continuous, check_pieces

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FORMAT = 1
_SIZE_INCHES = (8.0, 9.0)
_MAX_BYTES = 2**30  # unpacked: three million pieces of seven joints; more is taken for a damaged or hostile archive


class TrajectoryContent(NamedTuple):
    """What a trajectory file holds; `slowed` is empty or the three fields of a slowdown as text."""

    pieces: Pieces
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    limits: Limits
    slowed: tuple[str, ...]


def checked_path(path: str | os.PathLike[str], suffix: str, other: str) -> Path:
    """A caller's path, with the suffix added if it has none; another suffix raises InputError that names the method `other`."""
    file = file_path("path", path)
    if not file.suffix:
        return file.with_name(file.name + suffix)
    if file.suffix.lower() != suffix:
        raise InputError(f"path: {shown(file.name)} does not end in {suffix}; for another format see {other}")
    return file


def save(path: str | os.PathLike[str], content: TrajectoryContent) -> Path:
    file = checked_path(path, ".npz", "to_csv")
    with atomic_path(file) as temporary:
        np.savez(
            temporary,
            format=_FORMAT,
            knots=content.pieces.knots,
            coefficients=content.pieces.coefficients,
            joint_names=np.array(content.joint_names, dtype=str),
            units=np.array(content.units, dtype=str),
            slowed=np.array(content.slowed, dtype=str),
            **{field.name: getattr(content.limits, field.name) for field in fields(Limits)},
        )
    return file


def load(path: str | os.PathLike[str]) -> TrajectoryContent:
    """Reads a trajectory file; raises InputError for a missing file and for any content that is not a motion."""
    file = file_path("path", path)
    with reading(file, "no trajectory that armctl wrote"):
        return _content(read_npz(file, _MAX_BYTES))


def _content(data: Mapping[str, Any]) -> TrajectoryContent:
    if data["format"].shape != () or data["format"] != _FORMAT:
        raise InputError(f"its format is not {_FORMAT}")
    names = _texts(data, "joint_names")
    joint_units = _texts(data, "units")
    slowed = _texts(data, "slowed")
    if not names or len(joint_units) != len(names) or len(slowed) not in (0, 3):
        raise InputError("its parts do not fit each other")
    limits = Limits(**{field.name: data[field.name] for field in fields(Limits) if field.name in data})
    if len(limits.q_min) != len(names):
        raise InputError("its limits do not fit its joints")
    pieces = Pieces(_numbers(data, "knots"), _numbers(data, "coefficients"))
    check_pieces(pieces.knots, pieces.coefficients, len(names))
    check_continuous(pieces, names)
    return TrajectoryContent(pieces, names, joint_units, limits, slowed)


def _texts(data: Mapping[str, Any], name: str) -> tuple[str, ...]:
    value = data[name]
    if value.ndim != 1 or (value.dtype.kind != "U" and value.size):
        raise InputError(f"{name} is not a list of texts")
    return tuple(str(text) for text in value)


def _numbers(data: Mapping[str, Any], name: str) -> Array:
    value = data[name]
    if value.dtype != np.float64:
        raise InputError(f"{name} has type {value.dtype}, not float64")
    return value


def save_table(path: str | os.PathLike[str], joint_names: Sequence[str], times: Array, samples: JointSamples) -> Path:
    """Writes samples as CSV: t, then q, v and a of each joint, named in the first row."""
    file = checked_path(path, ".csv", "save")
    names = [f"{kind}_{joint}" for kind in "qva" for joint in joint_names]
    table = np.column_stack([times, *samples])
    with atomic_path(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(["t", *names])
        writer.writerows([[repr(value) for value in row] for row in table.tolist()])
    return file


def plot(
    content: TrajectoryContent,
    times: Array,
    samples: JointSamples,
    jerk: Array,
    path: str | os.PathLike[str] | None,
    size: tuple[float, float] | None,
    ax: Sequence[Axes] | None,
) -> object:
    """Matplotlib's figure of position, velocity, acceleration and jerk (T, n) of every joint, saved if there is a path."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    rows = (
        (f"position, {units.label(content.units)}", samples.q),
        ("velocity / limit", samples.v / content.limits.v_max),
        ("acceleration / limit", samples.a / content.limits.a_max),
        ("jerk / limit", jerk / content.limits.j_max),
    )

    def draw(panels: list[Axes]) -> None:
        for axes, (label, values) in zip(panels, rows, strict=True):
            axes.plot(times, values, label=content.joint_names)
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
        panels[0].legend(ncols=4, fontsize="small")
        panels[-1].set_xlabel("time, s")

    if ax is not None:
        panels = checked_axes(ax, len(rows), path)
        draw(panels)
        return panels[0].figure
    figure = Figure(figsize=_SIZE_INCHES if size is None else checked_size(size), layout="constrained")
    draw_axes(figure, draw, (len(rows), 1))
    if path is not None:
        formats = figure.canvas.get_supported_filetypes()
        file = file_path("path", path)
        if file.suffix[1:].lower() not in formats:
            raise InputError(
                f"path: {shown(file.name)} is not the name of a picture; it must end in one of {', '.join(formats)}"
            )
        with atomic_path(file) as temporary, rc_context(FONTS):
            figure.savefig(temporary, dpi=120)
    return figure
