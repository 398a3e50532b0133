"""Margins of controllers as a table, and as a self-contained HTML page with plots."""

from collections.abc import Callable, Sequence
from math import degrees, isfinite
from pathlib import Path

from armctl.core.atomic import write_text
from armctl.core.plotting import figure_svg
from armctl.core.tables import Table
from armctl.lab.loops.linearization import linearize
from armctl.lab.loops.loop_figures import LOOP_SIZE_INCHES, draw_loop
from armctl.lab.loops.margins import Margins
from armctl.model.arm.arm import Arm
from armctl.report import html_page
from armctl.run.sim.plant import NOMINAL, Plant

_COLUMNS: dict[str, Callable[[Margins], str]] = {
    "controller": lambda m: m.controller,
    "delay margin, ms": lambda m: _text(1e3 * m.delay.value, ".1f"),
    "in ticks": lambda m: str(int(m.delay.value / m.dt)) if isfinite(m.delay.value) else "-",
    "gain margin": lambda m: m.gain_in_words,
    "phase margin, deg": lambda m: _text(degrees(m.phase.value), ".0f"),
    "Ms": lambda m: _text(m.peak_sensitivity.value, ".2f"),
    "slowest pole, 1/s": lambda m: _text(m.slowest_pole.value, ".3g"),
    "bandwidth, rad/s": lambda m: _text(m.bandwidth, ".3g") if isfinite(m.bandwidth) else "-",
    "least damping": lambda m: _text(m.damping.value, ".2g"),
    "worst delay at q": lambda m: " ".join(f"{x:.2f}" for x in m.delay.q),
    "note": lambda m: m.reason,
}


def margins_table(found: Sequence[Margins]) -> Table:
    """One row for each controller."""
    return Table(list(_COLUMNS), [[cell(each) for cell in _COLUMNS.values()] for each in found])


def write_margins(arm: Arm, found: Sequence[Margins], plants: Sequence[Plant], path: Path) -> Path:
    """Writes a page atomically: the table, and the plots of each controller where its delay margin is least."""
    by_name = {str(plant): plant for plant in (plants or (NOMINAL,))}
    elements = []
    for each in found:
        loop = linearize(arm, each.controller, each.delay.q, by_name[each.delay.plant])
        svg = figure_svg(lambda figure, loop=loop: draw_loop(figure, loop), LOOP_SIZE_INCHES)
        elements += [html_page.heading(each.controller), svg]
    worst = f"The worst of {found[0].loops} loops for each controller."
    below = "Below, each controller at the configuration with its least delay margin."
    introduction = [html_page.paragraph(f"{worst} {below}"), html_page.table(margins_table(found))]
    write_text(path, html_page.page(f"Margins of controllers on {arm.name}", *introduction, *elements))
    return path


def _text(value: float, digits: str) -> str:
    return format(value, digits) if isfinite(value) else "inf"
