"""A comparison on paper: one self-contained page with figures, and the same in Markdown and JSON."""

from __future__ import annotations

import html
import io
import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armctl.analysis.comparison import remarks
from armctl.analysis.plot import COLORS, STYLE
from armctl.analysis.report import Report, table
from armctl.core import units
from armctl.core.log import Log

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 500  # of a line: more are not seen
_ROUNDING = 1e-15  # rad: less is shown as this
_CSS = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child, td:nth-child(2), th:nth-child(2), td:last-child { text-align: left; }
.remark { color: #a33; } svg { width: 100%; height: auto; } .table { overflow-x: auto; }
"""


def write_comparison(reports: Sequence[Report], folder: Path, motion: str) -> list[Path]:
    """Writes a comparison as comparison.json, comparison.md and comparison.html.

    Args:
        reports: The reports, plant by plant, all of one arm and one motion.
        folder: Where to; it is made.
        motion: What was followed, in words.

    Returns:
        The three files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    title, conditions = f"Controllers compared on {reports[0].robot}", _conditions(reports[0].log, motion)
    said = remarks(reports)
    figures = {"conditions": conditions, "remarks": said, "runs": [r.to_dict() for r in reports]}
    markdown = [f"# {title}", "", conditions, "", *(f"- **{line}**" for line in said), "", table(list(reports)), ""]
    texts = {
        "comparison.json": json.dumps(figures, indent=2) + "\n",
        "comparison.md": "\n".join(markdown),
        "comparison.html": _page(title, conditions, said, reports),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def _conditions(log: Log, motion: str) -> str:
    return (
        f"{motion}, {log.motion_duration:.2f} s, in ticks of {1e3 * log.dt:g} ms. Errors are taken while the reference moves."
    )


def _page(title: str, conditions: str, said: Sequence[str], reports: Sequence[Report]) -> str:
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title><style>{_CSS}</style>'
    body = [f"<h1>{html.escape(title)}</h1><p>{html.escape(conditions)}</p>"]
    body += [f'<p class="remark">{html.escape(line)}</p>' for line in said]
    body.append(_html_table(table(list(reports))))
    for plant, group in groupby(reports, key=lambda r: r.plant):
        body.append(f"<h2>{html.escape(plant)}</h2>{_svg([r.log for r in group])}")
    return "\n".join([head, *body, "</html>", ""])


def _html_table(markdown: str) -> str:
    header, _, *rows = ([html.escape(cell.strip()) for cell in line.split("|")[1:-1]] for line in markdown.splitlines())
    lines = ["".join(f"<td>{cell}</td>" for cell in row) for row in rows]
    head = "".join(f"<th>{cell}</th>" for cell in header)
    return f'<div class="table"><table><tr>{head}</tr>' + "".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def _svg(logs: Sequence[Log]) -> str:
    """Error over time, the torque nearest its limit, and the tip's path, of runs on one plant."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(13, 4.2), layout="constrained")
        _draw(figure, logs)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _draw(figure: Figure, logs: Sequence[Log]) -> None:
    error, torque, tip = figure.subplots(1, 3)
    joint = max((int(np.abs(log.tau / log.tau_max).max(axis=0).argmax()) for log in logs[-1:]), default=0)
    plane = np.sort(np.argsort(np.ptp(logs[-1].tip_ref, axis=0))[1:])
    for i, log in enumerate(logs):
        every, color = slice(None, None, max(1, len(log) // _POINTS)), COLORS[i % len(COLORS)]
        worst = np.maximum(np.abs(log.q_ref - log.q).max(axis=1), _ROUNDING)
        error.semilogy(log.t[every], worst[every], color=color, label=log.controller)
        torque.plot(log.t[every], log.tau[every, joint], color=color)
        tip.plot(*log.tip[every][:, plane].T, color=color)
    tip.plot(*logs[-1].tip_ref[:, plane].T, color="black", linestyle="--", linewidth=0.8)
    for bound in (-1, 1):
        torque.axhline(bound * logs[-1].tau_max[joint], color="black", linestyle=":")
    error.set(xlabel="time, s", ylabel=f"greatest joint error, {units.label(logs[-1].units)}")
    unit = units.of_torque(logs[-1].units)[joint]
    torque.set(xlabel="time, s", ylabel=f"torque of {logs[-1].joint_names[joint]}, {unit} (dotted: its limits)")
    tip.set(xlabel=f"tip {'xyz'[plane[0]]}, m", ylabel=f"tip {'xyz'[plane[1]]}, m (dashed: wanted)", aspect="equal")
    error.legend(fontsize=7, ncols=2)
