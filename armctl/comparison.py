"""Comparison: the same motion under several controllers."""

from __future__ import annotations

from collections.abc import Sequence

from armctl.arm import Arm
from armctl.control import Controller
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
        distance: rad (m) by which each joint moves, less where a limit is near.

    Returns:
        The motion, as fast as the limits allow.
    """
    there = arm.limits.clamp(arm.home + distance)
    return move_j(arm, arm.home, there).then(move_j(arm, there, arm.home))
