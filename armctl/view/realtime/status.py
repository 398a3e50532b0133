"""Status: what a real-time session does at one instant."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.view.realtime.target_follower import PlannedPath


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
    """A session at one instant. It is never changed: each update makes a new one, so any thread can read it."""

    activity: Activity  # what the session does
    failure: str  # why it stands, after DIVERGED and FAILED; else empty
    position_error: float  # from the tip to its target, m; of several tips the largest one
    # by tip from the nearest reachable point to the target, m, of those that a solver has found unreachable
    reach_errors: Mapping[str, float]
    refusal: str  # why the arm does not approach its target, after BLOCKED; else empty
    path: PlannedPath | None  # to the targets; None if none was needed
    contacts: Array  # (k, 2, 3) point, m, and force on the second body, N, of each contact, world axes
    targets: Mapping[str, Pose]  # T_world_tip to reach, by tip; of a free tip of several where it is
    aimed: tuple[str, ...]  # the tips that are not free
    oriented: frozenset[str]  # the tips for which the target's orientation is part of the goal
    joint_control: bool  # whether joint angles were commanded, so that the targets follow the tips
    avoiding: bool  # whether contacts are avoided
    speed_override: float  # share of the speed of motions that the arm moves with
    q: Array  # (n,) rad, where the arm is
    qpos: Array  # (nq,) positions of the whole model
    controller: str
    payload: float  # mass at the tip, kg
    gripper_widths: Mapping[str, float]  # between the pads of the gripper at a tip, m
    paused: bool  # whether time stands still
    elapsed: float  # simulated time since the session began, s; `reset` does not change it
    speed: float  # simulated seconds per second that are commanded
    real_time_factor: float  # share of that speed that is achieved

    @property
    def target(self) -> Pose:
        """The target of the first tip."""
        return next(iter(self.targets.values()))
