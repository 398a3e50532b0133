"""Margins of controllers as a table, and as a self-contained HTML page with plots."""

from __future__ import annotations

import html
from collections.abc import Sequence
from math import degrees, isfinite
from pathlib import Path
from string import Template

from armctl.core.atomic import write_text
from armctl.core.plotting import figure_svg
from armctl.core.tables import Table
from armctl.design.linearization import linearize
from armctl.design.loop import draw_loop
from armctl.design.margins import Margins
from armctl.robot.arm import Arm
from armctl.sim.plant import NOMINAL, Plant

_HEADER = ("controller", "delay margin, ms", "in ticks", "gain margin", "phase margin, deg", "Ms", "worst delay at q", "note")
_PAGE = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .25rem .6rem; text-align: left; border-bottom: 1px solid #ddd; }
svg { width: 100%; height: auto; } .table { overflow-x: auto; }
</style>
<h1>$title</h1>
<p>The worst of $loops loops for each controller. Below, each controller at the configuration with its least delay margin.</p>
<div class="table">
$table
</div>
$sections
</html>
""")


def margins_table(found: Sequence[Margins]) -> Table:
    """One row for each controller."""
    return Table(_HEADER, [_row(each) for each in found])


def write_margins(arm: Arm, found: Sequence[Margins], plants: Sequence[Plant], folder: Path) -> Path:
    """Writes margins.html atomically: the table, and the plots of each controller where its delay margin is least.

    Args:
        arm: The arm.
        found: The margins of its controllers, by name.
        plants: The plants over which they were found.
        folder: The folder of the file; it is made.

    Returns:
        The file.
    """
    by_name = {str(plant): plant for plant in (plants or (NOMINAL,))}
    sections = []
    for each in found:
        loop = linearize(arm, each.controller, each.delay.q, by_name[each.delay.plant])
        svg = figure_svg(lambda figure, loop=loop: draw_loop(figure, loop), (13, 4.6))
        sections.append(f"<h2>{html.escape(each.controller)}</h2>{svg}")
    page = _PAGE.substitute(
        title=html.escape(f"Margins of controllers on {arm.name}"),
        loops=found[0].loops,
        table=margins_table(found).html(),
        sections="\n".join(sections),
    )
    path = folder / "margins.html"
    write_text(path, page)
    return path


def _row(margins: Margins) -> list[str]:
    delay = margins.delay.value
    return [
        margins.controller,
        _text(1e3 * delay, ".1f"),
        str(int(delay / margins.dt)) if isfinite(delay) else "-",
        _text(margins.gain.value, ".3g"),
        _text(degrees(margins.phase.value), ".0f"),
        _text(margins.peak_sensitivity.value, ".2f"),
        " ".join(f"{x:.2f}" for x in margins.delay.q),
        margins.reason,
    ]


def _text(value: float, digits: str) -> str:
    return format(value, digits) if isfinite(value) else "inf"
