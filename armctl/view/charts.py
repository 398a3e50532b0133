"""Charts: tip error and motor torques over the last seconds, on the page."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.plotting import COLORS
from armctl.core.target import TOLERANCE
from armctl.core.validation import Array
from armctl.view.realtime.history import DURATION_S, HistorySamples
from armctl.view.status_text import MIN_SHOWN_MM

if TYPE_CHECKING:
    import viser
    from viser import uplot

_MAX_SHOWN_MM = 3e3  # leaves room above the last label, 1000
_SAMPLES_PER_POINT = 4
_ERROR_CHART_HEIGHT_PX = 150
_TORQUE_CHART_HEIGHT_PX = 150
_BOUND_COLOR = "#555555"
_TORQUE_RANGE_PERCENT = (0.0, 115.0)
# The numbers of the errors are in the text above the charts, once.
_ERROR_LINES = [
    (COLORS[2], "to the target", ""),
    (COLORS[0], "to its reference", ""),
    (_BOUND_COLOR, "tolerance", f"{1e3 * TOLERANCE:g} mm"),
]


class Charts:
    """Two charts over time: tip error with its tolerance, and the torque nearest to its limit."""

    def __init__(self, server: viser.ViserServer, joint_names: tuple[str, ...], samples: HistorySamples):
        """Adds the charts at the end of the page's panel, with what has been sampled so far."""
        self._last_t = samples.t[-1]
        self._joint_names = joint_names
        self._error = server.gui.add_uplot(
            _errors(samples),
            (_TIME, _line("to the target", COLORS[2]), _line("to its reference", COLORS[0]), _bound("tolerance")),
            title=f"tip error, mm (logarithmic), last {DURATION_S:g} s",
            scales={"x": _SPAN, "y": {"distr": 3, "range": (MIN_SHOWN_MM, _MAX_SHOWN_MM)}},
            axes=({}, {"grid": {"show": False}, "ticks": {"show": False}}),
            legend=_LEGEND,
            height=_ERROR_CHART_HEIGHT_PX,
        )
        server.gui.add_html(_legend(_ERROR_LINES))
        self._torque = server.gui.add_uplot(
            _torques(samples),
            (_TIME, _line("largest", COLORS[1]), _bound("limit")),
            title=f"largest torque, % of its motor's limit, last {DURATION_S:g} s",
            scales={"x": _SPAN, "y": {"range": _TORQUE_RANGE_PERCENT}},
            legend=_LEGEND,
            height=_TORQUE_CHART_HEIGHT_PX,
        )
        self._torque_legend = server.gui.add_html(_torque_legend(samples, joint_names))

    def update(self, samples: HistorySamples) -> None:
        if samples.t[-1] == self._last_t:
            return
        self._last_t = samples.t[-1]
        self._error.data = _errors(samples)
        self._torque.data = _torques(samples)
        self._torque_legend.content = _torque_legend(samples, self._joint_names)

    @property
    def shown_reference_error_mm(self) -> float:
        """The last value of the tip's distance from its reference, as drawn."""
        return float(self._error.data[2][-1])


_TIME: uplot.Series = {"label": "s"}
_LEGEND: uplot.Legend = {"show": False}  # uPlot shows values only under the mouse
_SPAN: uplot.Scale = {"time": False, "range": (-DURATION_S, 0.0)}


def _line(label: str, color: str) -> uplot.Series:
    return {"label": label, "stroke": color, "width": 2.0, "points": {"show": False}}


def _bound(label: str) -> uplot.Series:
    return {**_line(label, _BOUND_COLOR), "width": 1.0}


def _torque_legend(samples: HistorySamples, joint_names: tuple[str, ...]) -> str:
    shares = np.nan_to_num(100 * samples.torque_share[-1])
    return _legend([(_BOUND_COLOR, name, f"{round(shares[i])} %") for i, name in enumerate(joint_names)])


def _legend(entries: list[tuple[str, str, str]]) -> str:
    rows = (
        f'<span style="white-space: nowrap; margin-right: 1em"><span style="color: {color}">&#9632;</span> '
        f"{html.escape(name)} <b>{value}</b></span>"
        for color, name, value in entries
    )
    return f'<div style="font-size: 0.8em; line-height: 1.5; padding: 0 0.8em; color: #212529">{" ".join(rows)}</div>'


def _errors(samples: HistorySamples) -> tuple[Array, ...]:
    rows = _shown_rows(samples)
    age = samples.t[rows] - samples.t[-1]
    columns = (samples.to_target, samples.to_reference)
    lines = [np.maximum(1e3 * column[rows], MIN_SHOWN_MM) for column in columns]
    return age, *lines, np.full_like(age, 1e3 * TOLERANCE)


def _torques(samples: HistorySamples) -> tuple[Array, ...]:
    rows = _shown_rows(samples)
    age = samples.t[rows] - samples.t[-1]
    return age, 100 * np.abs(samples.torque_share[rows]).max(axis=1), np.full_like(age, 100.0)


def _shown_rows(samples: HistorySamples) -> np.ndarray:
    rows = np.arange(len(samples.t))[::-_SAMPLES_PER_POINT][::-1]
    return rows[np.isfinite(samples.to_target[rows])]
