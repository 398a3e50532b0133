"""The errors of the tips in a run."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armctl.core.log import Log, TipLog
from armctl.core.validation import Array, BoolArray


class TipErrors(NamedTuple):
    """The errors of one tip in a run.

    Attributes:
        final_m: m, the distance from its goal at the end: its target, or else the end of its reference.
        final_orientation_rad: rad, the angle from the goal's orientation at the end; 0 if the target had none.
        rms_m: m, the root mean square distance from its reference, while that moves.
        max_m: m, the largest of these distances.
        has_target: Whether it had a target.
    """

    final_m: float
    final_orientation_rad: float
    rms_m: float
    max_m: float
    has_target: bool


def errors_of(tip: TipLog, moving: BoolArray) -> TipErrors:
    """The errors of a tip; `moving` are the ticks (T,) at which the reference moves."""
    goal, goal_quat = goal_of(tip)
    error = np.linalg.norm(tip.position - tip.position_ref, axis=1)[moving]
    return TipErrors(
        final_m=float(np.linalg.norm(tip.position - goal, axis=1)[-1]),
        final_orientation_rad=_angle(tip.quat[-1], goal_quat),
        rms_m=rms(error),
        max_m=largest(error),
        has_target=has_target(tip),
    )


def judged_tips(log: Log) -> dict[str, TipLog]:
    """The tips of a log that have a target, by name; all, if none has one."""
    return {name: tip for name, tip in log.tips.items() if has_target(tip)} or log.tips


def has_target(tip: TipLog) -> bool:
    return not np.isnan(tip.target[:3]).any()


def goal_of(tip: TipLog) -> tuple[Array, Array]:
    """The final position, (3,) m, and orientation, (4,) wxyz or NaN if it is free."""
    if has_target(tip):
        return tip.target[:3], tip.target[3:]
    return tip.position_ref[-1], tip.quat_ref[-1]


def distances(tip: TipLog) -> Array:
    """(T,) m, from the goal."""
    return np.linalg.norm(tip.position - goal_of(tip)[0], axis=1)


def vibration(positions: Array) -> float:
    return largest(np.linalg.norm(positions - positions.mean(axis=0), axis=1)) if len(positions) else math.nan


def overshoot(tip: TipLog) -> float:
    """m, how far the tip went beyond its goal, more than its reference did."""
    goal = goal_of(tip)[0]
    return max(0.0, _beyond(tip.position, goal) - _beyond(tip.position_ref, goal))


def _beyond(tip: Array, goal: Array) -> float:
    way = goal - tip[0]
    length = float(np.linalg.norm(way))
    return max(0.0, float(((tip - goal) @ way).max()) / length) if length > 1e-9 else 0.0


def _angle(quat: Array, goal_quat: Array) -> float:
    if np.isnan(goal_quat).any():
        return 0.0
    chord = min(float(np.linalg.norm(quat - goal_quat)), float(np.linalg.norm(quat + goal_quat)))
    return 4 * math.asin(min(1.0, 0.5 * chord))


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x)))) if x.size else math.nan


def largest(x: Array) -> float:
    return float(np.abs(x).max()) if x.size else math.nan
