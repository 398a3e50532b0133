"""Plots of logs over time, in one style. matplotlib is imported when the first plot is drawn."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from armctl.core import units
from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.plotting import COLORS, STYLE, AxesLayout, draw_axes, finish_axes
from armctl.core.target import TOLERANCE
from armctl.core.validation import Array, flag, instance, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BOUND = {"color": "#555555", "linestyle": (0, (4, 3)), "linewidth": 0.9, "zorder": 1}
_PANELS_SIZE_INCHES = (10.0, 7.0)
_OVERLAY_SIZE_INCHES = (8.0, 6.0)
_OVERLAY_LAYOUT = AxesLayout(legend_columns=4, height_ratios=(3.0, 2.0))
_MIN_TIP_ERROR_SHOWN_M = 1e-9  # the axis is logarithmic


def four_panels(
    log: Log,
    path: str | os.PathLike[str] | None = None,
    *,
    size: tuple[float, float] | None = None,
    title: bool = True,
    ax: Sequence[Axes] | None = None,
) -> Path | None:
    """Draws joint positions, joint velocities, motor torques and the tip's position over time, in four panels.

    The reference is dashed, torque limits are grey lines, and a circle marks the target.

    Args:
        path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window opens.
        size: Width and height in inches.
        title: Whether arm and controller stand above the panels; False where a caption says it.
        ax: Four axes of matplotlib to draw into instead, row by row.

    Raises:
        InputError: The log is empty, the path has another file extension, or the axes are not four.
        ArmctlError: The file cannot be written.
        NotInstalledError: There is no screen for a window.
    """
    _check([log])

    def draw(axes: list[Axes]) -> None:
        position, velocity, torque, tip = axes
        _lines(position, log.t, log.q, log.q_ref, names=log.joint_names)
        _lines(velocity, log.t, log.v, log.v_ref)
        _lines(torque, log.t, log.tau)
        _torque_limits(torque, log)
        _lines(tip, log.t, log.tip, log.tip_ref, names=("x", "y", "z"))
        _target(tip, log)
        dashed = "" if log.is_open_loop else "; dashed: reference"
        titles = (
            f"joint {'position' if 'm' in log.units else 'angle'}, {units.label(log.units)}{dashed}",
            f"joint velocity, {units.label(log.units, '/s')}{dashed}",
            f"motor torque, {units.label(units.of_torque(log.units))}",
            f"{next(iter(log.tips))} position, m{dashed}",
        )
        for panel, above in zip(axes, titles, strict=True):
            panel.set_title(above)
        for panel in (torque, tip):
            panel.set_xlabel("time, s")
        tip.legend(loc="best")

    headline = f"{log.robot}, {log.controller}" + (f": {log.failure}" if log.failure else "")
    layout = AxesLayout(title=headline if flag("title", title) else "", legend_columns=8)
    return finish_axes(draw, (2, 2), size or _PANELS_SIZE_INCHES, path, ax, layout)


def overlay(
    logs: Sequence[Log],
    path: str | os.PathLike[str] | None = None,
    *,
    labels: Sequence[str] | None = None,
    size: tuple[float, float] | None = None,
    ax: Sequence[Axes] | None = None,
) -> Path | None:
    """Draws several runs over each other: the tracking error of the tip, and the torque nearest to its limit.

    Args:
        logs: The runs; each must have followed a reference.
        path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window opens.
        labels: One per run; the names of their controllers if left out.
        size: Width and height in inches.
        ax: Two axes of matplotlib to draw into instead.

    Raises:
        InputError: A log is empty or without a reference, there is none, the number of labels differs, the path has another
            ending, or the axes are not two.
        ArmctlError: The file cannot be written.
        NotInstalledError: There is no screen for a window.
    """
    _check_overlay(logs, labels)
    return finish_axes(
        lambda axes: _draw_overlay(axes, logs, labels), (2, 1), size or _OVERLAY_SIZE_INCHES, path, ax, _OVERLAY_LAYOUT
    )


def overlay_image(logs: Sequence[Log], labels: Sequence[str] | None = None) -> NDArray[np.uint8]:
    """`overlay` as an image in memory: (height, width, 3), red, green and blue."""
    _check_overlay(logs, labels)
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6, 6), layout="constrained", dpi=120)
        canvas = FigureCanvasAgg(figure)
        draw_overlay(figure, logs, labels)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw_overlay(figure: Figure, logs: Sequence[Log], labels: Sequence[str] | None = None) -> None:
    """Draws `overlay` into a figure of matplotlib."""
    draw_axes(figure, lambda axes: _draw_overlay(axes, logs, labels), (2, 1), _OVERLAY_LAYOUT)


def _draw_overlay(axes: list[Axes], logs: Sequence[Log], labels: Sequence[str] | None) -> None:
    labels = [log.controller for log in logs] if labels is None else labels
    error, load = axes
    for i, (log, label) in enumerate(zip(logs, labels, strict=True)):
        color = COLORS[i % len(COLORS)]
        error.semilogy(log.t, np.maximum(_tip_error(log), _MIN_TIP_ERROR_SHOWN_M) * 1e3, color=color, label=label)
        torque_ratio = np.abs(log.tau / log.tau_max).max(axis=1)
        load.plot(log.t, 100 * torque_ratio, color=color)
    error.axhline(1e3 * TOLERANCE, **_BOUND)
    load.axhline(100.0, **_BOUND)
    load.set_ylim(0.0)
    error.set_title(f"distance of the tip from its reference, mm (dashed: {1e3 * TOLERANCE:g} mm)")
    load.set_title("largest motor torque, % of its limit")
    load.set_xlabel("time, s")
    smallest = min(float(np.median(_tip_error(log))) for log in logs)
    error.set_ylim(bottom=1e3 * max(smallest / 10, _MIN_TIP_ERROR_SHOWN_M / 3))
    error.yaxis.set_major_formatter("{x:g}")


def _check(logs: Sequence[Log]) -> None:
    if isinstance(logs, Log) or not isinstance(logs, Sequence):
        raise InputError("logs: expected a list of logs, such as [sim.log]")
    if not logs:
        raise InputError("logs: expected at least one log, got none")
    for log in logs:
        instance("log", log, Log, "armctl.simulate and every move of a Simulation that is not refused give one")
        if len(log) == 0:
            raise InputError("log: it is empty, so there is nothing to draw")


def _check_overlay(logs: Sequence[Log], labels: Sequence[str] | None) -> None:
    _check(logs)
    if any(np.isnan(log.tip_ref).any() for log in logs):
        raise InputError("logs: one of them has no reference, so there is no tracking error to draw; use four_panels")
    if labels is None:
        return
    if not isinstance(labels, Sequence) or isinstance(labels, str):
        raise InputError(f"labels: expected a list of texts, got {shown(labels)}")
    if len(labels) != len(logs):
        raise InputError(f"labels: expected {len(logs)}, got {len(labels)}; one for each log")


def _lines(ax: Axes, t: Array, values: Array, reference: Array | None = None, names: Sequence[str] | None = None) -> None:
    """One line per column, with its reference dashed."""
    for i, column in enumerate(values.T):
        ax.plot(t, column, color=COLORS[i % len(COLORS)], label=names[i] if names else None)
    if reference is not None and not np.isnan(reference).all():
        for i, column in enumerate(reference.T):
            ax.plot(t, column, color=COLORS[i % len(COLORS)], linestyle=(0, (4, 2)), linewidth=0.9)


def _torque_limits(ax: Axes, log: Log) -> None:
    """Lines at the torque limits near the torques, each value once, named by its joints."""
    peak = float(np.nanmax(np.abs(log.tau)))
    for limit in sorted({float(x) for x in log.tau_max if x <= 1.5 * peak}):
        joints = [name for name, bound in zip(log.joint_names, log.tau_max, strict=True) if bound == limit]
        names = " and ".join(joints) if len(joints) <= 2 else f"{joints[0]} to {joints[-1]}"
        for bound in (-limit, limit):
            ax.axhline(bound, **_BOUND)
        ax.annotate(
            f"limit of {names}: {limit:g}",
            (1.0, limit),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=7,
        )


def _target(ax: Axes, log: Log) -> None:
    for i, value in enumerate(log.target[:3]):
        if np.isfinite(value):
            ax.plot(log.t[-1], value, marker="o", color=COLORS[i], markersize=6, clip_on=False, markerfacecolor="none")


def _tip_error(log: Log) -> Array:
    """(T,) m, the distance of the tip from its reference; of several tips that of the farthest one."""
    return np.max([np.linalg.norm(tip.position - tip.position_ref, axis=1) for tip in log.tips.values()], axis=0)
