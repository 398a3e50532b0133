"""Plants by name, for the command line: `payload=1`, `friction`, `delay=2`, `noise`, or all at once."""

from dataclasses import replace

import numpy as np

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.validation import number
from armctl.model.arm.arm import Arm
from armctl.run.sim.plant import ENCODER_NOISE_RAD, NOMINAL, PLANT_ATTRIBUTES, Plant
from armctl.run.sim.plant_attribute import Kind

_FRICTION = 0.02  # Coulomb friction as a fraction of the torque limit; viscous friction is half of that per rad/s
_DEFAULT = {"payload": 1.0, "mass": 1.2, "friction": _FRICTION, "delay": 2.0, "noise": 1.0}
_WORDS = {
    "nominal": "the model",
    "mass": "factor on the links' masses (1.2)",
    "friction": "Coulomb friction as a fraction of the torque limit, half as much viscous per rad/s (0.02); or coulomb, lugre",
    "noise": "noise of encoders, times 1e-5 rad (1); velocities are position differences",
    "all": "payload, mass, friction, delay and noise at once",
}
_THREE = (Kind.POINT, Kind.INERTIA)  # numbers, with this between them
_BETWEEN = ":"
_KINDS = (Kind.NUMBER, Kind.WHOLE_NUMBER, Kind.PER_JOINT, Kind.WORD, Kind.FLAG, *_THREE)
_ATTRIBUTES = {name: each for name, each in PLANT_ATTRIBUTES.items() if each.is_factor and each.kind in _KINDS}
PLANTS = (*_WORDS, *_ATTRIBUTES)


def plant_by_name(text: str, arm: Arm, timestep: float | None = None) -> Plant:
    """A plant from names of `PLANTS`, such as "payload=1" or "payload=0.5+delay"; without a value, a name has its default."""
    plant = replace(NOMINAL, timestep=timestep)
    for word in text.split("+"):
        name, _, value = word.partition("=")
        if name not in PLANTS:
            raise UnknownNameError.from_known("plant", name, PLANTS)
        for each in ("payload", "mass", "friction", "delay", "noise") if name == "all" and not value else (name,):
            try:
                plant = _with(plant, each, value, arm)
            except InputError as error:
                raise InputError(f"plant {word}: {error}") from None
    # Friction is a number for each joint, which no table has room for: such a plant is called by the words that describe it.
    has_friction = bool(np.any(plant.coulomb_friction))
    return replace(plant, name=text) if has_friction else plant


def _with(plant: Plant, name: str, value: str, arm: Arm) -> Plant:
    if name in ("nominal", "all") or (name in _ATTRIBUTES and _ATTRIBUTES[name].kind is Kind.FLAG):
        if value:
            raise InputError(f"{name!r} takes no value")
        return plant if name == "nominal" else replace(plant, **{name: True})
    attribute = PLANT_ATTRIBUTES.get(name)
    if attribute is not None and attribute.kind is Kind.WORD and (name not in _WORDS or value in attribute.words):
        return replace(plant, **{name: value})
    if attribute is not None and attribute.kind in _THREE:
        return replace(plant, **{name: [_number(name, each) for each in value.split(_BETWEEN)]})
    amount = _number(name, value)
    if name == "friction":
        dry = amount * arm.limits.tau_max
        return replace(plant, coulomb_friction=dry, viscous_friction=0.5 * dry)
    if name == "noise":
        return replace(plant, encoder_noise=amount * ENCODER_NOISE_RAD)
    return replace(plant, **{"mass_scale" if name == "mass" else name: amount})


def _number(name: str, text: str) -> float:
    if not text and name in _DEFAULT:
        return _DEFAULT[name]
    if not text:
        example = _BETWEEN.join("000") if name in _ATTRIBUTES and _ATTRIBUTES[name].kind in _THREE else "1"
        raise InputError(f"{name!r} needs a value, as in '{name}={example}'")
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{text!r:.80} is not a number") from None
    return number(name, value)
