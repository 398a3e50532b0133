"""Payload, reach and joint speeds of arms as their makers publish them, as a table."""

from __future__ import annotations

from math import degrees

from armctl.core.tables import Table
from armctl.loading.datasheets import ROWS, Row

_COLUMNS = ("robot", "payload, kg", "reach, m", "joint speeds, deg/s", "source")
_ARM_CATEGORIES = ("arm", "dual_arm")
_NO_ROW = Row(source="")


def rated_arms() -> dict[str, Row]:
    """Every arm of Menagerie with its data sheet; without one, its row is empty and its speeds are the default of 2 rad/s."""
    import mujoco_menagerie as menagerie

    arms = [robot.name for robot in menagerie.robots() if robot.category in _ARM_CATEGORIES]
    return {name: ROWS.get(name, _NO_ROW) for name in sorted({*arms, *ROWS})}


def ratings_table() -> Table:
    """The figures of `rated_arms`."""
    cells = []
    for name, row in rated_arms().items():
        speeds = " ".join(f"{degrees(v):.0f}" for v in row.v_max or ())
        figures = ["" if figure is None else f"{figure:g}" for figure in (row.payload, row.reach)]
        cells.append([name, *figures, speeds, row.sources or "no data sheet"])
    return Table(_COLUMNS, cells)
