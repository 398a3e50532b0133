"""Units of joint quantities: rad and N m for hinge joints, m and N for slide joints."""

from __future__ import annotations

from collections.abc import Iterable


def of_joints(slides: Iterable[bool]) -> tuple[str, ...]:
    """The unit of each joint's position, "rad" or "m", from whether the joint slides."""
    return tuple("m" if each else "rad" for each in slides)


def of_torque(units: Iterable[str]) -> tuple[str, ...]:
    """The unit of each joint's torque, "N m" or "N", from the unit of its position."""
    return tuple("N" if unit == "m" else "N m" for unit in units)


def label(units: Iterable[str], per: str = "") -> str:
    """The units of all joints for a plot's axis or a column's head, such as "rad/s" or "rad/s or m/s"."""
    return " or ".join(unit + per for unit in dict.fromkeys(units))
