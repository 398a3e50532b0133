"""PlantAttribute: what one attribute of a Plant may be, and how a text names it. `Plant` is the table of them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, as_array, choice, inertia_tensor, instance, integer, number, read_only, vector

_FIELD_KEY = "plant attribute"


class Kind(Enum):
    """The kind of an attribute's values."""

    NUMBER = "number"
    WHOLE_NUMBER = "whole number"
    PER_JOINT = "a number for all joints, or one for each"
    POINT = "three numbers"
    INERTIA = "three moments, or a symmetric (3, 3) matrix"
    FLAG = "True or False"
    WORD = "one of some words"
    OTHER = "read by the plant itself"


@dataclass(frozen=True)
class PlantAttribute:
    """A row of the table of a plant's attributes."""

    kind: Kind
    default: Any  # in the nominal plant
    unit: str = ""  # for labels; empty for none
    low: float = -math.inf
    high: float = math.inf
    words: tuple[str, ...] = ()  # that it may be
    # how a text names a value, such as "payload {} kg"; empty if only other attributes tell that the plant differs
    phrase: str = ""
    scale: float = 1.0  # factor on the number in the phrase
    only_with: tuple[str, ...] = ()  # attributes of which one must differ from its default, so that this one matters
    disturbs_signals: bool = False  # disturbs measurements or commands during a run
    is_factor: bool = True  # can be a factor of a study
    varies_in_episodes: bool = False  # can be drawn by the episodes of an environment

    @cached_property
    def checked_default(self) -> Any:
        """The default as `read` returns it, which all plants share."""
        value = self._read("default", self.default)
        return read_only(value) if isinstance(value, np.ndarray) else value

    def read(self, name: str, value: Any) -> Any:
        """A value as a caller gave it, checked; a value that is not read here is returned as it is."""
        return self.checked_default if value is self.default else self._read(name, value)

    def _read(self, name: str, value: Any) -> Any:
        if self.default is None and value is None:
            return None
        match self.kind:
            case Kind.NUMBER:
                return number(name, value, self.low, self.high)
            case Kind.WHOLE_NUMBER:
                return self._read_whole(name, value)
            case Kind.PER_JOINT:
                return _per_joint(name, value, self.low)
            case Kind.POINT:
                return vector(name, value, 3)
            case Kind.INERTIA:
                return inertia_tensor(name, value)
            case Kind.WORD:
                return choice(name, value, self.words)
            case Kind.FLAG:
                instance(name, value, bool, "True or False is one")
        return value

    def _read_whole(self, name: str, value: Any) -> int:
        try:
            return integer(name, value, self.low, self.high)
        except InputError as error:
            if self.unit != "ticks":
                raise
            unit = "the unit is ticks, that is control periods: divide a time in seconds by the control period"
            raise InputError(f"{error}; {unit}") from None

    def differs(self, value: Any) -> bool:
        """Whether a checked value differs from the default."""
        if value is self.checked_default:
            return False
        if isinstance(value, tuple):
            return bool(value)
        if isinstance(value, np.ndarray) or isinstance(self.default, np.ndarray):
            return bool(np.any(value != self.default))
        return bool(value != self.default)

    def describe(self, value: Any) -> str:
        """A checked value in words."""
        if isinstance(value, tuple):
            return ", ".join(str(each) for each in value)
        if callable(value):
            return self.phrase.format(getattr(value, "__name__", type(value).__name__))
        is_number = not isinstance(value, bool | str)
        return self.phrase.format(number_text(self.scale * value) if is_number else value)


def plant_attribute(kind: Kind, default: Any, **row: Any) -> Any:
    """The field of a dataclass with a row of the table; the arguments are those of `PlantAttribute`."""
    return field(default=default, metadata={_FIELD_KEY: PlantAttribute(kind, default, **row)})


def attributes_of(plant_class: type) -> Mapping[str, PlantAttribute]:
    """The table of a class whose fields are made by `plant_attribute`."""
    return {each.name: each.metadata[_FIELD_KEY] for each in fields(plant_class)}


def number_text(value: float | Array) -> str:
    """Numbers in the fewest digits that identify them."""
    texts = [f"{x:g}" if float(f"{x:g}") == x else repr(x) for x in np.ravel(value).tolist()]
    return texts[0] if len(texts) == 1 else f"[{' '.join(texts)}]"


def _per_joint(name: str, value: ArrayLike, low: float) -> Array:
    values = vector(name, [value] if as_array(name, value).ndim == 0 else value)  # type: ignore[list-item]
    if not len(values):
        raise InputError(f"{name}: expected one number, or one for each joint, got none")
    if values.min() < low:
        raise InputError(f"{name}: every value must be at least {low:g}, got {values.min():g}")
    return values
