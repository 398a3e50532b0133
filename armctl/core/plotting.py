"""One style for all plots, and figures as files, windows or SVG text. matplotlib is imported when the first plot is drawn."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from armctl.core.atomic import atomic_path, file_path
from armctl.core.defaults import PICTURE_ENDINGS
from armctl.core.errors import InputError, NotInstalledError
from armctl.core.validation import number, shown, vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The palette of Okabe and Ito (Color Universal Design, 2008), which colour-blind readers can distinguish.
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C6D00", "#000000", "#999999")
# TrueType, since many journals refuse Type 3, the default; text in SVG stays text, which can be searched and edited.
FONTS: dict[Any, Any] = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none"}
STYLE: dict[Any, Any] = {
    "axes.grid": True,
    "axes.labelcolor": "#222222",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.xmargin": 0.0,
    "figure.titlesize": 11,
    "font.size": 9,
    "grid.alpha": 0.25,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    **FONTS,
    "lines.solid_capstyle": "round",
    "savefig.dpi": 120,
    "svg.hashsalt": "armctl",
}


_MAX_SIZE_INCHES = 200.0  # a picture of 24 000 pixels; more is a size in millimetres or pixels


class AxesLayout(NamedTuple):
    """How a figure of several axes looks; nothing of it but the legend concerns axes of the caller."""

    title: str = ""  # above the axes
    title_weight: str = "bold"
    legend_columns: int = 0  # at most, of the labels of the first axes, below the figure; 0 for no legend
    sharex: bool | str = "col"
    sharey: bool = False
    height_ratios: tuple[float, ...] | None = None


_PLAIN = AxesLayout()


def finish_figure(
    draw: Callable[[Figure], None], size: tuple[float, float], path: str | os.PathLike[str] | None
) -> Path | None:
    """Draws into a file, or into a window or a notebook."""
    size = checked_size(size)
    if path is not None:
        path = file_path("path", path, PICTURE_ENDINGS)
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        if path is None:
            return _window(draw, size)
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, metadata={"Date": None} if path.suffix == ".svg" else None)
    return path


def finish_axes(
    draw: Callable[[list[Axes]], None],
    shape: tuple[int, int],
    size: tuple[float, float],
    path: str | os.PathLike[str] | None,
    axes: Axes | Sequence[Axes] | None,
    layout: AxesLayout = _PLAIN,
) -> Path | None:
    """Draws into a grid of axes: into those of the caller, a file, a window or a notebook."""
    if axes is None:
        return finish_figure(lambda figure: draw_axes(figure, draw, shape, layout), size, path)
    given = checked_axes(axes, shape[0] * shape[1], path)
    draw(given)
    if layout.legend_columns:
        given[0].legend()
    return None


def draw_axes(figure: Figure, draw: Callable[[list[Axes]], None], shape: tuple[int, int], layout: AxesLayout = _PLAIN) -> None:
    """Draws into a grid of axes of a new figure, with title and legend."""
    shared = {"sharex": layout.sharex, "sharey": layout.sharey}
    grid = figure.subplots(*shape, squeeze=False, height_ratios=layout.height_ratios, **shared)
    axes = list(grid.flat)
    draw(axes)
    if layout.legend_columns:
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=max(min(len(names), layout.legend_columns), 1))
    if layout.title:
        figure.suptitle(layout.title, fontweight=layout.title_weight, x=0.01, ha="left")


def checked_size(size: tuple[float, float]) -> tuple[float, float]:
    """The caller's width and height in inches; InputError if they are not two sensible lengths."""
    sides = [number("size", each, 0.1, _MAX_SIZE_INCHES) for each in vector("size", size, 2)]
    return sides[0], sides[1]


def checked_axes(axes: Axes | Sequence[Axes], count: int, path: str | os.PathLike[str] | None) -> list[Axes]:
    """The caller's axes as a list; InputError if they are not so many axes of matplotlib, or if there is a path, too."""
    if path is not None:
        raise InputError("path, ax: give one of them; a figure with axes of yours is saved by its own savefig")
    given = list(np.ravel(np.asarray(axes, dtype=object)))
    if len(given) != count or not all(hasattr(each, "set_xlabel") for each in given):
        raise InputError(f"ax: expected {count} axes of matplotlib, got {shown(axes)}")
    return given


def _window(draw: Callable[[Figure], None], size: tuple[float, float]) -> None:
    import matplotlib
    import matplotlib.pyplot as plt
    from matplotlib.backends.registry import BackendFilter, backend_registry

    # A notebook's backend is none of the built-in ones; it shows the figure below the cell.
    if matplotlib.get_backend().lower() in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        raise NotInstalledError("there is no screen for a window here; name a file to draw into, such as plot.png")
    draw(plt.figure(figsize=size, layout="constrained"))
    plt.show()


def figure_svg(draw: Callable[[Figure], None], size: tuple[float, float]) -> str:
    """Draws into an SVG element for an HTML page; the size is in inches."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
