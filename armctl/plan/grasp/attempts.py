"""Attempts: lines of the tip beside a body, and why those that cannot be made fail."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.pose import Pose, computed_pose
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.clearance import clearance_of
from armctl.plan.motion.move_cartesian import move_l
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

_SHARES = (1.0, 0.5, 0.25)  # of a line's length, where the whole one cannot be made


class Ways(NamedTuple):
    """How far the tip moves on straight lines, and how fast everything moves."""

    approach: float  # m, from where the open gripper stands off
    lift: float  # m, upwards
    speed: float  # share of the full speed


class Failures:
    """Why the attempts failed: of each pose the reason of the attempt that came farthest."""

    def __init__(self) -> None:
        self.pose = 0  # the number of the pose that is tried now
        self._unreached: set[int] = set()
        self._contacts: dict[int, str] = {}
        self._lines: dict[int, str] = {}

    def add_unreached(self, poses: Iterable[int]) -> None:
        """Notes poses of the tip for which there is no configuration."""
        self._unreached.update(poses)

    def add_contact(self, checker: CollisionChecker, pair: int, pose: int | None = None) -> None:
        """Notes that a pair touches at the pose that is tried, or another one."""
        self._contacts[self.pose if pose is None else pose] = "{1} touches {0}".format(*checker.names(pair))

    def add_obstruction(self, contact: str) -> None:
        """Notes that something touches, in words."""
        self._contacts[self.pose] = contact

    def add_line(self, reason: str) -> None:
        """Notes a motion that cannot be made."""
        self._lines[self.pose] = reason

    def text(self, what: str) -> str:
        """Why none of them could be made; `what` is what was tried, such as "grasps"."""
        contacts = [text for pose, text in self._contacts.items() if pose not in self._lines]
        lines = list(self._lines.values())
        unreached = len(self._unreached - self._contacts.keys() - self._lines.keys())
        total = unreached + len(contacts) + len(lines)
        if not contacts and not lines:
            return f"out of reach: the arm has no configuration for any of {total} {what}"
        parts = []
        if contacts:
            parts.append(f"{len(contacts)} would be in contact, most often {_commonest(contacts)}")
        if lines:
            parts.append(f"{len(lines)} cannot be approached or left, most often: {_commonest(lines)}")
        if unreached:
            parts.append(f"{unreached} are out of reach")
        return f"none of {total} {what} can be made: {'; '.join(parts)}"


def _commonest(texts: list[str]) -> str:
    return Counter(texts).most_common(1)[0][0]


class ProvedMotion(NamedTuple):
    """A motion that is proved."""

    motion: JointTrajectory
    clearance: float  # m, that it keeps at least

    @property
    def end(self) -> Array:
        """(n,) rad, where it ends."""
        return np.array(self.motion(self.motion.duration).q)


def moved(pose: Pose, way: Array) -> Pose:
    """A pose moved by a vector (3,), m, of the world."""
    return computed_pose(pose.position + way, pose.rotation)


def line(
    arm: Arm, start: Array, target: Pose, speed: float, checker: CollisionChecker, failures: Failures
) -> ProvedMotion | None:
    """A proved line to a pose; None, and a failure more, if there is none."""
    try:
        motion = move_l(arm, start, target, speed=speed)
    except PlanError as error:
        failures.add_line(str(error))
        return None
    check = clearance_of(checker, motion, 0.0)
    if not check.ok:
        failures.add_line(check.reason)
        return None
    return ProvedMotion(motion, check.distance)


def longest_line(
    arm: Arm, start: Array, tip: Pose, way: Array, speed: float, checker: CollisionChecker, failures: Failures
) -> ProvedMotion | None:
    """The longest of some shorter and shorter lines along a vector (3,), m, of the world; None if there is none."""
    found = (line(arm, start, moved(tip, share * way), speed, checker, failures) for share in _SHARES)
    return next((each for each in found if each is not None), None)
