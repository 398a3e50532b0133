"""Comparison: the same motion under several controllers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

from armctl.analysis.report import Report
from armctl.collision.checker import collision_checker
from armctl.control import Controller
from armctl.core.errors import InputError, PlanError
from armctl.core.log import SimulationError
from armctl.core.trajectory import Trajectory
from armctl.core.validation import integer
from armctl.motion import move_j
from armctl.robot.arm import Arm
from armctl.sim.plant import NOMINAL, Plant
from armctl.sim.simulation import simulate


def compare(
    arm: Arm,
    controllers: Sequence[Controller | str],
    trajectory: Trajectory,
    plants: Sequence[Plant] = (NOMINAL,),
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[Report]:
    """Follows one trajectory under every controller on every plant.

    Args:
        arm: The arm.
        controllers: Controllers or names of them; names, where several processes share the work.
        trajectory: The motion.
        plants: How reality differs from the model.
        workers: How many processes share the work. With more than one, a script that calls this needs its
            `if __name__ == "__main__":`.
        progress: Told how many of how many runs are done.

    Returns:
        One report for each pair, plant by plant. A run whose controller failed is among them, as long as it had begun.

    Raises:
        InputError: There is no controller or no plant, or no process is to work.
        UnknownNameError: There is no such controller.
        SimulationError: A controller failed at its first tick.
    """
    if isinstance(controllers, str) or not controllers or not plants:
        raise InputError("controllers, plants: a list of at least one of each wanted, such as ['pd', 'computed-torque']")
    pairs = [(controller, plant) for plant in plants for controller in controllers]
    run = partial(_run, arm, trajectory)
    with _pool(min(integer("workers", workers, 1), len(pairs))) as mapped:
        reports = []
        for report in mapped(run, pairs):
            reports.append(report)
            if progress is not None:
                progress(len(reports), len(pairs))
    return reports


def remarks(reports: Sequence[Report]) -> list[str]:
    """What must be said before any figure: which runs failed, and which asked motors for more than they give.

    Args:
        reports: The reports.

    Returns:
        One sentence a run, the failed ones first.
    """
    failed = [f"{r.controller} on {r.plant}: {r.log.failure}" for r in reports if r.log.failure]
    saturated = [
        f"{r.controller} on {r.plant}: asks the motors for more than they give {100 * r.saturated_fraction:.1f} % of the time"
        for r in reports
        if r.saturated_fraction > 0.0 and not r.log.failure
    ]
    return failed + saturated


def _run(arm: Arm, trajectory: Trajectory, pair: tuple[Controller | str, Plant]) -> Report:
    try:
        return Report.from_log(simulate(arm, pair[0], trajectory, pair[1]))
    except SimulationError as error:
        if error.log is None or not len(error.log):
            raise
        return Report.from_log(error.log)


@contextmanager
def _pool(workers: int) -> Iterator[Callable]:
    """A `map` over so many processes."""
    if workers <= 1:
        yield map
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        yield pool.map


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
    contacts, share = collision_checker(arm), np.linspace(0.0, 1.0, 50)[:, None]
    for step in (distance * sign * 0.5**k for k in range(5) for sign in (1, -1)):
        there = 0.98 * (arm.limits.clamp(arm.home + step) - arm.home) + arm.home
        if not contacts.along(arm.home + share * (there - arm.home)):
            return move_j(arm, arm.home, there).then(move_j(arm, there, arm.home))
    raise PlanError(f"{arm.name}: it touches something wherever it moves from home, so there is no motion to compare on")
