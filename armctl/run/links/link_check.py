"""LinkCheck: how regularly positions reach a robot; and whether a model is the robot that is connected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from armctl.core import units
from armctl.core.pose import Pose, computed_pose
from armctl.core.result import Verdict
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.queries import placed
from armctl.run.links.link import Reading

if TYPE_CHECKING:
    from armctl.run.links.link_drive import LinkDrive

_MAX_LOST_SHARE = 0.01
TIP_TOLERANCE_M = 2e-3
_RANGE_TOLERANCE = 1e-3  # rad: encoders may read a little more than the range
_PAYLOAD_TOLERANCE_KG = 1e-3


@dataclass(frozen=True)
class LinkCheck(Verdict):
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
    return LinkCheck(
        ok=not reason,
        reason=reason,
        robot=drive.description,
        tip_difference=tip_difference,
        readings=len(times),
        lost=lost,
        period=float(median),
        period_p99=float(p99),
    )


def base_pose(arm: Arm) -> Pose:
    """T_world_base: the body that carries the first joint."""
    data = placed(arm.model, arm.home_qpos)
    base = arm.model.body_parentid[arm.model.dof_bodyid[arm.dof_adr[0]]]
    return computed_pose(data.xpos[base], data.xmat[base].reshape(3, 3))


def tip_difference(arm: Arm, q: Array, T_base_tip: Array) -> float:
    """m, between the tip of the model and that of the robot."""
    robot = (base_pose(arm) @ Pose.from_matrix(T_base_tip)).position
    return float(np.linalg.norm(arm.fk(q).position - robot))


def model_refusal(arm: Arm, reading: Reading, T_base_tip: Array | None, set_payload: float | None, payload: float) -> str:
    """Why a model with a payload, kg, is not the robot; empty if nothing that the robot tells speaks against it."""
    if len(reading.q) != arm.n:
        return f"the robot has {len(reading.q)} joints, the model {arm.name:.60} has {arm.n}"
    outside = np.maximum(arm.limits.q_min - reading.q, reading.q - arm.limits.q_max)
    joint = int(outside.argmax())
    if outside[joint] > _RANGE_TOLERANCE:
        low = arm.limits.q_min[joint]
        high = arm.limits.q_max[joint]
        return (
            f"{arm.joint_names[joint]} of the robot is at {reading.q[joint]:.4f} rad, outside the range of the model, "
            f"[{low:.4f}, {high:.4f}] rad; move it into the range by hand, or load the right model"
            f"{units.question(arm.units[joint], float(outside[joint]), 'a link reads rad')}"
        )
    if T_base_tip is not None:
        difference = tip_difference(arm, reading.q, T_base_tip)
        if difference > TIP_TOLERANCE_M:
            return (
                f"the tip of the model {arm.name:.60} is {1e3 * difference:.1f} mm from the tip that the robot computes, "
                f"at most {1e3 * TIP_TOLERANCE_M:g} mm; the model lacks a tool, or the robot has another one set"
            )
    if set_payload is not None and abs(set_payload - payload) > _PAYLOAD_TOLERANCE_KG:
        return (
            f"the robot is set to a payload of {set_payload:g} kg, the program says {payload:g} kg; "
            "set the robot's load, or give payload= to the Robot"
        )
    return ""
