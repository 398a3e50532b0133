"""Where a wrench sensor sits, and what it measures, without anything that takes long to load."""

from __future__ import annotations

from typing import NamedTuple

from armctl.core.validation import Array
from armctl.robot.arm import Arm
from armctl.robot.packed_dynamics import PackedDynamics
from armctl.sim.plant import Plant


class Site(NamedTuple):
    """Where an arm's wrench acts, without the arm itself: a waiting simulation must not keep it.

    Attributes:
        last_body: Behind the arm's last joint.
        tip_body: The body of the tip.
        offset: (3,) m, the tip in that body.
        dynamics: The nominal dynamics of the arm.
    """

    last_body: int
    tip_body: int
    offset: Array
    dynamics: PackedDynamics

    @classmethod
    def of(cls, arm: Arm) -> Site:
        """That of an arm."""
        return cls(int(arm.model.dof_bodyid[arm.dof_adr[-1]]), arm.tip_body, arm.T_body_tip.position, arm.packed_dynamics)


class SensorKind(NamedTuple):
    """What the sensors of a plant have in common.

    Attributes:
        dt: s, the tick.
        continuous: Whether the arm moves almost continuously between ticks.
        plant: What disturbs the measurements.
        is_sampled: Whether there is noise, a delay or an estimate from torques.
        is_connected: Whether equalities act on bodies.
    """

    dt: float
    continuous: bool
    plant: Plant
    is_sampled: bool
    is_connected: bool
