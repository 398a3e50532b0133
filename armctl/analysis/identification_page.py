"""The page of an identification: measured and predicted torques on held-out data, and the verdict."""

from __future__ import annotations

import html
import io
import os
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from armctl.analysis.plot import COLORS, STYLE
from armctl.core.atomic import file_path, write_text
from armctl.core.tables import Table
from armctl.core.validation import instance
from armctl.design.arm_estimate import ArmEstimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAGE = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child { text-align: left; }
.remark { color: #a33; } svg { width: 100%; height: auto; } .table { overflow-x: auto; }
</style>
<h1>$title</h1>
<p class="$kind">$verdict</p>
<p>$facts</p>
<div class="table">
$table
</div>
$findings
<h2>Torques on held-out data</h2>
$figure
</html>
""")


def identification_page(estimate: ArmEstimate, path: str | os.PathLike[str]) -> Path:
    """Writes a page with the result of `identify`: measured and predicted torque of each joint on held-out data.

    Args:
        estimate: The result; also one that is not ok.
        path: The .html file, which needs no other files. It is written atomically, and its folder is made.

    Returns:
        The path.

    Raises:
        InputError: It is no estimate, or the path has another file extension.
        ArmctlError: The file cannot be written.
    """
    instance("estimate", estimate, ArmEstimate, "armctl.identify(arm, log) returns one")
    path = file_path("path", path, (".html",))
    findings = "".join(f"<li>{html.escape(line)}</li>" for line in estimate.findings)
    facts = (
        f"{len(estimate.base_names)} base parameters, condition number {estimate.condition_number:.3g}. "
        f"Zero-phase filter of {estimate.cutoff:.3g} Hz, chosen from the data. "
        f"Torques are recorded {1e3 * estimate.delay:.2f} ms after positions. Friction model: {estimate.friction}."
    )
    text = _PAGE.substitute(
        title=html.escape(f"Identification of {estimate.arm.name}"),
        kind="ok" if estimate else "remark",
        verdict=html.escape("Identified." if estimate else f"Not identified: {estimate.reason}."),
        facts=html.escape(facts),
        table=_table(estimate).html(),
        findings=f"<h2>Differences from the model</h2><ul>{findings}</ul>" if findings else "",
        figure=_svg(estimate),
    )
    write_text(path, text)
    return path


def _table(estimate: ArmEstimate) -> Table:
    """One row for each joint."""
    columns = [
        "joint",
        "held-out error",
        "of its deviation",
        "error of the model",
        "Coulomb",
        "viscous",
        "rotor inertia",
        "offset",
    ]
    validation = estimate.validation
    rows = []
    for i, name in enumerate(estimate.arm.joint_names):
        unit = estimate.arm.torque_units[i]
        rows.append(
            [
                name,
                f"{validation.rms[i]:.3g} {unit}",
                f"{100 * validation.relative[i]:.1f} %",
                f"{validation.model_rms[i]:.3g} {unit}",
                f"{estimate.coulomb_friction[i]:.3g} +- {estimate.coulomb_error[i]:.1g}",
                f"{estimate.viscous_friction[i]:.3g} +- {estimate.viscous_error[i]:.1g}",
                f"{estimate.rotor_inertia[i]:.3g} +- {estimate.rotor_inertia_error[i]:.1g}",
                f"{estimate.torque_offset[i]:.3g}",
            ]
        )
    return Table(columns, rows)


def _svg(estimate: ArmEstimate) -> str:
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 1.7 * estimate.arm.n + 0.6), layout="constrained")
        _draw(figure, estimate)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _draw(figure: Figure, estimate: ArmEstimate) -> None:
    """A panel for each joint."""
    validation = estimate.validation
    panels = figure.subplots(estimate.arm.n, 1, sharex=True, squeeze=False)[:, 0]
    for i, (panel, name) in enumerate(zip(panels, estimate.arm.joint_names, strict=True)):
        panel.plot(validation.t, validation.measured[:, i], color="black", label="measured")
        panel.plot(validation.t, validation.predicted[:, i], color=COLORS[1], label="predicted")
        panel.plot(validation.t, validation.by_model[:, i], color=COLORS[5], linewidth=0.8, label="model before")
        panel.set_title(f"{name}, {estimate.arm.torque_units[i]}")
    panels[-1].set_xlabel("time, s")
    panels[0].legend(loc="best", ncols=3)
