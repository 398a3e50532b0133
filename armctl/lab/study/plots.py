"""Plots of a study: quantile bands, tornado, success over two factors."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armctl.core.plotting import COLORS, AxesLayout, finish_axes
from armctl.core.validation import Array, BoolArray, flag
from armctl.lab.study.summary import unit_of
from armctl.run.sim.plant import PLANT_ATTRIBUTES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Columns = Mapping[str, np.ndarray]

_UNITS = {name: attribute.unit for name, attribute in PLANT_ATTRIBUTES.items() if attribute.unit}
_UNITS["friction"] = "fraction of the torque limit"

_MAX_LEVELS = 12  # a factor with more values is divided into bins
_BINS = 8  # of about equally many runs
_BANDS = ((0.05, 0.95, 0.12), (0.25, 0.75, 0.25))  # from, to, opacity
_FIFTH = 0.2
_QUANTILES_SIZE_INCHES = (6.0, 4.0)


class Canvas(NamedTuple):
    """Where to draw, as the caller says it."""

    path: str | os.PathLike[str] | None
    size: tuple[float, float] | None
    title: bool
    ax: Axes | Sequence[Axes] | None

    def finish(
        self,
        draw: Callable[[list[Axes]], None],
        shape: tuple[int, int],
        size: tuple[float, float],
        layout: AxesLayout,
    ) -> Path | None:
        """Draws into a grid of axes; `size` and the title of `layout` hold if the caller says nothing else."""
        layout = layout if flag("title", self.title) else layout._replace(title="")
        return finish_axes(draw, shape, self.size or size, self.path, self.ax, layout._replace(title_weight="normal"))


def quantiles(columns: Columns, metric: str, factor: str, labels: Sequence[str], canvas: Canvas) -> Path | None:
    """Draws the median of a metric over a factor with bands. A run without a figure counts as infinite, above the picture."""
    label, scale = unit_of(metric)

    def draw(panels: list[Axes]) -> None:
        axes = panels[0]
        for k, controller in enumerate(labels):
            own = columns["controller"] == controller
            centers, groups = _binned(columns[factor][own])
            values = scale * _worst_if_missing(columns[metric][own])
            bins = [values[group] for group in groups]
            for low, high, opacity in _BANDS:
                ends = [_quantile(each, (low, high)) for each in bins]
                axes.fill_between(centers, *np.transpose(ends), color=COLORS[k], alpha=opacity, linewidth=0)
            middle = [_quantile(each, 0.5) for each in bins]
            axes.plot(centers, middle, color=COLORS[k], marker="o", markersize=3, label=controller)
        axes.set_xlabel(_axis(factor))
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)

    layout = AxesLayout(title="median, and bands from 25 to 75 % and from 5 to 95 % of the runs", legend_columns=4)
    return canvas.finish(draw, (1, 1), _QUANTILES_SIZE_INCHES, layout)


def tornado(columns: Columns, metric: str, factors: Sequence[str], labels: Sequence[str], canvas: Canvas) -> Path | None:
    """Draws the median of a metric in the lowest and in the highest fifth of each factor, one panel per controller."""
    label, scale = unit_of(metric)

    def draw(panels: list[Axes]) -> None:
        for axes, controller in zip(panels, labels, strict=True):
            own = columns["controller"] == controller
            values = scale * _worst_if_missing(columns[metric][own])
            ends = {name: _fifths(columns[name][own], values) for name in factors}
            order = sorted(factors, key=lambda name: abs(float(np.subtract(*ends[name]))))
            for row, name in enumerate(order):
                low, high = ends[name]
                axes.plot([low, high], [row, row], color=COLORS[0], linewidth=7, alpha=0.35, solid_capstyle="butt")
                axes.plot(low, row, marker="<", color=COLORS[0], linestyle="none")
                axes.plot(high, row, marker=">", color=COLORS[3], linestyle="none")
            axes.axvline(float(_quantile(values, 0.5)), color="#666666", linewidth=0.8)
            axes.set_yticks(range(len(order)), [name.replace("_", " ") for name in order])
            axes.set_ylim(-0.6, len(order) - 0.4)
            axes.margins(x=0.05)
            axes.set_title(controller)
        panels[-1].set_xlabel(f"median {label}")

    size = (6.0, 1.2 + len(labels) * (0.6 + 0.3 * len(factors)))
    layout = AxesLayout(title="from the lowest (<) to the highest (>) fifth of each factor")
    return canvas.finish(draw, (len(labels), 1), size, layout)


def success(
    columns: Columns, succeeded: BoolArray, factors: tuple[str, str], labels: Sequence[str], canvas: Canvas
) -> Path | None:
    """Draws the share of successes on a grid of two factors, one panel per controller."""
    x, y = factors

    def draw(panels: list[Axes]) -> None:
        image = None
        for axes, controller in zip(panels, labels, strict=True):
            own = columns["controller"] == controller
            image = _share_grid(axes, columns[x][own], columns[y][own], succeeded[own])
            axes.set_title(controller)
            axes.set_xlabel(_axis(x))
        panels[0].set_ylabel(_axis(y))
        if image is not None:
            panels[0].figure.colorbar(image, ax=panels, label="share of successes")

    return canvas.finish(draw, (1, len(labels)), (1.5 + 3.2 * len(labels), 3.4), AxesLayout(sharex=False, sharey=True))


def _share_grid(axes: Axes, x: Array, y: Array, succeeded: BoolArray):
    """One panel of `success`; a cell without runs stays empty."""
    x_centers, x_groups = _binned(x)
    y_centers, y_groups = _binned(y)
    shares = np.full((len(y_groups), len(x_groups)), np.nan)
    for i, rows in enumerate(y_groups):
        for k, columns in enumerate(x_groups):
            both = rows & columns
            if both.any():
                shares[i, k] = succeeded[both].mean()
                axes.text(k, i, f"{100 * shares[i, k]:.0f}", ha="center", va="center", fontsize=7)
    image = axes.imshow(shares, origin="lower", aspect="auto", cmap="RdYlGn", vmin=0.0, vmax=1.0, alpha=0.8)
    axes.set_xticks(range(len(x_centers)), [f"{value:.2g}" for value in x_centers], rotation=45)
    axes.set_yticks(range(len(y_centers)), [f"{value:.2g}" for value in y_centers])
    axes.grid(visible=False)
    return image


def _axis(factor: str) -> str:
    name = factor.replace("_", " ")
    return f"{name}, {_UNITS[factor]}" if factor in _UNITS else name


def _binned(values: np.ndarray) -> tuple[list[float], list[BoolArray]]:
    """The levels of a factor, or the medians of its bins, and which runs belong to each."""
    numbers = values.astype(float)
    levels = np.unique(numbers)
    if len(levels) <= _MAX_LEVELS:
        return levels.tolist(), [numbers == level for level in levels]
    edges = np.quantile(numbers, np.linspace(0.0, 1.0, _BINS + 1))
    place = np.clip(np.searchsorted(edges, numbers, side="right") - 1, 0, _BINS - 1)
    groups = [place == k for k in range(_BINS) if (place == k).any()]
    return [float(np.median(numbers[group])) for group in groups], groups


def _fifths(factor: np.ndarray, values: Array) -> tuple[float, float]:
    """The medians in the lowest and in the highest fifth of a factor."""
    numbers = factor.astype(float)
    low, high = np.quantile(numbers, [_FIFTH, 1.0 - _FIFTH], method="nearest")
    return float(_quantile(values[numbers <= low], 0.5)), float(_quantile(values[numbers >= high], 0.5))


def _worst_if_missing(values: np.ndarray) -> Array:
    numbers = values.astype(float)
    return np.where(np.isnan(numbers), np.inf, numbers)


def _quantile(values: Array, shares: float | tuple[float, float]) -> Array:
    """Quantiles; NaN, which matplotlib leaves out, where runs without a figure make them infinite."""
    with np.errstate(invalid="ignore"):
        found = np.quantile(values, shares)
    return np.where(np.isfinite(found), found, np.nan)
