"""Randomization: attributes of the plant and of the loose object that are drawn from ranges, for each episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.validation import instance, number
from armctl.lab.study.factors import Range
from armctl.run.sim.plant import PLANT_ATTRIBUTES, Plant
from armctl.run.sim.plant_attribute import Kind

_OF_PLANT = tuple(name for name, attribute in PLANT_ATTRIBUTES.items() if attribute.varies_in_episodes)
_OF_OBJECT = ("object_size", "object_mass", "object_friction")


class ObjectFactors(NamedTuple):
    """How the loose object differs from its model."""

    object_size: float = 1.0  # factor on its lengths
    object_mass: float | None = None  # kg; None for that of the model
    object_friction: float | None = None  # coefficient of friction; None for that of the model


@dataclass(frozen=True)
class Randomization:
    """Ranges from which each episode draws."""

    plant: Mapping[str, Range]  # ranges of attributes of a plant
    object: Mapping[str, Range]  # ranges of attributes of the loose object

    @classmethod
    def read(cls, ranges: object, *, has_object: bool) -> Randomization:
        """Ranges from a caller's mapping or None, checked: for the plant, and for the loose object if there is one."""
        instance("randomize", {} if ranges is None else ranges, Mapping, "{'payload': armctl.Range(0.0, 0.5)} is one")
        given: dict[str, Range] = dict(cast(Mapping[str, Range], ranges or {}))
        allowed = (*_OF_PLANT, *(_OF_OBJECT if has_object else ()))
        for name, each in given.items():
            if name not in {*_OF_OBJECT, *PLANT_ATTRIBUTES}:
                raise UnknownNameError.from_known("attribute that can vary", f"{name!s:.80}", allowed)
            if name not in allowed:
                raise InputError(f"randomize: {name} cannot vary; {', '.join(allowed)} can")
            instance(f"randomize: {name}", each, Range, "armctl.Range(0.0, 0.5) is one")
            if name in _OF_OBJECT:
                number(f"randomize: {name}: low", each.low, 1e-6)
            else:
                _plant({name: each.low})
        return cls(
            plant={name: each for name, each in given.items() if name in _OF_PLANT},
            object={name: each for name, each in given.items() if name in _OF_OBJECT},
        )

    @property
    def is_noisy(self) -> bool:
        return "encoder_noise" in self.plant

    @property
    def max_delay(self) -> int:
        """The greatest delay of commands, ticks."""
        return int(self.plant["delay"].high) if "delay" in self.plant else 0

    def draw_plant(self, rng: np.random.Generator) -> Plant | None:
        """A plant; None if it does not vary."""
        if not self.plant:
            return None
        return _plant({name: _value(name, each, rng) for name, each in self.plant.items()})

    def draw_object(self, rng: np.random.Generator) -> ObjectFactors | None:
        """What the loose object is like; None if it does not vary."""
        if not self.object:
            return None
        return ObjectFactors(**{name: each.at(rng.random()) for name, each in self.object.items()})


def _value(name: str, each: Range, rng: np.random.Generator) -> float:
    """A number within a range; a whole number has the same probability as each other."""
    if not _is_whole_number(name):
        return each.at(rng.random())
    return min(each.low + rng.random() * (each.high - each.low + 1.0), each.high)


def _plant(values: dict[str, Any]) -> Plant:
    """A plant with these attributes; whole numbers are rounded down."""
    rounded: dict[str, Any] = {name: int(value) if _is_whole_number(name) else value for name, value in values.items()}
    return Plant(**rounded)


def _is_whole_number(name: str) -> bool:
    return PLANT_ATTRIBUTES[name].kind is Kind.WHOLE_NUMBER
