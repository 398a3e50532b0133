"""Comparison: the same motion under several controllers, on several plants."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from armctl.analysis.report import Report, contacts_in_words
from armctl.collision.checkers import collision_checker
from armctl.control import Controller, controller_name
from armctl.core.errors import InputError, PlanError
from armctl.core.log import SimulationError
from armctl.core.trajectory import Trajectory
from armctl.core.validation import integer, number
from armctl.motion import JointTrajectory, move_j
from armctl.robot.arm import Arm, check_arm
from armctl.sim.plant import NOMINAL, Plant
from armctl.sim.simulate import simulate


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
        controllers: Controllers or names of controllers; only names if several processes share the work.
        trajectory: The motion.
        plants: The simulated plants.
        workers: Number of processes. With more than one, a script that calls this function needs
            `if __name__ == "__main__":`.
        progress: Called after each run with the number of completed runs and their total.

    Returns:
        One report per pair, plant by plant. A run that failed after its first tick has a report, too.

    Raises:
        InputError: There is no controller or no plant, or the number of processes is not positive.
        UnknownNameError: There is no such controller.
        SimulationError: A controller failed at its first tick.
    """
    lists = [
        values for values in (controllers, plants) if isinstance(values, Sequence) and not isinstance(values, str) and values
    ]
    if len(lists) < 2:
        raise InputError("controllers, plants: a list of at least one of each wanted, such as ['pd', 'computed-torque']")
    pairs = [
        _Pair(controller, plant, controller_label, plant_label)
        for plant, plant_label in zip(plants, _distinct(map(str, plants)), strict=True)
        for controller, controller_label in zip(controllers, _distinct(map(_name_of, controllers)), strict=True)
    ]
    run = partial(_run, arm, trajectory)
    with _pool(min(integer("workers", workers, 1), len(pairs))) as mapped:
        reports = []
        for report in mapped(run, pairs):
            reports.append(report)
            if progress is not None:
                progress(len(reports), len(pairs))
    return reports


def remarks(reports: Sequence[Report]) -> list[str]:
    """What to know before reading any figure: failures first, then contacts, then saturated motors; one sentence each."""
    failed = [f"{_name(r)}: {r.log.failure}" for r in reports if r.log.failure]
    touched = [f"{_name(r)}: {contacts_in_words(r.contacts)}" for r in reports if r.contacts]
    saturated = [
        f"{_name(r)}: the commanded torque is above a motor's limit {100 * r.saturated_fraction:.1f} % of the time"
        for r in reports
        if r.saturated_fraction > 0.0 and not r.log.failure
    ]
    return failed + touched + saturated


def _name(report: Report) -> str:
    return f"{report.controller} on {report.plant}"


class _Pair(NamedTuple):
    """One run of a comparison. The labels tell apart what has the same name."""

    controller: Controller | str
    plant: Plant
    controller_label: str
    plant_label: str


def _name_of(controller: Controller | str) -> str:
    return controller if isinstance(controller, str) else controller_name(controller)


def _distinct(names: Iterable[str]) -> list[str]:
    """The names, with a number where a name occurs again."""
    count: Counter[str] = Counter()
    labels = []
    for name in names:
        count[name] += 1
        labels.append(name if count[name] == 1 else f"{name} ({count[name]})")
    return labels


def _run(arm: Arm, trajectory: Trajectory, pair: _Pair) -> Report:
    try:
        log = simulate(arm, pair.controller, trajectory, pair.plant)
    except SimulationError as error:
        if error.log is None or not len(error.log):
            raise
        log = error.log
    return replace(Report.from_log(log), controller=pair.controller_label, plant=pair.plant_label)


@contextmanager
def _pool(workers: int) -> Iterator[Callable]:
    """A `map` that runs in this number of processes. An interrupt ends them at once."""
    if workers <= 1:
        yield map
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import active_children, get_context

    others = set(active_children())
    pool = ProcessPoolExecutor(workers, get_context("spawn"))
    try:
        with _interrupts_blocked():
            pool.submit(int)  # starts the processes
        yield pool.map
        pool.shutdown()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(active_children()) - others:
            process.terminate()
        raise


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Processes that start here never see Ctrl-C, on which each would print a traceback; this process sees it afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def out_and_back(arm: Arm, distance: float = 0.6, *, speed: float = 1.0) -> JointTrajectory:
    """Plans a motion for comparing controllers: all joints at once from home and back, as fast as the limits allow.

    If the arm would touch something on the way, the joints move in the other direction, or half as far, up to four times.

    Args:
        arm: The arm.
        distance: rad (m for a slide joint) by which each joint moves, less where its range ends before.
        speed: Fraction of the full speed, in (0, 1].

    Returns:
        The motion.

    Raises:
        InputError: The distance is no number, or the speed is outside (0, 1].
        PlanError: The arm touches something however little it moves.
    """
    check_arm(arm)
    distance = number("distance", distance)
    speed = number("speed", speed, 1e-3, 1.0)
    checker = collision_checker(arm)
    fractions = np.linspace(0.0, 1.0, 50)[:, None]
    for step in (distance * sign * 0.5**halvings for halvings in range(5) for sign in (1, -1)):
        there = 0.98 * (arm.limits.clamp(arm.home + step) - arm.home) + arm.home
        if not checker.along(arm.home + fractions * (there - arm.home)):
            motion = move_j(arm, arm.home, there).then(move_j(arm, there, arm.home))
            return motion if speed == 1.0 else motion.scaled(speed)
    raise PlanError(f"{arm.name}: it touches something wherever it moves from home, so there is no motion to compare on")
