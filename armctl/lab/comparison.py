"""Comparison: the same motion under several controllers, on several plants."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from armctl.control.interface import Controller, traits
from armctl.core.errors import InputError, ModelError, PlanError
from armctl.core.trajectory import Trajectory
from armctl.core.validation import integer, number
from armctl.lab.loops.margins import margins
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.collision.checkers import collision_checker
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.report.report import Report, best_cells, contacts_in_words, report_table
from armctl.run.sim.plant import WITH_ENCODER, Plant
from armctl.run.sim.simulate import rows_as_runs, run_many

_MAX_SHOWN_REPORTS = 8  # in a repr

DEFAULT_CONFIGURATIONS = 5
DEFAULT_DWELL_S = 10.0  # a law whose errors decay as exp(-t) rests then


def compare(
    arm: Arm,
    controllers: Sequence[Controller | str],
    trajectory: Trajectory,
    plants: Sequence[Plant] = (WITH_ENCODER,),
    *,
    threads: int = 1,
    configurations: int = DEFAULT_CONFIGURATIONS,
    dwell: float = DEFAULT_DWELL_S,
) -> Comparison:
    """Follows one trajectory under every controller on every plant. A progress bar appears on a terminal after two seconds.

    Args:
        controllers: Controllers or names of controllers.
        plants: The simulated plants; by default the model with encoders whose noise is 1e-5 rad, from which velocities are
            differenced.
        threads: How many threads to use; the numbers are the same with any.
        configurations: Number of configurations at which delay margin and peak sensitivity are computed, as by `margins` with
            its search for the worst ones; 0 for neither.
        dwell: s, how long each controller holds the end of the motion at most: until the arm rests. The final errors are those
            after it, and the settling time counts from its beginning. The verdict on an arm that still moves then, away from
            its goal, is "not reached, not yet at rest".

    Returns:
        A list with one report per pair, plant by plant. A run that failed after its first tick has a report, too.

    Raises:
        InputError: There is no controller or no plant, or the number of threads is not positive, or the dwell is negative.
        UnknownNameError: There is no such controller.
        SimulationError: A controller failed at its first tick.
    """
    lists = [
        values for values in (controllers, plants) if isinstance(values, Sequence) and not isinstance(values, str) and values
    ]
    if len(lists) < 2:
        raise InputError("controllers, plants: expected a list of at least one of each, such as ['pd', 'computed-torque']")
    names = [each if isinstance(each, str) else traits(each).name for each in controllers]
    pairs = [
        _Pair(controller, plant, controller_label, plant_label)
        for plant, plant_label in zip(plants, distinct_names(map(str, plants)), strict=True)
        for controller, controller_label in zip(controllers, distinct_names(names), strict=True)
    ]
    configurations = integer("configurations", configurations, 0)
    runs = rows_as_runs(arm, [(pair.controller, trajectory, pair.plant) for pair in pairs])
    reports = Comparison()
    dwell = number("dwell", dwell, 0.0)
    threads = integer("threads", threads, 1)
    found = run_many(arm, runs, lambda _, log: Report.from_log(log), dwell=dwell, until_rest=True, threads=threads)
    for pair, report in zip(pairs, found, strict=True):
        labelled = replace(report, controller=pair.controller_label, plant=pair.plant_label)
        reports.append(_with_margins(arm, pair, labelled, configurations) if configurations else labelled)
    return reports


def remarks(reports: Sequence[Report]) -> list[str]:
    """Remarks on the figures: failures first, then contacts, then saturated motors; one sentence each."""
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


class Comparison(list[Report]):
    """The reports of `compare`, plant by plant. `print` shows a table, a notebook one for each plant with the best values."""

    def __repr__(self) -> str:
        lines = [f"{_name(report):.60}: {report.verdict:.60}" for report in self[:_MAX_SHOWN_REPORTS]]
        more = len(self) - len(lines)
        return "\n".join([f"Comparison of {len(self)} runs", *lines, *([f"and {more} more"] if more else [])])

    def __str__(self) -> str:
        return report_table(self).text(keys=2)

    def plants(self) -> dict[str, list[Report]]:
        """The reports of each plant."""
        return {plant: list(group) for plant, group in groupby(self, key=lambda report: report.plant)}

    def _repr_html_(self) -> str:
        return "".join(f"<h4>{html.escape(plant)}</h4>{marked_table(group)}" for plant, group in self.plants().items())


def marked_table(reports: Sequence[Report]) -> str:
    """Reports of one plant, whose column is left out, as an HTML table with the best values marked."""
    return report_table(reports, with_plant=False).html(best_cells(reports, with_plant=False))


class _Pair(NamedTuple):
    """One run of a comparison. The labels tell apart what has the same name."""

    controller: Controller | str
    plant: Plant
    controller_label: str
    plant_label: str


def _with_margins(arm: Arm, pair: _Pair, report: Report, configurations: int) -> Report:
    """The report with margins, if a linear model describes the controller."""
    try:
        found = margins(arm, pair.controller, configurations, [pair.plant])
    except ModelError:
        return report
    return replace(
        report,
        delay_margin_s=found.delay.value,
        peak_sensitivity=found.peak_sensitivity.value,
        damping_ratio=found.damping.value,
        slowest_pole_per_s=found.slowest_pole.value,
    )


def distinct_names(names: Iterable[str]) -> list[str]:
    """The names, with a number where a name occurs again."""
    count: Counter[str] = Counter()
    labels = []
    for name in names:
        count[name] += 1
        labels.append(name if count[name] == 1 else f"{name} ({count[name]})")
    return labels


def out_and_back(arm: Arm, distance: float = 0.6, *, speed: float = 1.0) -> JointTrajectory:
    """Plans a motion for comparing controllers: all joints at once from home and back, as fast as the limits allow.

    If the arm would touch something, the joints move in the other direction, or half as far, up to four times.

    Args:
        distance: rad (m for a slide joint) by which each joint moves, less where its range ends before.
        speed: Fraction of the full speed, in (0, 1].

    Raises:
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
    raise PlanError(f"{arm.name}: every motion from home touches something, so there is no motion for the comparison")
