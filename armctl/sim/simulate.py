"""simulate: one run of a trajectory from its start, in a simulation of its own."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from armctl.control import Controller
from armctl.core.log import Log
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import number
from armctl.robot.arm import Arm, check_arm
from armctl.sim.move import ControlledArms, read_controller
from armctl.sim.plant import Plant, read_plant
from armctl.sim.stepper import Stepper

# Idle simulations for further runs with equal plants, since a copy of a model with meshes takes longer than a run of a second.
# They contain no reference to their arm, and are forgotten with it.
_IDLE_PER_ARM = 2
_idle: WeakKeyDictionary[Arm, dict[tuple[object, ...], Stepper]] = WeakKeyDictionary()


def simulate(
    arm: Arm, controller: Controller | str, trajectory: Trajectory, plant: Plant | None = None, dwell: float = 0.25
) -> Log:
    """Follows a trajectory from its start, in a simulation of its own.

    Args:
        arm: The arm.
        controller: A controller or its name.
        trajectory: The motion.
        plant: How the simulated arm differs from the model; by default it does not.
        dwell: s to hold the end of the motion.

    Returns:
        Every tick of it. A run that diverges ends early, and `log.failure` says why.

    Raises:
        InputError: An argument has a wrong type or value, or the motion is one of other joints.
        UnknownNameError: There is no such controller.
        SimulationError: The controller failed; `error.log` contains the ticks until then.
    """
    check_arm(arm)
    law = read_controller(controller, arm)
    plant = read_plant(plant)
    check_motion(trajectory, arm.joint_names)
    dwell = number("dwell", dwell, 0.0)
    start = trajectory(0.0)
    idle = _idle.setdefault(arm, {})
    stepper = idle.pop(plant.key, None) or Stepper([arm], plant)
    try:
        arms = ControlledArms([arm], {arm.tip: law}, stepper)
        arms.reset(start.q, start.v)
        return arms.run({arm.tip: trajectory}, dwell)[arm.tip]
    finally:
        idle[plant.key] = stepper
        for oldest in list(idle)[:-_IDLE_PER_ARM]:
            idle.pop(oldest, None)
