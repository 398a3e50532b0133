"""Charts: how far off the tip is and how hard the motors work, over the last seconds, on the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armctl.goal import TOLERANCE
from armctl.live.history import SECONDS, Past
from armctl.plot import COLORS

if TYPE_CHECKING:
    import viser

_LEAST_MM = 1e-3  # what is below it is drawn there: the scale is logarithmic
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
        lines = ("to the target", COLORS[2]), ("to its reference", COLORS[0])
        self._error = server.gui.add_uplot(
            _errors(past),
            ({"label": "s"}, *(_line(label, color) for label, color in lines), _bound(f"{1e3 * TOLERANCE:g} mm")),
            title="tip error, mm",
            scales={"x": {"time": False}, "y": {"distr": 3, "range": (_LEAST_MM, 1e4)}},
            axes=({"show": True}, {"size": 60}),
            height=190,
        )
        self._torque = server.gui.add_uplot(
            _torques(past),
            ({"label": "s"}, *(_line(j, COLORS[i % len(COLORS)]) for i, j in enumerate(joint_names)), _bound("+"), _bound("-")),
            title="torque, % of each motor's limit",
            scales={"x": {"time": False}, "y": {"range": (-115.0, 115.0)}},
            axes=({"show": True}, {"size": 60}),
            height=260,
        )

    def update(self, past: Past) -> None:
        """Draws what happened since.

        Args:
            past: The last seconds.
        """
        self._error.data, self._torque.data = _errors(past), _torques(past)


def _line(label: str, color: str) -> dict:
    return {"label": label, "stroke": color, "width": 2, "points": {"show": False}}


def _bound(label: str) -> dict:
    return {"label": label, "stroke": "#555555", "width": 1, "dash": (6, 4), "points": {"show": False}}


def _errors(past: Past) -> tuple[np.ndarray, ...]:
    rows = slice(None, None, -_EVERY)
    lines = [np.maximum(1e3 * line[rows][::-1], _LEAST_MM) for line in (past.to_target, past.to_reference)]
    time = _ago(past)
    return time, *lines, np.full_like(time, 1e3 * TOLERANCE)


def _torques(past: Past) -> tuple[np.ndarray, ...]:
    shares, time = 100 * past.torque_share[::-_EVERY][::-1], _ago(past)
    return time, *shares.T.copy(), np.full_like(time, 100.0), np.full_like(time, -100.0)


def _ago(past: Past) -> np.ndarray:
    """s before now."""
    return np.linspace(-SECONDS, 0.0, len(past.t[::-_EVERY]))
