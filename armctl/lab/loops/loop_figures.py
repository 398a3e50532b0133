"""The drawing of a loop of an arm: panels with its Bode and Nyquist plots, step response, sensitivity and compliance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.core.plotting import COLORS
from armctl.core.validation import Array
from armctl.lab.loops.loop_responses import BOUND, Bode, Nyquist, StepResponse, draw_bode, draw_nyquist, draw_step
from armctl.lab.loops.state_space import ComplexArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOOP_SIZE_INCHES = (13.0, 7.4)


class DrawnLoop(Protocol):
    """What is drawn of the loop of an arm."""

    @property
    def n(self) -> int: ...

    @property
    def title(self) -> str: ...

    def bode(self) -> Bode: ...

    def nyquist(self, w: Array) -> Nyquist: ...

    def step_response(self) -> StepResponse: ...

    def sensitivity(self, w: Array) -> ComplexArray: ...

    def compliance(self, w: Array) -> Array: ...


def draw_loop(figure: Figure, loop: DrawnLoop, *, title: bool = True) -> None:
    """Six panels: loop gain and phase, Nyquist curve, step response, sensitivity of each joint, and the tip's compliance."""
    panels = figure.subplot_mosaic([["gain", "nyquist", "sensitivity"], ["phase", "step", "compliance"]])
    bode = loop.bode()
    draw_bode([panels["gain"], panels["phase"]], bode)
    panels["gain"].set_title("loop gain |L| of each joint, the others closed")
    panels["phase"].set_title("phase, deg")
    draw_nyquist(panels["nyquist"], loop.nyquist(bode.w))
    panels["nyquist"].set_title(f"Nyquist (circle: Ms = {MAX_PEAK_SENSITIVITY:g})")
    draw_step(panels["step"], loop.step_response())
    panels["step"].set_title("step response of the closed loop")
    sensitivity = panels["sensitivity"]
    hertz = bode.w / (2 * np.pi)
    diagonal = np.abs(np.diagonal(loop.sensitivity(bode.w), axis1=1, axis2=2))
    for i in range(loop.n):
        sensitivity.loglog(hertz, diagonal[:, i], color=COLORS[i % len(COLORS)])
    sensitivity.axhline(1.0, **BOUND)
    sensitivity.set_title("sensitivity |S| of each joint")
    sensitivity.set_xlabel("frequency, Hz")
    compliance = panels["compliance"]
    compliance.loglog(hertz, 1e6 * loop.compliance(bode.w), color=COLORS[0])
    compliance.set_title("compliance of the tip, worst direction, um/N")
    compliance.set_xlabel("frequency, Hz")
    lines, names = panels["gain"].get_legend_handles_labels()
    legend = panels["gain"].get_legend()
    if legend is not None:
        legend.remove()
    for name in ("gain", "phase", "step"):
        panels[name].set_ylabel("")  # the title says it
    figure.legend(lines, names, loc="outside lower center", ncols=min(loop.n, 8))
    if title:
        figure.suptitle(loop.title, fontweight="bold", x=0.01, ha="left")
