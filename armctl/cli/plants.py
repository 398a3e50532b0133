"""Plants by name, for the command line: `payload=1`, `friction`, `delay=2`, `noise`, or all at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.validation import number
from armctl.robot.arm import Arm
from armctl.sim.plant import NOMINAL, Plant

_ENCODER_NOISE_RAD = 1e-5
_FRICTION = 0.02  # Coulomb friction as a fraction of the torque limit; viscous friction is half of that per rad/s
_DEFAULT = {"payload": 1.0, "mass": 1.2, "friction": _FRICTION, "delay": 2.0, "noise": 1.0, "ripple": 0.02}
PLANTS = {
    "nominal": "the model",
    "payload": "mass at the tip that is missing in the controller's model, kg (1)",
    "mass": "factor on the links' masses (1.2)",
    "friction": "Coulomb friction as a fraction of the torque limit, and half as much viscous friction per rad/s (0.02)",
    "delay": "delay of commands, ticks (2)",
    "noise": "noise of encoders, times 1e-5 rad (1); velocities are position differences",
    "ripple": "torque ripple as a fraction of the torque (0.02)",
    "continuous": "simulate with smaller steps between ticks",
    "all": "payload, mass, friction, delay and noise at once",
}


def plant_by_name(text: str, arm: Arm, timestep: float | None = None) -> Plant:
    """A plant from words such as "payload=1" or "payload=0.5+delay=1".

    Args:
        text: Names from `PLANTS`, joined with "+", with "=" and a value, or without for the default.
        arm: The arm, whose torque limits friction is measured by.
        timestep: s, the tick; None for the model's.

    Returns:
        The plant.

    Raises:
        UnknownNameError: There is none of that name.
        InputError: A value is no number, or out of its bounds.
    """
    plant = replace(NOMINAL, timestep=timestep)
    for word in text.split("+"):
        name, _, value = word.partition("=")
        if name not in PLANTS:
            raise UnknownNameError.of("plant", name, PLANTS)
        if value and name not in _DEFAULT:
            raise InputError(f"plant: {name!r} takes no value, {word!r} given")
        for each in ("payload", "mass", "friction", "delay", "noise") if name == "all" else (name,):
            try:
                plant = _with(plant, each, _value(each, value), arm)
            except InputError as error:
                raise InputError(f"plant {word}: {error}") from None
    # Friction is a number for each joint, which no table has room for: such a plant is called by the words that describe it.
    has_friction = bool(np.any(plant.coulomb_friction))
    return replace(plant, name=text) if has_friction else plant


def _value(name: str, text: str) -> float:
    if not text:
        return _DEFAULT.get(name, 0.0)
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{text!r:.80} is not a number") from None
    return number(name, value)


def _with(plant: Plant, name: str, value: float, arm: Arm) -> Plant:
    if name == "friction":
        dry = value * arm.limits.tau_max
        return replace(plant, coulomb_friction=dry, viscous_friction=0.5 * dry)
    if name == "noise":
        return replace(plant, encoder_noise=value * _ENCODER_NOISE_RAD)
    field = {"payload": "payload", "mass": "mass_scale", "delay": "delay", "ripple": "torque_ripple"}.get(name)
    if field is not None:
        return replace(plant, **{field: value})
    return replace(plant, continuous=True) if name == "continuous" else plant
