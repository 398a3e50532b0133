"""Drawings of linear loops: Bode and Nyquist plots, step responses, and a page of panels for a loop of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.core.plotting import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from armctl.lab.loops.loop import Loop
    from armctl.lab.loops.loop_responses import Bode, Nyquist, StepResponse

LOOP_SIZE_INCHES = (13.0, 7.4)
_BOUND = {"color": "#555555", "linestyle": (0, (4, 3)), "linewidth": 0.9, "zorder": 1}
_HALF_TURN_DEGREES = 180.0


def draw_bode(axes: Sequence[Axes], bode: Bode) -> None:
    """Magnitude and phase of each joint's loop over frequency, in two axes."""
    gain, phase = axes
    hertz = bode.w / (2 * np.pi)
    for i, name in enumerate(bode.names):
        color = COLORS[i % len(COLORS)]
        gain.loglog(hertz, bode.magnitude[:, i], color=color, label=name)
        phase.semilogx(hertz, np.degrees(bode.phase[:, i]), color=color)
    gain.axhline(1.0, **_BOUND)
    gain.set_ylabel("loop gain |L|")
    phase.axhline(-_HALF_TURN_DEGREES, **_BOUND)
    phase.set_ylim(-3 * _HALF_TURN_DEGREES, 0.5 * _HALF_TURN_DEGREES)
    phase.set_yticks(np.arange(-3, 1) * _HALF_TURN_DEGREES)
    phase.set_ylabel("phase, deg")
    phase.set_xlabel("frequency, Hz")
    if len(bode.names) > 1:
        gain.legend(loc="best")


def draw_nyquist(axes: Axes, nyquist: Nyquist) -> None:
    """The curves around -1."""
    for i, name in enumerate(nyquist.names):
        axes.plot(nyquist.curve[:, i].real, nyquist.curve[:, i].imag, color=COLORS[i % len(COLORS)], label=name)
    angle = np.linspace(0.0, 2 * np.pi, 200)
    axes.plot(np.cos(angle) / MAX_PEAK_SENSITIVITY - 1, np.sin(angle) / MAX_PEAK_SENSITIVITY, **_BOUND)
    axes.plot(-1.0, 0.0, marker="+", color="black")
    axes.set_xlim(-3.0, 1.0)
    axes.set_ylim(-2.0, 2.0)
    axes.set_aspect("equal")
    axes.set_xlabel("real part of L")
    axes.set_ylabel("imaginary part of L")


def draw_step(axes: Axes, response: StepResponse) -> None:
    """The responses of all joints over time."""
    for i, name in enumerate(response.names):
        axes.plot(response.t, response.y[:, i], color=COLORS[i % len(COLORS)], label=name)
    axes.set_ylabel(response.quantity + (f", {response.unit}" if response.unit else ""))
    axes.set_xlabel("time, s")


def draw_loop(figure: Figure, loop: Loop, *, title: bool = True) -> None:
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
    sensitivity.axhline(1.0, **_BOUND)
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
