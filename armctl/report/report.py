"""Report: the figures of one run and a verdict."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armctl.core import units
from armctl.core.defaults import AT_REST_SPEED, MIN_DAMPING_RATIO, RESTING_S
from armctl.core.errors import InputError
from armctl.core.json_values import json_value
from armctl.core.log import Contact, Log
from armctl.core.result import Verdict
from armctl.core.tables import Table
from armctl.core.target import ANGLE_TOLERANCE, TOLERANCE
from armctl.core.units import above_text, length_text
from armctl.core.validation import BoolArray, instance, number, shown
from armctl.report.plot import four_panels
from armctl.report.tip_errors import TipErrors, distances, errors_of, goal_of, judged_tips, largest, overshoot, rms, vibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_CONTACTS_SHOWN = 3
_LABEL_WIDTH = 11
_MIN_JOINT_ERROR_SHOWN = 1e-15
_MIN_CHATTER_SHOWN = 1e-3  # N m (N)
_REST_TICKS = 6  # intervals between ticks without motion of the reference, around a tick that counts as rest
_LAST_TICKS = 50  # in which an unstable loop shows: its torques alternate, although the tip may stay at its goal


@dataclass(frozen=True, eq=False)
class Report(Verdict):
    """The figures of one run. A figure that has no meaning for the run is NaN (null in `to_dict`).

    Of an arm with several tips, a figure of the tip is the largest one of those with a target; of all, if none has one.

    Attributes:
        ok: Whether the run was completed and the tip was at its goal at the end.
        reason: The reason if it is not ok; empty if it is.
        outcome: "reached", "not reached", "not reached, not yet at rest", "failed", or "not run" without a tick.
        verdict: The result in one sentence, which begins with the outcome.
        plant: The differences of the plant from the model.
        joint_rms_rad: Root mean square of q_ref - q over ticks and hinge joints, while the reference moves; NaN without hinges.
        joint_max_rad: The largest of these errors.
        joint_rms_m: Root mean square of q_ref - q over ticks and slide joints, while the reference moves; NaN without slides.
        joint_max_m: The largest of these errors.
        tip_rms_m: Root mean square distance of the tip from the reference's tip, while the reference moves.
        tip_max_m: The largest of these distances.
        final_tip_error_m: Distance of the tip from its goal at the end. The goal is the target of a move or of
            `Simulation.follow`, otherwise the end of the reference.
        final_orientation_error_rad: Angle from the goal's orientation at the end; 0 if the target had no orientation.
        settling_time_s: From the end of the reference's motion until the tip stays within the tolerance; NaN if it never does.
        overshoot_m: How far the tip went beyond its goal, along the straight line from its start, more than its reference did.
        peak_torque_ratio: The largest torque divided by its limit.
        saturated_fraction: Fraction of the ticks at which a commanded torque exceeded its limit.
        chatter_nm: Root mean square difference of a torque from the mean of its two neighbours in time, while the reference
            rests, so that the torque of the motion is left out; NaN if it never rests.
        contacts: What the arm touched, and for how long.
        duration_s: Simulated time.
        real_time_factor: Simulated time divided by computing time.
        delay_margin_s: The smallest delay margin of the controller on the plant; NaN unless `compare` computed margins.
        peak_sensitivity: Its largest Ms; NaN as for the delay margin.
        damping_ratio: That of its least damped vibration, likewise; infinite if there is none.
        residual_vibration_m: The largest distance of the tip from its mean position while the reference rests; NaN if it never
            rests.
        slowest_pole_per_s: 1/s, the lowest rate with which an error decays, by its slowest pole; NaN as for the delay margin.
        tip_errors: The errors of each tip by name, of an arm with several; empty for one.
    """

    ok: bool
    reason: str
    outcome: str
    verdict: str
    robot: str
    controller: str
    plant: str
    joint_rms_rad: float
    joint_max_rad: float
    joint_rms_m: float
    joint_max_m: float
    tip_rms_m: float
    tip_max_m: float
    final_tip_error_m: float
    final_orientation_error_rad: float
    settling_time_s: float
    overshoot_m: float
    peak_torque_ratio: float
    saturated_fraction: float
    chatter_nm: float
    contacts: tuple[Contact, ...]
    duration_s: float
    real_time_factor: float
    log: Log
    delay_margin_s: float = math.nan
    peak_sensitivity: float = math.nan
    damping_ratio: float = math.nan
    residual_vibration_m: float = math.nan
    slowest_pole_per_s: float = math.nan
    tip_errors: Mapping[str, TipErrors] = field(default_factory=dict)

    @classmethod
    def from_log(cls, log: Log, tolerance: float = TOLERANCE, angle_tolerance: float = ANGLE_TOLERANCE) -> Report:
        """Computes the report of a run.

        Args:
            log: The run; it must have followed a reference.
            tolerance: m, the largest distance at which the tip is at its goal.
            angle_tolerance: rad, the largest angle at which it has its orientation.

        Raises:
            InputError: The log is empty or of an open-loop run, or a tolerance is negative or not finite.
        """
        instance("log", log, Log, "armctl.simulate and every move of a Simulation that is not refused give one")
        tolerance = number("tolerance", tolerance, 0.0)
        angle_tolerance = number("angle_tolerance", angle_tolerance, 0.0)
        if len(log) == 0 or np.isnan(log.q_ref).any() or np.isnan(log.tip_ref).any():
            raise InputError(
                "log: it has no tick with a reference, so there is nothing to report on; armctl.four_panels draws it"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # a run that diverged may hold huge numbers
            return cls._computed(log, tolerance, angle_tolerance)

    @classmethod
    def _computed(cls, log: Log, tolerance: float, angle_tolerance: float) -> Report:
        moving = log.t <= log.motion_duration + 0.5 * log.dt
        joint_error = (log.q_ref - log.q)[moving]
        slides = np.array([unit == "m" for unit in log.units])
        hinge_error = joint_error[:, ~slides]
        slide_error = joint_error[:, slides]
        tips = judged_tips(log)
        errors = {name: errors_of(tip, moving) for name, tip in log.tips.items()}
        judged = [errors[name] for name in tips]
        final = max(each.final_m for each in judged)
        reason = _reason(log, {name: errors[name] for name in tips}, tolerance, angle_tolerance)
        outcome = _outcome(log, reason)
        which = "the tips ended at most" if log.tip_names else "the tip ended"
        goals = "their goals" if log.tip_names else "its goal"
        details = reason or f"{which} {length_text(final)} from {goals} after {len(log) * log.dt:.2f} s"
        return cls(
            ok=not reason,
            reason=reason,
            outcome=outcome,
            verdict=f"{outcome}: {details}",
            robot=log.robot,
            controller=log.controller,
            plant=log.plant,
            joint_rms_rad=rms(hinge_error),
            joint_max_rad=largest(hinge_error),
            joint_rms_m=rms(slide_error),
            joint_max_m=largest(slide_error),
            tip_rms_m=max(each.rms_m for each in judged),
            tip_max_m=max(each.max_m for each in judged),
            final_tip_error_m=final,
            final_orientation_error_rad=max(each.final_orientation_rad for each in judged),
            settling_time_s=_settling_time(log, np.all([distances(tip) <= tolerance for tip in tips.values()], axis=0)),
            overshoot_m=max(overshoot(tip) for tip in tips.values()),
            peak_torque_ratio=float(np.abs(log.tau / log.tau_max).max()),
            saturated_fraction=float((np.abs(log.tau_cmd) > log.tau_max * (1 + 1e-9)).any(axis=1).mean()),
            chatter_nm=_chatter(log),
            residual_vibration_m=max(vibration(tip.position[~moving]) for tip in tips.values()),
            contacts=log.contacts,
            duration_s=len(log) * log.dt,
            real_time_factor=log.real_time_factor,
            log=log,
            tip_errors=errors if log.tip_names else {},
        )

    @classmethod
    def not_run(cls, log: Log) -> Report:
        """The report of a run that did not begin, whose log has no tick, and the reason as its failure.

        Raises:
            InputError: The log has ticks, or no failure.
        """
        instance("log", log, Log, "that of a run that did not begin")
        if len(log) or not log.failure:
            raise InputError(f"log: it has {len(log)} ticks and the failure {log.failure!r:.80}; Report.from_log reads it")
        return cls(
            ok=False,
            reason=log.failure,
            outcome="not run",
            verdict=f"not run: {log.failure}",
            robot=log.robot,
            controller=log.controller,
            plant=log.plant,
            joint_rms_rad=math.nan,
            joint_max_rad=math.nan,
            joint_rms_m=math.nan,
            joint_max_m=math.nan,
            tip_rms_m=math.nan,
            tip_max_m=math.nan,
            final_tip_error_m=math.nan,
            final_orientation_error_rad=math.nan,
            settling_time_s=math.nan,
            overshoot_m=math.nan,
            peak_torque_ratio=math.nan,
            saturated_fraction=math.nan,
            chatter_nm=math.nan,
            contacts=(),
            duration_s=0.0,
            real_time_factor=math.nan,
            log=log,
        )

    def to_dict(self) -> dict[str, object]:
        """Every attribute but the log by name, for JSON: NaN and infinity become None."""
        figures = {k: v for k, v in self.__dict__.items() if k != "log"}
        figures["contacts"] = [contact._asdict() for contact in self.contacts]
        tips = figures.pop("tip_errors")
        if tips:
            figures["tip_errors"] = {name: errors._asdict() for name, errors in tips.items()}
        return json_value(figures)

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        title: bool = True,
        ax: Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws joint angles, velocities, torques with their limits, and the tip, over time.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made. Left out, a window opens.
            size: Width and height in inches.
            title: Whether arm and controller stand above the panels; False where a caption says it.
            ax: Four axes of matplotlib to draw into instead, row by row.
        """
        return four_panels(self.log, path, size=size, title=title, ax=ax)

    def _rows(self) -> dict[str, str]:
        torque_unit = units.label(units.of_torque(self.log.units))
        settled = f"settled after {self.settling_time_s:.3f} s" if math.isfinite(self.settling_time_s) else "never settled"
        is_known = not math.isnan(self.chatter_nm)  # unless the motion is too short for it
        chatter = f", chatter {_chatter_text(self.chatter_nm)} {torque_unit}" if is_known else ""
        rows = {
            "run": f"{self.robot}, {self.controller}, {self.duration_s:.3f} s in ticks of {1e3 * self.log.dt:g} ms,"
            f" {self.real_time_factor:.0f} times real time",
            **self._tip_rows(),
            "joint error": f"while moving RMS {_joint_error(self.joint_rms_rad, self.joint_rms_m, with_unit=True)},"
            f" max {_joint_error(self.joint_max_rad, self.joint_max_m, with_unit=True)}",
            "at the goal": f"{settled}, overshoot {length_text(self.overshoot_m)}",
            "torque": f"peak {100 * self.peak_torque_ratio:.0f} % of the limit, saturated"
            f" {100 * self.saturated_fraction:.1f} % of the time{chatter}",
        }
        if self.contacts:
            rows["contact"] = contacts_in_words(self.contacts)
        if self.log.unmeasured_bodies:
            rows["wrench"] = f"a flange sensor does not measure the force on {', '.join(self.log.unmeasured_bodies)}"
        return rows

    def _tip_rows(self) -> dict[str, str]:
        """The errors of the tip, or of each tip by name."""
        one = TipErrors(self.final_tip_error_m, self.final_orientation_error_rad, self.tip_rms_m, self.tip_max_m, True)
        errors = self.tip_errors or {"tip error": one}
        rows = {}
        for (label, each), tip in zip(errors.items(), self.log.tips.values(), strict=True):
            turned = "" if np.isnan(goal_of(tip)[1]).any() else f", {_deg(each.final_orientation_rad)}"
            final = f"final {length_text(each.final_m)}{turned}"
            rows[label] = f"{final}; while moving RMS {length_text(each.rms_m)}, max {length_text(each.max_m)}"
        return rows

    def __str__(self) -> str:
        if not len(self.log):
            return self.verdict
        rows = self._rows()
        width = max(_LABEL_WIDTH, *map(len, rows))
        return "\n".join([self.verdict, *(f"  {label:{width}}  {text}" for label, text in rows.items())])

    def _repr_html_(self) -> str:
        return Table(["", self.verdict], list(self._rows().items())).html()


def contacts_in_words(contacts: Sequence[Contact]) -> str:
    """What touched what, and for how long: the first few contacts."""
    text = "; ".join(f"{contact} from {contact.start:.3g} s on" for contact in contacts[:_MAX_CONTACTS_SHOWN])
    more = len(contacts) - _MAX_CONTACTS_SHOWN
    return f"{text}; {more} more" if more > 0 else text


def table(reports: Sequence[Report]) -> str:
    """Formats reports side by side as a Markdown table.

    Args:
        reports: The reports, one per row.

    Raises:
        InputError: Something else than reports.
    """
    if not isinstance(reports, Sequence) or not all(isinstance(report, Report) for report in reports):
        raise InputError(f"reports: expected a list of reports, got {shown(reports)}; armctl.compare returns one")
    return report_table(reports).markdown()


class ReportColumn(NamedTuple):
    """A column of a table of reports: its title, its cells and, if a report can be the best in it, what is least then."""

    title: str
    cell: Callable[[Report], str]
    rank: Callable[[Report], float] | None = None


def report_columns(reports: Sequence[Report], *, with_plant: bool = True) -> list[ReportColumn]:
    """The columns of `table`."""
    joint_units = list(dict.fromkeys(unit for r in reports for unit in r.log.units))
    mixed = len(joint_units) > 1
    joint = "" if mixed else f", {units.label(joint_units)}"
    torque = units.label(units.of_torque(joint_units))
    columns = [ReportColumn("controller", lambda r: r.controller)]
    if with_plant:
        columns.append(ReportColumn("plant", lambda r: r.plant))
    columns += [
        ReportColumn(
            f"joint RMS{joint}",
            lambda r: _joint_error(r.joint_rms_rad, r.joint_rms_m, with_unit=mixed),
            lambda r: r.joint_rms_rad,
        ),
        ReportColumn(
            f"joint max{joint}",
            lambda r: _joint_error(r.joint_max_rad, r.joint_max_m, with_unit=mixed),
            lambda r: r.joint_max_rad,
        ),
        ReportColumn("tip RMS", lambda r: _length_cell(r.tip_rms_m), lambda r: r.tip_rms_m),
        ReportColumn("tip max", lambda r: _length_cell(r.tip_max_m), lambda r: r.tip_max_m),
        ReportColumn("final tip error", lambda r: _length_cell(r.final_tip_error_m), lambda r: r.final_tip_error_m),
        ReportColumn("settled, s", lambda r: _margin_text(r.settling_time_s), lambda r: r.settling_time_s),
        ReportColumn("peak torque", lambda r: _percent_text(r.peak_torque_ratio)),
        ReportColumn(f"chatter, {torque}", lambda r: _chatter_text(r.chatter_nm)),
    ]
    if not all(math.isnan(r.peak_sensitivity) for r in reports):
        columns += [
            ReportColumn("delay margin, ms", lambda r: _margin_text(1e3 * r.delay_margin_s), lambda r: -r.delay_margin_s),
            ReportColumn("Ms", lambda r: _margin_text(r.peak_sensitivity), lambda r: r.peak_sensitivity),
            ReportColumn("slowest pole, 1/s", lambda r: _margin_text(r.slowest_pole_per_s), lambda r: -r.slowest_pole_per_s),
        ]
        if any(r.damping_ratio < MIN_DAMPING_RATIO for r in reports):
            columns.append(ReportColumn("least damping", lambda r: _margin_text(r.damping_ratio), lambda r: -r.damping_ratio))
    columns.append(ReportColumn("verdict", lambda r: r.outcome + (", with contact" if r.contacts else "")))
    return columns


def report_table(reports: Sequence[Report], *, with_plant: bool = True) -> Table:
    """The table of `table`, not yet formatted."""
    columns = report_columns(reports, with_plant=with_plant)
    return Table([column.title for column in columns], [[column.cell(r) for column in columns] for r in reports])


def best_cells(reports: Sequence[Report], *, with_plant: bool = True) -> set[tuple[int, int]]:
    """Row and column of the best values in a `report_table`, with those that look the same; runs that failed have none."""
    best: set[tuple[int, int]] = set()
    completed = [i for i, report in enumerate(reports) if not report.log.failure]
    for column, (_, cell, rank) in enumerate(report_columns(reports, with_plant=with_plant)):
        values = {} if rank is None else {i: rank(reports[i]) for i in completed}
        rows = [i for i, value in values.items() if not math.isnan(value)]
        if len(rows) < 2:
            continue
        winner = cell(reports[min(rows, key=values.__getitem__)])
        best |= {(i, column) for i in rows if cell(reports[i]) == winner}
    return best


def _reason(log: Log, tips: Mapping[str, TipErrors], tolerance: float, angle_tolerance: float) -> str:
    """Why the run failed; empty if it did not."""
    if log.failure:
        return log.failure
    reasons = []
    for name, (final, angle, *_) in tips.items():
        which = name if log.tip_names else "the tip"
        if not final <= tolerance:
            reasons.append(f"{which} ended {above_text(final, tolerance)} from its goal ({length_text(tolerance)} allowed)")
        elif not angle <= angle_tolerance:
            reasons.append(f"{which} ended {angle:.3g} rad from its orientation ({angle_tolerance:g} rad allowed)")
    jumps = np.abs(np.diff(log.tau[-_LAST_TICKS:], axis=0)) > log.tau_max
    if len(jumps) and jumps.mean(axis=0).max() > 0.5:
        ticks = f"from tick to tick: the loop is unstable at its period of {1e3 * log.dt:g} ms, or amplifies noise"
        reasons.append(f"a torque jumps by more than its limit {ticks}; lower the gains of {log.controller}")
    return "; ".join(reasons)


def _outcome(log: Log, reason: str) -> str:
    if log.failure:
        return "failed"
    if reason:
        return "not reached, not yet at rest" if _is_moving(log) else "not reached"
    return "reached"


def _is_moving(log: Log) -> bool:
    """Whether a joint still moves at the end, after the motion of the reference."""
    first = int(np.searchsorted(log.t, log.motion_duration + 0.5 * log.dt))
    last = log.q[max(first, len(log) - round(RESTING_S / log.dt)) :]
    return len(last) > 0 and bool(np.ptp(last, axis=0).max() >= AT_REST_SPEED * RESTING_S)


def _settling_time(log: Log, inside: BoolArray) -> float:
    if not inside[-1]:
        return math.nan
    outside = np.flatnonzero(~inside)
    entered = log.t[outside[-1]] + log.dt if len(outside) else 0.0
    return max(0.0, float(entered) - log.motion_duration)


def _chatter(log: Log) -> float:
    if len(log) <= _REST_TICKS:
        return math.nan
    rests = (log.q_ref[1:] == log.q_ref[:-1]).all(axis=1)
    # The torque of a tick depends on the reference around it.
    around = np.lib.stride_tricks.sliding_window_view(rests, _REST_TICKS).all(axis=1)
    ticks = np.flatnonzero(around) + _REST_TICKS // 2
    return rms(log.tau[ticks] - 0.5 * (log.tau[ticks - 1] + log.tau[ticks + 1]))


def _margin_text(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _length_cell(length: float) -> str:
    return "-" if math.isnan(length) else length_text(length)


def _percent_text(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.0f} %"


def _chatter_text(chatter: float) -> str:
    if math.isnan(chatter):
        return "-"
    return "<0.001" if chatter < _MIN_CHATTER_SHOWN else f"{chatter:.2g}"


def _joint_error(hinges: float, slides: float, *, with_unit: bool) -> str:
    """The error of the hinge joints and that of the slide joints, of those that the arm has."""
    known = [(value, unit) for value, unit in ((hinges, "rad"), (slides, "m")) if not math.isnan(value)]
    texts = ["<1e-15" if value < _MIN_JOINT_ERROR_SHOWN else f"{value:.1e}" for value, _ in known]
    words = [f"{text} {unit}" if with_unit else text for text, (_, unit) in zip(texts, known, strict=True)]
    return " and ".join(words) or "-"


def _deg(angle: float) -> str:
    degrees = math.degrees(angle)
    return f"{degrees:.3g} deg" if degrees >= 1e-6 else "<1e-06 deg"
