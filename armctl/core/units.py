"""Units of joints: angles and torques where they turn, lengths and forces where they slide."""

from __future__ import annotations

from collections.abc import Iterable


def of_joints(slides: Iterable[bool]) -> tuple[str, ...]:
    """What joints are measured in.

    Args:
        slides: For each whether it slides.

    Returns:
        For each "rad" or "m".
    """
    return tuple("m" if each else "rad" for each in slides)


def of_torque(units: Iterable[str]) -> tuple[str, ...]:
    """What the torques of joints are measured in.

    Args:
        units: What each joint is measured in, "rad" or "m".

    Returns:
        For each "N m" or "N".
    """
    return tuple("N" if unit == "m" else "N m" for unit in units)


def label(units: Iterable[str], per: str = "") -> str:
    """The units of all joints, for the axis of a plot or the head of a column.

    Args:
        units: What each joint is measured in.
        per: What follows each, such as "/s".

    Returns:
        Such as "rad/s", or "rad/s or m/s" where some slide.
    """
    return " or ".join(unit + per for unit in dict.fromkeys(units))
