"""Charts: how far off the tip is and how hard the motors work, over the last seconds, on the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armctl.analysis.plot import COLORS
from armctl.core.target import TOLERANCE
from armctl.sim.history import SECONDS, Past

if TYPE_CHECKING:
    import viser
    from viser import uplot

_LEAST_MM = 1e-2  # what is below it is drawn there: the scale is logarithmic
_MOST_MM = 3e3  # room above the last label, 1000
_EVERY = 4  # a row of the history in so many is drawn


class Charts:
    """Two charts over time: tip error with the tolerance, torques with their limits."""

    def __init__(self, server: viser.ViserServer, joint_names: tuple[str, ...], past: Past):
        """Charts at the end of the page's panel.

        Args:
            server: The page's server.
            joint_names: The n joints.
            past: What is to be seen at first.
        """
        self._until = past.t[-1]
        joints = [_line(name, COLORS[i % len(COLORS)]) for i, name in enumerate(joint_names)]
        self._error = server.gui.add_uplot(
            _errors(past),
            (_TIME, _line("to the target", COLORS[2]), _line("to its reference", COLORS[0]), _bound("tolerance")),
            title=f"tip error, mm; grey: {1e3 * TOLERANCE:g} mm",
            scales={"x": _SPAN, "y": {"distr": 3, "range": (_LEAST_MM, _MOST_MM)}},
            axes=({}, {"grid": {"show": False}, "ticks": {"show": False}}),
            height=150,
        )
        self._torque = server.gui.add_uplot(
            _torques(past),
            (_TIME, *joints, _bound("limit"), _bound("limit")),
            title="torque, % of each motor's limit",
            scales={"x": _SPAN, "y": {"range": (-115.0, 115.0)}},
            height=190,
        )

    def update(self, past: Past) -> None:
        """Draws what happened since.

        Args:
            past: The last seconds.
        """
        if past.t[-1] == self._until:
            return
        self._until = past.t[-1]
        self._error.data, self._torque.data = _errors(past), _torques(past)


_TIME: uplot.Series = {"label": "s"}
_SPAN: uplot.Scale = {"time": False, "range": (-SECONDS, 0.0)}


def _line(label: str, color: str) -> uplot.Series:
    return {"label": label, "stroke": color, "width": 2.0, "points": {"show": False}}


def _bound(label: str) -> uplot.Series:
    return {**_line(label, "#555555"), "width": 1.0}


def _errors(past: Past) -> tuple[np.ndarray, ...]:
    time, rows = _ago(past)
    lines = [np.maximum(1e3 * line[rows], _LEAST_MM) for line in (past.to_target, past.to_reference)]
    return time, *lines, np.full_like(time, 1e3 * TOLERANCE)


def _torques(past: Past) -> tuple[np.ndarray, ...]:
    time, rows = _ago(past)
    bound = np.full_like(time, 100.0)
    return time, *np.ascontiguousarray(100 * past.torque_share[rows].T), bound, -bound


def _ago(past: Past) -> tuple[np.ndarray, np.ndarray]:
    """The rows to draw, and how long ago they were, s."""
    rows = np.arange(len(past.t))[::-_EVERY][::-1]
    rows = rows[np.isfinite(past.to_target[rows])]
    return past.t[rows] - past.t[-1], rows
