"""Functions that the top-level package provides to lower layers, so that these import nothing from above them."""

from collections.abc import Callable
from typing import Any

# Opens the browser page that observes a simulation; takes an Arm and returns a `run.sim.stepper.Observer`.
open_viewer: Callable[[Any], Any] | None = None
instability: Callable[..., str]  # of an arm, a controller, a configuration and a plant: what a reason says besides
# Of an arm, a controller, a configuration (n,) rad, a tick, a delay and a lag, s: why a robot cannot bear it; empty if it can.
why_not_borne: Callable[..., str]
