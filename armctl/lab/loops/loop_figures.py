"""The drawing of a loop of an arm: panels with its Bode and Nyquist plots, step response, sensitivity and compliance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.core.plotting import COLORS, AxesLayout, draw_axes
from armctl.core.validation import Array
from armctl.lab.loops.loop_responses import BOUND, Bode, Nyquist, StepResponse, draw_bode, draw_nyquist, draw_step
from armctl.lab.loops.state_space import ComplexArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOOP_SIZE_INCHES = (13.0, 7.4)
LOOP_PANELS = (2, 3)


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


def draw_loop(figure: Figure, loop: DrawnLoop) -> None:
    """Draws the panels of a loop into a new figure."""
    draw_axes(figure, lambda axes: draw_loop_panels(axes, loop), LOOP_PANELS, loop_layout(loop, title=True))


def loop_layout(loop: DrawnLoop, *, title: bool) -> AxesLayout:
    """How the figure of a loop looks."""
    return AxesLayout(title=loop.title if title else "", legend_columns=8, sharex=False)


def draw_loop_panels(axes: Sequence[Axes], loop: DrawnLoop) -> None:
    """Six panels: loop gain, Nyquist curve and sensitivity of each joint; phase, step response, and the tip's compliance."""
    gain, nyquist, sensitivity, phase, step, compliance = axes
    bode = loop.bode()
    draw_bode([gain, phase], bode)
    gain.set_title("loop gain |L| of each joint, the others closed")
    phase.set_title("phase, deg")
    draw_nyquist(nyquist, loop.nyquist(bode.w))
    nyquist.set_title(f"Nyquist (circle: Ms = {MAX_PEAK_SENSITIVITY:g})")
    draw_step(step, loop.step_response())
    step.set_title("step response of the closed loop")
    hertz = bode.w / (2 * np.pi)
    diagonal = np.abs(np.diagonal(loop.sensitivity(bode.w), axis1=1, axis2=2))
    for i in range(loop.n):
        sensitivity.loglog(hertz, diagonal[:, i], color=COLORS[i % len(COLORS)])
    sensitivity.axhline(1.0, **BOUND)
    sensitivity.set_title("sensitivity |S| of each joint")
    sensitivity.set_xlabel("frequency, Hz")
    compliance.loglog(hertz, 1e6 * loop.compliance(bode.w), color=COLORS[0])
    compliance.set_title("compliance of the tip, worst direction, um/N")
    compliance.set_xlabel("frequency, Hz")
    legend = gain.get_legend()
    if legend is not None:
        legend.remove()
    for panel in (gain, phase, step):
        panel.set_ylabel("")  # the title says it
