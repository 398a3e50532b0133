"""Pictures of a log over time. One style for the whole project; matplotlib waits until a picture is drawn."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.errors import InputError
from armctl.log import Log

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette, told apart by the colour-blind (Color Universal Design, 2008).
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C6D00", "#000000")
STYLE: dict[Any, Any] = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.alpha": 0.25,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "savefig.dpi": 120,
    "svg.hashsalt": "armctl",
}


def four_panels(log: Log, path: str | os.PathLike[str]) -> Path:
    """Draws joint angles, velocities, torques with their limits, and the tip, over time.

    Args:
        log: The run.
        path: The picture, .png, .svg or .pdf; its folder is made.

    Returns:
        The path.

    Raises:
        InputError: The log is empty, or the path has another ending.
    """
    path = Path(path)
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise InputError(f"path: {path.name!r} ends in {path.suffix!r}, .png, .svg or .pdf wanted")
    if len(log) == 0:
        raise InputError("log: it has no tick, so there is nothing to draw")
    import matplotlib
    from matplotlib.figure import Figure

    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10, 7), layout="constrained")
        axes = figure.subplots(2, 2, sharex=True)
        _draw(axes[0, 0], log, log.q, log.q_ref, "joint angle, rad")
        _draw(axes[0, 1], log, log.v, log.v_ref, "joint velocity, rad/s")
        _draw(axes[1, 0], log, log.tau, None, "torque, N m")
        _draw_limits(axes[1, 0], log)
        _draw(axes[1, 1], log, log.tip, log.tip_ref, "tip position, m", names=("x", "y", "z"))
        for ax in axes[1]:
            ax.set_xlabel("time, s")
        figure.suptitle(f"{log.robot}, {log.controller}" + (f": {log.end}" if log.end else ""))
        figure.savefig(path)
    return path


def _draw(ax: Axes, log: Log, values, reference, label: str, names: tuple[str, ...] | None = None) -> None:
    for i, name in enumerate(names or log.joint_names):
        color = COLORS[i % len(COLORS)]
        ax.plot(log.t, values[:, i], color=color, label=name)
        if reference is not None and not np.isnan(reference).all():
            ax.plot(log.t, reference[:, i], color=color, linestyle="--", linewidth=0.9, alpha=0.7)
    ax.set_ylabel(label + (" (dashed: wanted)" if reference is not None and not np.isnan(reference).all() else ""))
    ax.legend(ncols=2 if len(names or log.joint_names) > 4 else 1, loc="best")


def _draw_limits(ax: Axes, log: Log) -> None:
    """Each joint's torque limit, where the torques come near it."""
    peak = float(np.nanmax(np.abs(log.tau)))
    for i, limit in enumerate(log.tau_max):
        if limit <= 1.5 * peak:
            for bound in (-limit, limit):
                ax.axhline(bound, color=COLORS[i % len(COLORS)], linestyle=":", linewidth=1.0)
