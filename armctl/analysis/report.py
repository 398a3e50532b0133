"""Report: what a log says, led by a verdict."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armctl.analysis.plot import four_panels
from armctl.core import units
from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.target import ANGLE_TOLERANCE, TOLERANCE
from armctl.core.validation import Array, BoolArray, instance


@dataclass(frozen=True)
class Report:
    """The figures of one run. A figure that has no meaning for the run is NaN (null in `to_dict`).

    Attributes:
        ok: Whether the run went to its end and the tip ended at its goal and stayed there.
        verdict: Why, in words.
        robot: The arm's name.
        controller: The controller's name.
        plant: How reality differed from the model, in words.
        joint_rms_rad: Root mean square over ticks and joints of q_ref - q while the reference moves.
        joint_max_rad: The largest of these.
        tip_rms_m: Root mean square distance of the tip from the reference's while that moves.
        tip_max_m: The largest of these.
        final_tip_error_m: The tip's distance from its goal at the end: the target of a move, else the end of the reference.
        final_orientation_error_rad: Likewise; 0 where the target had no orientation.
        settling_time_s: From the end of the reference's motion until the tip stays within the tolerance; NaN if it never does.
        overshoot_m: How far beyond its goal the tip went, along the straight line from its start.
        peak_torque_ratio: The largest torque over its limit.
        saturated_fraction: Share of ticks at which some motor was asked for more than it can give.
        chatter_nm: Root mean square of how far a torque is from the mean of its neighbours in time.
        duration_s: Simulated time.
        real_time_factor: Simulated time over the time it took.
        log: The run itself.
    """

    ok: bool
    verdict: str
    robot: str
    controller: str
    plant: str
    joint_rms_rad: float
    joint_max_rad: float
    tip_rms_m: float
    tip_max_m: float
    final_tip_error_m: float
    final_orientation_error_rad: float
    settling_time_s: float
    overshoot_m: float
    peak_torque_ratio: float
    saturated_fraction: float
    chatter_nm: float
    duration_s: float
    real_time_factor: float
    log: Log

    @classmethod
    def from_log(cls, log: Log, tolerance: float = TOLERANCE, angle_tolerance: float = ANGLE_TOLERANCE) -> Report:
        """The report of a run.

        Args:
            log: The run; it must have had a reference to follow.
            tolerance: m within which the tip is at its goal.
            angle_tolerance: rad, likewise.

        Returns:
            The report.

        Raises:
            InputError: The log is empty or of an open-loop run.
        """
        instance("log", log, Log, "armctl.simulate and every move of a Simulation give one")
        if len(log) == 0 or log.is_open_loop:
            raise InputError(
                "log: it has no tick with a reference, so there is nothing to report on; armctl.four_panels draws it"
            )
        moving = log.t <= log.motion_duration + 0.5 * log.dt
        joint_error = (log.q_ref - log.q)[moving]
        tip_error = np.linalg.norm(log.tip - log.tip_ref, axis=1)[moving]
        goal, goal_quat = _goal(log)
        distance = np.linalg.norm(log.tip - goal, axis=1)
        final = float(distance[-1])
        angle = _angle(log.tip_quat[-1], goal_quat)
        settling = _settling_time(log, distance <= tolerance)
        return cls(
            ok=not log.failure and final <= tolerance and angle <= angle_tolerance,
            verdict=_verdict(log, final, angle, tolerance, angle_tolerance),
            robot=log.robot,
            controller=log.controller,
            plant=log.plant,
            joint_rms_rad=_rms(joint_error),
            joint_max_rad=float(np.abs(joint_error).max()),
            tip_rms_m=_rms(tip_error),
            tip_max_m=float(tip_error.max()),
            final_tip_error_m=final,
            final_orientation_error_rad=angle,
            settling_time_s=settling,
            overshoot_m=_overshoot(log.tip, goal),
            peak_torque_ratio=float(np.abs(log.tau / log.tau_max).max()),
            saturated_fraction=float((np.abs(log.tau_cmd) > log.tau_max * (1 + 1e-9)).any(axis=1).mean()),
            chatter_nm=_rms(log.tau[1:-1] - 0.5 * (log.tau[:-2] + log.tau[2:])) if len(log) > 2 else 0.0,
            duration_s=len(log) * log.dt,
            real_time_factor=log.real_time_factor,
            log=log,
        )

    def to_dict(self) -> dict[str, object]:
        """The figures by name, fit for JSON: NaN becomes None.

        Returns:
            Every attribute but the log.
        """
        figures = {k: v for k, v in self.__dict__.items() if k != "log"}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in figures.items()}

    def plot(self, path: str | os.PathLike[str] | None = None) -> Path | None:
        """Draws joint angles, velocities, torques with their limits, and the tip, over time.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made. Left out, a window opens.

        Returns:
            The path, if one was given.
        """
        return four_panels(self.log, path)

    def __str__(self) -> str:
        unit, torque_unit = units.label(self.log.units), units.label(units.of_torque(self.log.units))
        settled = f"settled after {self.settling_time_s:.3f} s" if math.isfinite(self.settling_time_s) else "never settled"
        turned = "" if np.isnan(_goal(self.log)[1]).any() else f", {_deg(self.final_orientation_error_rad)}"
        lines = [
            self.verdict,
            f"  run          {self.robot}, {self.controller}, {self.duration_s:.3f} s in ticks of {1e3 * self.log.dt:g} ms,"
            f" {self.real_time_factor:.0f} times real time",
            f"  tip error    final {_mm(self.final_tip_error_m)}{turned}; while moving RMS {_mm(self.tip_rms_m)},"
            f" max {_mm(self.tip_max_m)}",
            f"  joint error  while moving RMS {_rad(self.joint_rms_rad)} {unit}, max {_rad(self.joint_max_rad)} {unit}",
            f"  at the goal  {settled}, overshoot {_mm(self.overshoot_m)}",
            f"  torque       peak {100 * self.peak_torque_ratio:.0f} % of the limit, saturated"
            f" {100 * self.saturated_fraction:.1f} % of the time, chatter {self.chatter_nm:.2g} {torque_unit}",
        ]
        return "\n".join(lines)


def table(reports: list[Report]) -> str:
    """Reports side by side, as a Markdown table.

    Args:
        reports: The reports, one a row.

    Returns:
        The table.
    """
    joints = [unit for r in reports for unit in r.log.units]
    header = [
        "controller",
        "plant",
        f"joint RMS, {units.label(joints)}",
        f"joint max, {units.label(joints)}",
        "tip RMS",
        "tip max",
        "final tip error",
        "peak torque",
        f"chatter, {units.label(units.of_torque(joints))}",
        "verdict",
    ]
    rows = [
        [
            r.controller,
            r.plant,
            _rad(r.joint_rms_rad),
            _rad(r.joint_max_rad),
            _mm(r.tip_rms_m),
            _mm(r.tip_max_m),
            _mm(r.final_tip_error_m),
            f"{100 * r.peak_torque_ratio:.0f} %",
            f"{r.chatter_nm:.1g}",
            r.verdict.split(":")[0],
        ]
        for r in reports
    ]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = [[cell.ljust(w) for cell, w in zip(row, widths, strict=True)] for row in [header, *rows]]
    lines.insert(1, ["-" * w for w in widths])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _goal(log: Log) -> tuple[Array, Array]:
    """Where the tip should end: (3,) m and (4,) wxyz, NaN where the orientation does not matter."""
    if np.isnan(log.target[:3]).any():
        return log.tip_ref[-1], log.tip_ref_quat[-1]
    return log.target[:3], log.target[3:]


def _verdict(log: Log, final: float, angle: float, tolerance: float, angle_tolerance: float) -> str:
    if log.failure:
        return f"failed: {log.failure}"
    if final > tolerance:
        return f"not reached: the tip ended {_mm(final)} from its goal ({_mm(tolerance)} allowed)"
    if angle > angle_tolerance:
        return f"not reached: the tip ended {angle:.3g} rad from its orientation ({angle_tolerance:g} rad allowed)"
    return f"reached: the tip ended {_mm(final)} from its goal after {len(log) * log.dt:.2f} s"


def _settling_time(log: Log, inside: BoolArray) -> float:
    if not inside[-1]:
        return math.nan
    outside = np.flatnonzero(~inside)
    entered = log.t[outside[-1]] + log.dt if len(outside) else 0.0
    return max(0.0, float(entered) - log.motion_duration)


def _overshoot(tip: Array, goal: Array) -> float:
    way = goal - tip[0]
    length = float(np.linalg.norm(way))
    return max(0.0, float(((tip - goal) @ way).max()) / length) if length > 1e-9 else 0.0


def _angle(quat: Array, goal_quat: Array) -> float:
    if np.isnan(goal_quat).any():
        return 0.0
    chord = min(float(np.linalg.norm(quat - goal_quat)), float(np.linalg.norm(quat + goal_quat)))
    return 4 * math.asin(min(1.0, 0.5 * chord))


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def _mm(metres: float) -> str:
    if metres < 1e-9:
        return "<1 nm"
    return f"{1e3 * metres:.3g} mm" if metres >= 1e-6 else f"{1e9 * metres:.0f} nm"


def _rad(angle: float) -> str:
    return f"{angle:.1e}" if angle >= 1e-15 else "<1e-15"


def _deg(angle: float) -> str:
    degrees = math.degrees(angle)
    return f"{degrees:.3g} deg" if degrees >= 1e-6 else "<1e-06 deg"
