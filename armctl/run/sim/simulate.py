"""simulate: one run of a trajectory from its start, in a simulation of its own; simulate_many: many runs on several threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

from armctl.control.interface import Controller, has_compiled_law
from armctl.core.errors import InputError
from armctl.core.log import Log, SimulationError
from armctl.core.progress import progress_bar
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import instance, integer, number
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.loop_check import check_loops
from armctl.run.execution.move import read_controller
from armctl.run.sim.plant import Plant, read_plant
from armctl.run.sim.simulated_arm import SimulatedArm
from armctl.run.sim.stepper import Stepper

_Result = TypeVar("_Result")
_QUEUED_PER_THREAD = 4  # runs that wait for a thread; more results would have to stay in memory
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
    return _simulated(arm, controller, trajectory, plant, dwell)


def _simulated(
    arm: Arm,
    controller: Controller | str,
    trajectory: Trajectory,
    plant: Plant | None,
    dwell: float,
    until_rest: bool = False,
) -> Log:
    """As `simulate`; with `until_rest`, the end of the motion is held no longer than until the arm rests."""
    check_arm(arm)
    law = read_controller(controller, arm)
    plant = read_plant(plant)
    check_motion(trajectory, arm.joint_names)
    check_loops(arm, trajectory)
    dwell = number("dwell", dwell, 0.0)
    start = trajectory(0.0)
    idle = _idle.setdefault(arm, [])
    try:
        stepper = idle.pop()
    except IndexError:
        stepper = Stepper(arm, plant)
    if stepper.plant is not plant and stepper.plant.key != plant.key:
        stepper.set_plant(plant, arm)
    try:
        simulated = SimulatedArm(arm, law, stepper)
        simulated.reset(start.q, start.v)
        return simulated.run(trajectory, dwell, until_rest)
    finally:
        idle.append(stepper)
        while len(idle) > _IDLE_PER_ARM:
            with suppress(IndexError):  # another thread may have taken it
                idle.pop(0)


class Run(NamedTuple):
    """One run of many. As the arguments of `simulate`."""

    controller: Controller  # runs with the same one do not share its memory
    trajectory: Trajectory
    plant: Plant


def simulate_many(
    arm: Arm,
    controller: Controller | str | Sequence[Controller | str],
    trajectories: Trajectory | Sequence[Trajectory],
    plants: Plant | Sequence[Plant] | None = None,
    *,
    dwell: float = 0.25,
    threads: int | None = None,
) -> list[Log]:
    """Follows many trajectories, or one on many plants, each from its start in a new simulation.

    The logs are those of `simulate`, bit for bit, with any number of threads. Threads run at the same time while a controller
    runs in the compiled loop; the others take turns. A progress bar appears on a terminal after two seconds.

    Args:
        controller: A controller or its name for all runs, or a list with one for each run.
        trajectories: A motion for all runs, or a list with one for each run.
        plants: A plant for all runs, or a list with one for each run; by default none differs from the model.
        dwell: s to hold the end of each motion.
        threads: How many runs at the same time; by default one for each processor.

    Returns:
        A log for each run, in their order. A run that diverges, or whose controller fails, ends early, with the reason in
        `log.failure`.

    Raises:
        InputError: Lists of different lengths, or an argument that `simulate` does not accept.
        UnknownNameError: There is no such controller.
        SimulationError: A controller failed at its first tick.
    """
    check_arm(arm)
    columns = [
        list(each) if isinstance(each, Sequence) and not isinstance(each, str) else each
        for each in (controller, trajectories, Plant() if plants is None else plants)
    ]
    lengths = {len(column) for column in columns if isinstance(column, list)}
    if len(lengths) > 1 or 0 in lengths:
        raise InputError(
            f"controller, trajectories, plants: expected lists of one length above 0, got lengths {sorted(lengths)}"
        )
    count = lengths.pop() if lengths else 1
    rows = zip(*(column if isinstance(column, list) else [column] * count for column in columns), strict=True)
    return list(run_many(arm, rows_as_runs(arm, rows), lambda _, log: log, dwell=dwell, threads=threads))


def rows_as_runs(arm: Arm, rows: Any) -> list[Run]:
    """Runs from controllers or their names, trajectories and plants; a name makes one controller."""
    named: dict[str, Controller] = {}
    runs = []
    for controller, trajectory, plant in rows:
        instance("plants", plant, Plant, "armctl.Plant(payload=1.0) is one")
        if isinstance(controller, str):
            if controller not in named:
                named[controller] = read_controller(controller, arm)
            controller = named[controller]
        runs.append(Run(read_controller(controller, arm), trajectory, plant))
    return runs


def run_many(
    arm: Arm,
    runs: Sequence[Run],
    evaluate: Callable[[Run, Log], _Result],
    *,
    dwell: float = 0.25,
    until_rest: bool = False,
    threads: int | None = None,
) -> Iterator[_Result]:
    """Simulates runs on threads, and gives what `evaluate` makes of each log, in the order of the runs.

    The end of each motion is held for `dwell` seconds, with `until_rest` no longer than until the arm rests.

    It is called in the thread of the run; a log of which nothing is kept is freed at once.
    """
    threads = processors() if threads is None else integer("threads", threads, 1)

    def result(run: Run) -> _Result:
        law = run.controller.fresh() if has_compiled_law(run.controller, arm.n) else run.controller
        return evaluate(run, _log_of(arm, run._replace(controller=law), dwell, until_rest))

    compiled = [has_compiled_law(run.controller, arm.n) for run in runs]
    workers = min(threads, max(1, sum(compiled)))
    # A single thread is that of the caller: changing to another one and back takes 0.3 ms a run.
    beside = [each and threads > 1 for each in compiled]
    with ThreadPoolExecutor(workers) as pool, progress_bar("simulate", len(runs), "runs") as bar:
        queued: list[Future[_Result] | None] = []
        try:
            for k, run in enumerate(runs):
                while len(queued) < min(len(runs), k + _QUEUED_PER_THREAD * threads):
                    ahead = len(queued)
                    queued.append(pool.submit(result, runs[ahead]) if beside[ahead] else None)
                future = queued[k]
                queued[k] = None
                found = result(run) if future is None else future.result()
                bar.update()
                yield found
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _log_of(arm: Arm, run: Run, dwell: float, until_rest: bool) -> Log:
    """The log of a run, also if its controller failed after the first tick."""
    try:
        return _simulated(arm, run.controller, run.trajectory, run.plant, dwell, until_rest)
    except SimulationError as error:
        if error.log is None or not len(error.log):
            raise
        return error.log


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
