"""move_l by tip: several tips on straight lines, all of them on the way at the same share of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, PlanError
from armctl.core.pose import Pose, computed_pose
from armctl.core.tip_targets import TipTargets
from armctl.core.validation import Array, shown
from armctl.model.arm.arm import Arm
from armctl.plan.ik.resting_joints import resting_joints
from armctl.plan.ik.solve import solve_ik
from armctl.plan.ik.solve_tree import closed_reason
from armctl.plan.ik.tree_problem import TreeTask, TreeTasks, read_tasks, shortfall
from armctl.plan.motion.checks import planning_arm
from armctl.plan.motion.path.joint_path import JointPath
from armctl.plan.motion.path.path_segments import MIN_LENGTH, Straight, Turn
from armctl.plan.motion.timed_along import FINE, timed_along
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import check_limits
from armctl.plan.motion.trajectory.piecewise import standing

_FEWEST_STEPS = 64
_MOST_STEPS = 2048
_MAX_JOINT_STEP = 0.05  # rad (m), of any joint: a longer one is a jump to another branch
_MAX_RESIDUAL = 1e-10  # m and rad: what is left makes a jerk
_ON_LINES = 1e-6  # m and rad, of the spline between the steps


def tip_lines(arm: Arm, q_start: Pose | ArrayLike, targets: TipTargets, options: Mapping[str, Any]) -> JointTrajectory:
    """The motion of `move_l` with targets by tip, from rest; the options are its own. Errors as there."""
    if isinstance(q_start, Pose):
        raise InputError("q_start: targets by tip start at joint positions; a pose is for an arm with one tip")
    planning = planning_arm(arm, options.get("speed", 1.0))
    q = arm.checked("q_start", q_start)
    lines = _TipLines(arm, targets, q)
    if lines.length <= MIN_LENGTH:
        return JointTrajectory(*standing(q), arm.joint_names, arm.limits, units=arm.units)
    motion = timed_along(arm, planning.limits, lines.joint_path(), options, tips=lines.moved, fineness=FINE).motion
    check = check_limits(motion.pieces, arm.limits, arm.joint_names, arm.units)
    if not check.ok:
        raise PlanError(f"move_l: {check.violations[0]}; start from other joint positions for the same poses of the tips")
    return motion


class _TipLines:
    """Lines of tips from where they are at q to their targets."""

    def __init__(self, arm: Arm, targets: TipTargets, q: Array):
        self._arm = arm
        self._targets = targets
        self._tasks = read_tasks(arm, targets, None)
        for task in self._tasks:
            if task.points:
                raise InputError(f"target: {shown(task.tip)} looks at a point, which is no end of a line; move_to takes it")
        self._tree = TreeTasks(arm, self._tasks, np.empty((0, 3)))
        self._q = q
        self._rests = np.logical_or(*resting_joints(arm, targets))
        self._lines = [self._line(task) for task in self._tasks]
        self.length = max(line.length for line in self._lines)
        self.moved = tuple(task.tip for task in self._tasks)

    def _line(self, task: TreeTask) -> Straight:
        """From where a tip is to its target, both in the frame of its reference."""
        begin = self._arm.fk(self._q, task.tip)
        if task.reference is not None:
            begin = self._arm.fk(self._q, task.reference).inverse() @ begin
        if task.stays:
            return Straight(begin.position, begin.position, Turn.between(begin.rotation, begin.rotation))
        end = computed_pose(task.numbers[9:], task.numbers[:9].reshape(3, 3)) if task.numbers[:9].any() else begin
        return Straight(begin.position, task.numbers[9:], Turn.between(begin.rotation, end.rotation))

    def _numbers(self, share: float) -> Array:
        """(T, 12) the targets at a share of the way."""
        numbers = np.empty((len(self._lines), 12))
        for row, line in zip(numbers, self._lines, strict=True):
            position, rotation = line.pose_at(share)
            row[:9] = rotation.ravel()
            row[9:] = position
        return numbers

    def joint_path(self) -> JointPath:
        """The joints that keep all tips on their lines. PlanError where they cannot."""
        steps = _FEWEST_STEPS
        while True:
            shares = np.linspace(0.0, 1.0, steps + 1)
            q = self._walked(shares)
            path = JointPath.through(shares * self.length, q)
            between = 0.5 * (shares[1:] + shares[:-1])
            missed = self._missed(path.derivatives(between * self.length)[0], between)
            jumps = np.abs(np.diff(q, axis=0)).max(axis=1)
            if not missed.any() and jumps.max() <= _MAX_JOINT_STEP:
                return path
            if steps == _MOST_STEPS:
                worst = int(missed.argmax()) if missed.any() else int(jumps.argmax())
                i = int(np.abs(q[worst + 1] - q[worst]).argmax())
                raise PlanError(
                    f"{self._where(float(between[worst]))} {self._arm.joint_names[i]} would have to turn at once; "
                    "start from other joint positions for the same poses of the tips"
                )
            steps *= 2

    def _walked(self, shares: Array) -> Array:
        """(S, n) joint positions at shares of the way, each found from the one before."""
        q = np.array(self._q)
        rows = [q]
        for share in shares[1:].tolist():
            goals = self._numbers(share)
            q = q.copy()
            self._tree.core.search(goals, _MAX_RESIDUAL, _MAX_RESIDUAL, 0, 1, 0, q)
            q = np.where(self._rests, self._q, q)
            errors, outside = self._tree.errors(goals, q)
            reason = shortfall(self._tasks, errors, outside, (_ON_LINES, _ON_LINES)) or closed_reason(self._arm, q)
            if reason:
                raise PlanError(f"{self._where(share)} {reason}; {self._advice(rows[-1])}")
            rows.append(q)
        return np.array(rows)

    def _advice(self, q: Array) -> str:
        """What may be done where the arm can go no further than q."""
        end = solve_ik(self._arm, self._targets, self._q)
        if not end.ok:
            return f"the end of the lines: {end.reason}"
        limits = self._arm.limits
        room = np.minimum(q - limits.q_min, limits.q_max - q) / np.maximum(limits.q_max - limits.q_min, 1e-9)
        i = int(np.where(np.isfinite(room), room, np.inf).argmin())
        if room[i] < 0.01:
            return (
                f"{self._arm.joint_names[i]} is at its limit there: start from other joint positions, or bring the line nearer"
            )
        return "bring the line nearer, or go there with move_to"

    def _missed(self, q: Array, shares: Array) -> Array:
        """(S,) whether the tips are off their lines at joint positions (S, n)."""
        errors = [self._tree.errors(self._numbers(share), row)[0] for share, row in zip(shares.tolist(), q, strict=True)]
        oriented = np.array([bool(task.numbers[:9].any()) or task.stays for task in self._tasks])
        return np.array([max(each[:, 0].max(), each[oriented, 1].max(initial=0.0)) > _ON_LINES for each in errors])

    def _where(self, share: float) -> str:
        return f"move_l: at {100 * share:.1f} % of the lines"
