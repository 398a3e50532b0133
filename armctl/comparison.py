"""Comparison: the same motion under several controllers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armctl.arm import Arm
from armctl.contacts import Contacts
from armctl.control import Controller
from armctl.errors import PlanError
from armctl.motion import move_j
from armctl.plant import Plant
from armctl.report import Report
from armctl.simulation import simulate
from armctl.trajectory import Trajectory


def compare(
    arm: Arm, controllers: Sequence[Controller | str], trajectory: Trajectory, plants: Sequence[Plant] = (Plant(),)
) -> list[Report]:
    """Follows one trajectory under every controller on every plant.

    Args:
        arm: The arm.
        controllers: Controllers or names of them.
        trajectory: The motion.
        plants: How reality differs from the model.

    Returns:
        One report for each pair, plant by plant.

    Raises:
        UnknownNameError: There is no such controller.
    """
    return [Report.from_log(simulate(arm, controller, trajectory, plant)) for plant in plants for controller in controllers]


def out_and_back(arm: Arm, distance: float = 0.6) -> Trajectory:
    """A motion that shows a controller: all joints at once, from home and back.

    Args:
        arm: The arm.
        distance: rad (m) by which each joint moves; the other way or less far where the arm would touch something.

    Returns:
        The motion, as fast as the limits allow.

    Raises:
        PlanError: The arm touches something however little it moves.
    """
    contacts, share = Contacts(arm), np.linspace(0.0, 1.0, 50)[:, None]
    for step in (distance * sign * 0.5**k for k in range(5) for sign in (1, -1)):
        there = 0.98 * (arm.limits.clamp(arm.home + step) - arm.home) + arm.home
        if contacts.along(arm.home + share * (there - arm.home)) is None:
            return move_j(arm, arm.home, there).then(move_j(arm, there, arm.home))
    raise PlanError(f"{arm.name}: it touches something wherever it moves from home, so there is no motion to compare on")
