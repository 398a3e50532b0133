"""The page of an identification: measured and predicted torques on held-out data, and the verdict."""

from __future__ import annotations

import html
import os
from pathlib import Path
from typing import TYPE_CHECKING

from armctl.core.atomic import file_path, write_text
from armctl.core.plotting import COLORS, figure_svg
from armctl.core.tables import Table
from armctl.core.validation import instance
from armctl.lab.identification.arm_estimate import ArmEstimate
from armctl.report import html_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def identification_page(estimate: ArmEstimate, path: str | os.PathLike[str]) -> Path:
    """Writes a page with the result of `identify`: measured and predicted torque of each joint on held-out data.

    Args:
        estimate: The result; also one that is not ok.
        path: The .html file, which needs no other files. It is written atomically, and its folder is made.

    Raises:
        ArmctlError: The file cannot be written.
    """
    instance("estimate", estimate, ArmEstimate, "armctl.identify(arm, log) returns one")
    path = file_path("path", path, (".html",))
    facts = (
        f"{len(estimate.base_names)} base parameters, condition number {estimate.condition_number:.3g}. "
        f"Zero-phase filter of {estimate.cutoff:.3g} Hz, chosen from the data. "
        f"Torques are recorded {1e3 * estimate.delay:.2f} ms after positions. Friction model: {estimate.friction}."
    )
    verdict = html_page.paragraph("Identified.") if estimate else html_page.remark(f"Not identified: {estimate.reason}.")
    elements = [verdict, html_page.paragraph(facts), html_page.table(_table(estimate))]
    if estimate.findings:
        findings = "".join(f"<li>{html.escape(line)}</li>" for line in estimate.findings)
        elements += [html_page.heading("Differences from the model"), f"<ul>{findings}</ul>"]
    figure = figure_svg(lambda figure: _draw(figure, estimate), (11, 1.7 * estimate.arm.n + 0.6))
    elements += [html_page.heading("Torques on held-out data"), figure]
    write_text(path, html_page.page(f"Identification of {estimate.arm.name}", *elements))
    return path


def _table(estimate: ArmEstimate) -> Table:
    validation = estimate.validation
    rows = [
        {
            "joint": name,
            "held-out error": f"{validation.rms[i]:.3g} {unit}",
            "of its deviation": f"{100 * validation.relative[i]:.1f} %",
            "error of the model": f"{validation.model_rms[i]:.3g} {unit}",
            "Coulomb": f"{estimate.coulomb_friction[i]:.3g} +- {estimate.coulomb_error[i]:.1g}",
            "viscous": f"{estimate.viscous_friction[i]:.3g} +- {estimate.viscous_error[i]:.1g}",
            "rotor inertia": f"{estimate.rotor_inertia[i]:.3g} +- {estimate.rotor_inertia_error[i]:.1g}",
            "offset": f"{estimate.torque_offset[i]:.3g}",
        }
        for i, (name, unit) in enumerate(zip(estimate.arm.joint_names, estimate.arm.torque_units, strict=True))
    ]
    return Table(list(rows[0]), [list(row.values()) for row in rows])


def _draw(figure: Figure, estimate: ArmEstimate) -> None:
    validation = estimate.validation
    panels = figure.subplots(estimate.arm.n, 1, sharex=True, squeeze=False)[:, 0]
    for i, (panel, name) in enumerate(zip(panels, estimate.arm.joint_names, strict=True)):
        panel.plot(validation.t, validation.measured[:, i], color="black", label="measured")
        panel.plot(validation.t, validation.predicted[:, i], color=COLORS[1], label="predicted")
        panel.plot(validation.t, validation.by_model[:, i], color=COLORS[5], linewidth=0.8, label="model before")
        panel.set_title(f"{name}, {estimate.arm.torque_units[i]}")
    panels[-1].set_xlabel("time, s")
    panels[0].legend(loc="best", ncols=3)
