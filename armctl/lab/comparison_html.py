"""A comparison in files: a self-contained HTML page with figures, and the same data in Markdown and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armctl.core import units
from armctl.core.atomic import write_text
from armctl.core.plotting import COLORS, figure_svg
from armctl.lab.comparison import Comparison, marked_table, remarks
from armctl.model.arm.arm import Arm
from armctl.report import html_page
from armctl.report.film_html import film_html
from armctl.report.report import Report, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_POINTS_PER_LINE = 500  # more cannot be seen
_MIN_ERROR_SHOWN = 1e-9  # rad or m; the axis is logarithmic, and smaller errors are rounding: they would compress the others


def write_comparison(reports: Sequence[Report], folder: Path, motion: str, film_of: Arm | None = None) -> list[Path]:
    """Writes the reports of one arm and one motion, plant by plant, as comparison.json, comparison.md and comparison.html.

    With `film_of` a film of the run with the largest error is beside each table, unless OpenGL or an encoder is missing.
    """
    title = f"Controllers compared on {reports[0].robot}"
    log = reports[0].log
    duration = f"{log.motion_duration:.2f} s, in ticks of {1e3 * log.dt:g} ms"
    conditions = f"{motion}, {duration}. Errors are measured while the reference moves."
    notes = remarks(reports)
    figures = {"conditions": conditions, "remarks": notes, "runs": [r.to_dict() for r in reports]}
    markdown = [f"# {title}", "", conditions, "", *(f"- **{line}**" for line in notes), "", table(reports), ""]
    texts = {
        "comparison.json": json.dumps(figures, indent=2) + "\n",
        "comparison.md": "\n".join(markdown),
        "comparison.html": _page(title, conditions, notes, reports, film_of),
    }
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def _page(title: str, conditions: str, notes: Sequence[str], reports: Sequence[Report], film_of: Arm | None) -> str:
    marks = "<p>The best values of each plant are <mark>marked</mark>.</p>"
    elements = [html_page.paragraph(conditions), *map(html_page.remark, notes), marks]
    for plant, group in Comparison(reports).plants().items():
        begun = [report for report in group if len(report.log)]
        film = "" if film_of is None or not begun else _film(begun, film_of)
        elements.append(html_page.heading(plant))
        figure = figure_svg(lambda figure, begun=begun: _draw(figure, begun), (13, 4.2)) if begun else ""
        elements.append(f'<div class="columns">{html_page.table(marked_table(group))}{film}</div>{figure}')
    return html_page.page(title, *elements)


def _film(reports: Sequence[Report], arm: Arm) -> str:
    """The run with the largest error of the tip as a film in the page; nothing where films cannot be made."""
    report = max(reports, key=lambda r: np.nan_to_num(r.tip_rms_m, nan=-1.0))
    return film_html(report.log, arm, report.controller)


def _draw(figure: Figure, reports: Sequence[Report]) -> None:
    """Runs on one plant: error over time, the torque nearest to its limit, the path of the tip."""
    error, torque, tip = figure.subplots(1, 3)
    logs = [report.log for report in reports]
    joint = max((int(np.abs(log.tau / log.tau_max).max(axis=0).argmax()) for log in logs[-1:]), default=0)
    plane = np.sort(np.argsort(np.ptp(logs[-1].tip_ref, axis=0))[1:])
    for i, (report, log) in enumerate(zip(reports, logs, strict=True)):
        every = slice(None, None, max(1, len(log) // _MAX_POINTS_PER_LINE))
        color = COLORS[i % len(COLORS)]
        worst = np.maximum(np.abs(log.q_ref - log.q).max(axis=1), _MIN_ERROR_SHOWN)
        error.semilogy(log.t[every], worst[every], color=color, label=report.controller)
        torque.plot(log.t[every], log.tau[every, joint], color=color)
        tip.plot(*log.tip[every][:, plane].T, color=color)
    tip.plot(*logs[-1].tip_ref[:, plane].T, color="black", linestyle="--", linewidth=0.8)
    for bound in (-1, 1):
        torque.axhline(bound * logs[-1].tau_max[joint], color="black", linestyle=":")
    error.set(xlabel="time, s", ylabel=f"greatest joint error, {units.label(logs[-1].units)}")
    unit = units.of_torque(logs[-1].units)[joint]
    torque.set(xlabel="time, s", ylabel=f"torque of {logs[-1].joint_names[joint]}, {unit} (dotted: its limits)")
    tip.set(xlabel=f"tip {'xyz'[plane[0]]}, m", ylabel=f"tip {'xyz'[plane[1]]}, m (dashed: reference)", aspect="equal")
    smallest = min(float(np.median(np.abs(log.q_ref - log.q).max(axis=1))) for log in logs)
    error.set_ylim(bottom=max(smallest / 10, 0.5 * _MIN_ERROR_SHOWN))
    error.legend(fontsize=7, ncols=2)
