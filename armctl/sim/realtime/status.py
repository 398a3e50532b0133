"""Status: what a real-time session does at one instant."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.sim.realtime.target_follower import PlannedPath


class Activity(Enum):
    """What a session does. After DIVERGED and FAILED it stands until `reset`."""

    FOLLOWING = "following"
    PLANNING = "planning"
    BLOCKED = "blocked"
    AT_TARGET = "at target"
    OUT_OF_REACH = "out of reach"
    SAGGING = "sagging"
    PAUSED = "paused"
    DIVERGED = "diverged"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """A session at one instant. It is never changed: each update makes a new one, so any thread can read it.

    Attributes:
        activity: What the session does.
        failure: Why it stands, after DIVERGED and FAILED; else empty.
        position_error: Distance from the tip to the target, m.
        reach_error: Distance from the nearest reachable point to the target, m; None while no solver has found it unreachable.
        refusal: Why the arm does not approach its target, after BLOCKED; else empty.
        path: The planned path to the target; None if none was needed.
        contacts: (k, 2, 3) point, m, and force on the second body, N, of each contact, world axes.
        target: T_world_tip to reach.
        oriented: Whether the target's orientation is part of the goal.
        joint_control: Whether joint angles were commanded, so that the target follows the tip.
        avoiding: Whether contacts are avoided.
        speed_override: Share of the speed of motions that the arm moves with.
        q: (n,) rad, where the arm is.
        qpos: (nq,) positions of the whole model.
        payload: Mass at the tip, kg.
        gripper_width: Width between the gripper's pads, m; None without a gripper.
        paused: Whether time stands still.
        elapsed: Simulated time since the session began, s; `reset` does not change it.
        speed: Simulated seconds per second that are commanded.
        real_time_factor: Share of that speed that is achieved.
    """

    activity: Activity
    failure: str
    position_error: float
    reach_error: float | None
    refusal: str
    path: PlannedPath | None
    contacts: Array
    target: Pose
    oriented: bool
    joint_control: bool
    avoiding: bool
    speed_override: float
    q: Array
    qpos: Array
    controller: str
    payload: float
    gripper_width: float | None
    paused: bool
    elapsed: float
    speed: float
    real_time_factor: float
