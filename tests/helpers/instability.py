"""Whether the simulation of an arm at rest is unstable with a delay: a small deviation grows instead of decaying."""

from dataclasses import replace

import numpy as np

import armctl
from armctl.control import controller_by_name
from armctl.control.interface import traits
from armctl.core.trajectory import Setpoint
from armctl.lab.identification.frequency_response import Excited, standstill
from armctl.lab.loops.loop import Loop

DEVIATION = 1e-6  # rad, small enough for the linear model


def grows(
    arm: armctl.Arm, controller: armctl.Controller | str, loop: Loop, ticks: int, plant: armctl.Plant | None = None
) -> bool:
    """Simulates a controller that holds the arm near a loop's configuration, with a delay of some ticks."""
    radius = loop.delayed(ticks).margins().spectral_radius
    steps = int(np.clip(8 / abs(np.log(radius)), 1000, 30000))
    plant = replace(plant or armctl.Plant(), timestep=loop.dt, delay=ticks)
    law = controller_by_name(controller, arm) if isinstance(controller, str) else controller
    held = Excited(law, loop.holding_torque, 0, np.zeros(1))
    rest = np.zeros(arm.n)
    sim = armctl.Simulation(arm, held, plant)
    sim.reset(loop.q)
    # The torque that is added for equilibrium follows from the first call: here as measured at rest, before the kick.
    seen = sim.measured_state._replace(t=-1.0)
    at = loop.q if traits(law).needs_deflection else seen.q  # where what it controls rests: the links, or the motors
    held.torque(seen, Setpoint(at, rest, rest, rest, rest))
    kick = np.random.default_rng(0).normal(size=arm.n) * DEVIATION
    sim.reset(loop.q + kick)
    log = sim.run(standstill(arm, at, steps * loop.dt))
    if log.failure:
        return True
    deviation = np.abs(log.q - loop.q).max(axis=1)
    if deviation.max() > 1e4 * DEVIATION:
        return True
    quarter = len(deviation) // 4
    if deviation[-quarter:].max() < 1e-6 * DEVIATION:  # what is left is rounding
        return False
    return deviation[-quarter:].max() > deviation[quarter : 2 * quarter].max()
