"""Slowdown: what a motion says when the motors made it slower."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Slowdown:
    """That a motion was slowed because a motor would have saturated.

    Attributes:
        factor: How many times longer it takes.
        joint: The joint that would have needed most of its limit.
        torque_ratio: How much of it.
    """

    factor: float
    joint: str
    torque_ratio: float

    def __str__(self) -> str:
        return f"{self.factor:.3f} times longer, since {self.joint} would need {100 * self.torque_ratio:.0f} % of its torque"
