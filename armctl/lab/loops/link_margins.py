"""Whether a robot's link can bear a controller: the margins that are left at its delay."""

from __future__ import annotations

import math

import numpy as np

from armctl.control import CONTROLLERS
from armctl.control.interface import WRENCH_SIZE, Controller, State, traits
from armctl.core.defaults import MIN_DELAY_MARGIN_S
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.lab.loops.linearization import Linearizer
from armctl.lab.loops.margins import judged_configurations
from armctl.model.arm.arm import Arm
from armctl.run.sim.plant import Plant

MAX_LINK_SENSITIVITY = 2.0  # Ms at the delay of a link; default gains are designed for less without a delay
_FURTHER_CONFIGURATIONS = 5  # besides the present one
_LEAST_DELAY_MARGIN_TICKS = 1
_WHOLE_TICK = 1e-6  # of a tick: a delay that is so near to a number of ticks is that number
_MAX_GROWTH = 1.0  # 1/s, of a deviation under a law that lets the arm float: dry friction stops a slower one


def why_not_borne(arm: Arm, controller: Controller, q: Array, dt: float, delay: float, lag: float) -> str:
    """Why a robot must not have a controller; empty if it may.

    At the delay of its link, the loop must stay stable with one tick more, and its peak sensitivity must be at most 2. A law
    that yields by design need not have that sensitivity, which its soft springs raise at low frequencies. A law without
    springs must not make deviations grow. A law that needs the force on the tip is judged in free space.

    Args:
        q: (n,) rad, the present configuration, which is judged besides home and random ones.
        dt: s, the tick.
        delay: s, from a command to the torque.
        lag: s, the time constant of the robot's filter of torques.

    Raises:
        ModelError: The controller fails at a configuration, or no linear model describes it.
    """
    own = traits(controller)
    linearizer = Linearizer(arm, plant_behind_link(dt, delay, lag))
    where = f"at the link's delay of {1e3 * linearizer.plant.delay * dt:.3g} ms" + (
        f" and lag of {1e3 * lag:.3g} ms" if lag else ""
    )
    remedy = "lower its gains"
    named = CONTROLLERS.get(own.name)
    if named is not None and named.tunable_gains is not None:
        remedy = (
            f"armctl.tune(arm, {own.name!r}, delay_margin={MIN_DELAY_MARGIN_S:g}, plants=[armctl.{linearizer.plant!r}]) "
            "finds gains for it"
        )
    judged = _InFreeSpace(controller) if own.needs_wrench else controller
    for configuration in np.vstack([arm.limits.clamp(q)[None], judged_configurations(arm, _FURTHER_CONFIGURATIONS)]):
        loop = linearizer.loop_at(judged, configuration)
        found = loop.robustness()
        if own.yields and not found.ok:  # an arm that floats is at the border of stability
            late = loop.delayed(loop.delay + _LEAST_DELAY_MARGIN_TICKS).robustness()
            if late.spectral_radius <= 1.0 + _MAX_GROWTH * dt:
                continue
        reason = ""
        if not found.ok:
            reason = f"{own.name:.80} is unstable {where}"
        elif found.delay_margin < _LEAST_DELAY_MARGIN_TICKS * dt:
            reason = (
                f"{own.name:.80} has a delay margin of {1e3 * found.delay_margin:.2g} ms {where}, "
                f"at least {1e3 * _LEAST_DELAY_MARGIN_TICKS * dt:.3g} ms"
            )
        elif not own.yields and found.peak_sensitivity > MAX_LINK_SENSITIVITY:
            figure = f"{found.peak_sensitivity:.3g} {where}, at most {MAX_LINK_SENSITIVITY:g}"
            reason = f"{own.name:.80} has a peak sensitivity of {figure}"
        if reason:
            return f"controller: {reason} (q = {np.round(configuration, 2).tolist()}); {remedy}"
    return ""


def plant_behind_link(dt: float, delay: float, lag: float) -> Plant:
    """The plant that is like a robot behind a link with a tick of dt s, a delay and a lag of its torques, s each."""
    ticks = max(0, math.ceil(delay / dt - _WHOLE_TICK))
    return Plant(delay=ticks, motor=lag, timestep=dt, continuous=True)


class _InFreeSpace:
    """A controller whose tip touches nothing."""

    def __init__(self, controller: Controller):
        self.name = traits(controller).name
        self._controller = controller

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        return self._controller.torque(state._replace(wrench=np.zeros(WRENCH_SIZE)), setpoint)
