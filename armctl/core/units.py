"""Units of joint quantities: rad and N m for hinge joints, m and N for slide joints."""

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

# Joint positions that are further outside their limits are taken for another unit.
_FAR_RAD = math.pi
_FAR_M = 1.0


def of_joints(slides: Iterable[bool]) -> tuple[str, ...]:
    """The unit of each joint's position, "rad" or "m", from whether the joint slides."""
    return tuple("m" if each else "rad" for each in slides)


def of_torque(units: Iterable[str]) -> tuple[str, ...]:
    """The unit of each joint's torque, "N m" or "N", from the unit of its position."""
    return tuple("N" if unit == "m" else "N m" for unit in units)


def far(units: Iterable[str]) -> NDArray[np.float64]:
    """How far outside its limits each joint's position is so far that it is taken for another unit, rad or m."""
    return np.array([_FAR_M if unit == "m" else _FAR_RAD for unit in units])


def question(unit: str, excess: float, remedy: str = "") -> str:
    """The question whether a joint's position has another unit, to append to a sentence.

    Args:
        unit: The unit of the joint's position.
        excess: In this unit, by which the position is outside the limits.
        remedy: What to do; by default how to convert it.

    Returns:
        The question; empty if the position is not far outside.
    """
    if not excess > far([unit])[0]:
        return ""
    if unit == "m":
        return f"; millimetres? {remedy or 'slide joints are in m'}"
    return f"; degrees? {remedy or 'np.radians converts them'}"


def label(units: Iterable[str], per: str = "") -> str:
    """The units of all joints for a plot's axis or a column's head, such as "rad/s" or "rad/s or m/s"."""
    return " or ".join(unit + per for unit in dict.fromkeys(units))


def above_text(metres: float, bound: float) -> str:
    """A length beside its bound in a sentence: "just over 1 mm" where a larger one would read as the bound itself."""
    text = length_text(metres)
    return f"just over {text}" if metres > bound and text == length_text(bound) else text


def length_text(metres: float) -> str:
    """A length of three digits for a sentence or a table: "<1 nm", "12 nm", "3.45 mm" or "2.07 m"."""
    if metres < 1e-9:
        return "<1 nm"
    if metres < 1e-6:
        return f"{1e9 * metres:.0f} nm"
    if metres < 0.9995:
        return f"{1e3 * metres:.3g} mm"
    return f"{metres:.3g} m" if not 999.5 <= metres < 1e6 else f"{metres:.0f} m"
