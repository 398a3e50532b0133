"""simulate: one run of a trajectory from its start, in a simulation of its own."""

from __future__ import annotations

from contextlib import suppress
from weakref import WeakKeyDictionary

from armctl.control.interface import Controller
from armctl.core.log import Log
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import number
from armctl.robot.arm import Arm, check_arm
from armctl.sim.move import read_controller
from armctl.sim.plant import Plant, read_plant
from armctl.sim.simulated_arms import SimulatedArms
from armctl.sim.stepper import Stepper

# Idle simulations for further runs, since a copy of a model with meshes takes longer than a run of a second. They contain no
# reference to their arm, and are forgotten with it.
_IDLE_PER_ARM = 2
_idle: WeakKeyDictionary[Arm, list[Stepper]] = WeakKeyDictionary()


def simulate(
    arm: Arm, controller: Controller | str, trajectory: Trajectory, plant: Plant | None = None, dwell: float = 0.25
) -> Log:
    """Follows a trajectory from its start, in a new simulation.

    Args:
        plant: How the simulated arm differs from the model; by default it does not.
        dwell: s to hold the end of the motion.

    Returns:
        Every tick of it. A run that diverges ends early, and `log.failure` gives the reason.

    Raises:
        UnknownNameError: There is no such controller.
        SimulationError: The controller failed; `error.log` contains the ticks until then.
    """
    check_arm(arm)
    law = read_controller(controller, arm)
    plant = read_plant(plant)
    check_motion(trajectory, arm.joint_names)
    dwell = number("dwell", dwell, 0.0)
    start = trajectory(0.0)
    idle = _idle.setdefault(arm, [])
    try:
        stepper = idle.pop()
    except IndexError:
        stepper = Stepper([arm], plant)
    if stepper.plant.key != plant.key:
        stepper.set_plant(plant, [arm])
    try:
        arms = SimulatedArms([arm], {arm.tip: law}, stepper)
        arms.reset(start.q, start.v)
        return arms.run({arm.tip: trajectory}, dwell)[arm.tip]
    finally:
        idle.append(stepper)
        while len(idle) > _IDLE_PER_ARM:
            with suppress(IndexError):  # another thread may have taken it
                idle.pop(0)
