"""LinkCheck: how regularly rows reach a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.validation import Array

if TYPE_CHECKING:
    from armctl.links.link_drive import LinkDrive

_MAX_LOST_SHARE = 0.01


@dataclass(frozen=True)
class LinkCheck:
    """What `Robot.check` found. `bool(check)` is `check.ok`.

    Attributes:
        ok: Whether at most one tick in a hundred was lost, and no fault came.
        reason: Why not; empty if it is.
        robot: The robot in words.
        tip_difference: m, between the tip of the model and that of the robot; NaN if the robot does not tell.
        readings: How many came.
        lost: How many ticks were lost.
        period: s, the median time between two readings, by the robot's clock.
        period_p99: s, the time that 99 of 100 periods do not exceed.
    """

    ok: bool
    reason: str
    robot: str
    tip_difference: float
    readings: int
    lost: int
    period: float
    period_p99: float

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        tip = "the robot does not tell its tip"
        if not np.isnan(self.tip_difference):
            tip = f"tip of the model {1e3 * self.tip_difference:.3f} mm from that of the robot"
        verdict = "ok" if self.ok else self.reason
        return (
            f"{self.robot}: {tip}; {self.readings} readings, period {1e3 * self.period:.3f} ms "
            f"(99 %: {1e3 * self.period_p99:.3f} ms), {self.lost} ticks lost: {verdict}"
        )


def link_check_of(drive: LinkDrive, tip_difference: float, times: Array, lost: int) -> LinkCheck:
    periods = np.diff(times)
    reason = drive.failure
    if not reason and lost > _MAX_LOST_SHARE * (len(times) + lost):
        reason = f"{lost} of {len(times) + lost} ticks were lost; end other programs, or use a kernel with real-time priority"
    median, p99 = np.quantile(periods, [0.5, 0.99]) if len(periods) else (np.nan, np.nan)
    return LinkCheck(not reason, reason, drive.description, tip_difference, len(times), lost, float(median), float(p99))
