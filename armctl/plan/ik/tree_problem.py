"""Inverse kinematics of several tips at once: the tasks of targets by tip, and the arm as a tree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from armctl import _core
from armctl._core import Constraint
from armctl.core.errors import InputError, UnknownNameError, few_names
from armctl.core.pose import Pose
from armctl.core.region import Region
from armctl.core.tip_targets import LookAt, RelativeTo, Stay, TipTarget, TipTargets
from armctl.core.units import length_text
from armctl.core.validation import Array, IntArray, frozen, shown
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.mjmodel.queries import last_joint_above
from armctl.plan.ik.problem import read_target

_WORLD = -1
_NO_ROTATION = np.zeros(9)
_NOWHERE = frozen(np.zeros(12))
_IN_THE_WORLD = np.concatenate([np.eye(3).ravel(), np.zeros(3)])


class TreeTask(NamedTuple):
    """What one tip should reach."""

    tip: str
    constraint: Constraint
    reference: str | None  # the tip in whose frame the target is; None for the world
    points: bool  # whether the tip's z axis should point to the target
    exact: bool  # whether it holds before the others
    stays: bool  # whether the target is where the tip is at the start
    numbers: Array  # (12,) rotation row by row, position


@dataclass(frozen=True, eq=False)
class Tree:
    """An arm as a tree with n unknowns: what does not depend on targets."""

    tips: tuple[str, ...]
    joints: IntArray  # (T,) the joint that carries each tip; -1 for the world
    placements: Array  # (T, 12) the tip in that joint's frame
    reach: float  # m, the longest way from the base to a tip
    unit: Array  # (n,) 1 rad, or the reach for a joint that slides
    fixed: Array  # (4,) kg that no joint moves, and its center, m


class TreeTasks:
    """Targets by tip for one arm: T tasks, and what solves them, with scratch memory: use an object in one thread."""

    def __init__(self, arm: Arm, tasks: list[TreeTask], polygon: Array):
        tree = tree_of(arm)
        rows = [tree.tips.index(task.tip) for task in tasks]
        references = [_WORLD if task.reference is None else tree.tips.index(task.reference) for task in tasks]
        self.tasks = tasks
        self.core = _core.TreeIk(
            arm.core_model,
            joints=tree.joints[rows],
            placements=tree.placements[rows],
            reference_joints=np.array([_WORLD if row == _WORLD else tree.joints[row] for row in references]),
            reference_placements=np.array([_IN_THE_WORLD if row == _WORLD else tree.placements[row] for row in references]),
            constraints=np.array([int(task.constraint.value) for task in tasks]),
            points=np.array([int(task.points) for task in tasks]),
            exact=np.array([int(task.exact) for task in tasks]),
            polygon=polygon,
            reach=tree.reach,
            unit=tree.unit,
            fixed=tree.fixed,
            q_min=arm.limits.q_min,
            q_max=arm.limits.q_max,
            v_max=arm.limits.symmetric.v_max,
            a_max=arm.limits.symmetric.a_max,
        )

    def targets(self, q: Array) -> Array:
        """The targets (T, 12) of the tasks; tips that stay are at their poses at q (n,)."""
        numbers = np.array([task.numbers for task in self.tasks])
        staying = [task.stays for task in self.tasks]
        if any(staying):
            numbers[staying] = self.frames(q)[staying]
        return numbers

    def frames(self, q: Array) -> Array:
        """(T, 12) the poses of the tasks' tips at q (n,)."""
        frames = np.empty((len(self.tasks), 12))
        self.core.frames(q, frames)
        return frames

    def errors(self, targets: Array, q: Array) -> tuple[Array, float]:
        """Errors (T, 2) at q, m and rad, and by how much the center of mass is outside its polygon, m."""
        errors = np.empty((len(self.tasks), 2))
        outside = self.core.errors(targets, np.ascontiguousarray(q), errors)
        return errors, outside


def read_tasks(arm: Arm, targets: TipTargets, free_axis: str | None) -> list[TreeTask]:
    """The tasks of targets by tip, checked; an axis that may turn freely counts for all poses."""
    if not targets:
        raise InputError(f"target: no tip has a target; give one for any of {few_names(arm.tips)}")
    tips = tree_of(arm).tips
    tasks = []
    for tip, target in targets.items():
        if tip not in tips:
            raise UnknownNameError.from_known(f"tip of {arm.name:.60}", tip, tips)
        tasks.append(_read_task(arm, tip, target, free_axis))
    if any(task.reference is not None for task in tasks):
        _check_references(tasks)
    return tasks


def _read_task(arm: Arm, tip: str, target: TipTarget, free_axis: str | None) -> TreeTask:
    if isinstance(target, Stay):
        return _stay(tip)
    if isinstance(target, LookAt):
        numbers = np.concatenate([_NO_ROTATION, target.point])
        return TreeTask(tip, Constraint.FREE_Z, None, points=True, exact=False, stays=False, numbers=numbers)
    if isinstance(target, RelativeTo):
        if target.tip not in arm.tips:
            raise UnknownNameError.from_known(f"tip of {arm.name:.60}", target.tip, arm.tips)
        constraint, numbers = read_target(target.target, free_axis if isinstance(target.target, Pose) else None)
        return TreeTask(tip, constraint, target.tip, points=False, exact=True, stays=False, numbers=numbers)
    if not isinstance(target, (np.ndarray, Pose)) and isinstance(target, (str, Mapping, Region)):
        raise InputError(f"target: {shown(tip)}: expected a Pose, a point, STAY, RelativeTo or LookAt, got {shown(target)}")
    constraint, numbers = read_target(target, free_axis)
    return TreeTask(tip, constraint, None, points=False, exact=False, stays=False, numbers=numbers)


@cache
def _stay(tip: str) -> TreeTask:
    return TreeTask(tip, Constraint.POSE, None, points=False, exact=True, stays=True, numbers=_NOWHERE)


def _check_references(tasks: list[TreeTask]) -> None:
    """Tips that are relative to each other in a ring have no place."""
    reference_of = {task.tip: task.reference for task in tasks}
    for task in tasks:
        seen = [task.tip]
        while (reference := reference_of.get(seen[-1])) is not None:
            if reference in seen:
                raise InputError(
                    f"target: {few_names([*seen, reference])} are relative to each other; give one of them in the world"
                )
            seen.append(reference)


def shortfall(tasks: list[TreeTask], errors: Array, outside: float, tolerances: tuple[float, float]) -> str:
    """How tips with errors (T, 2) miss their targets, by name; empty if none does."""
    misses = [
        _miss(task, position, orientation, tolerances)
        for task, (position, orientation) in zip(tasks, errors.tolist(), strict=True)
    ]
    if outside > tolerances[0]:
        misses.append(f"the center of mass is {length_text(outside)} outside its polygon")
    if not any(misses):
        return ""
    named = [miss or f"{task.tip} is there" for miss, task in zip(misses, tasks, strict=False)]
    return ", ".join([*named, *misses[len(tasks) :]])


def _miss(task: TreeTask, position: float, orientation: float, tolerances: tuple[float, float]) -> str:
    """How one tip misses its target; empty if it does not."""
    is_far = position > tolerances[0]
    parts = [length_text(position)] if is_far else []
    parts += [f"{orientation:.3g} rad"] if orientation > tolerances[1] else []
    where = "from where it should stay" if task.stays else "away" if is_far else "off"
    return f"{task.tip} is {' and '.join(parts)} {where}" if parts else ""


_trees: WeakKeyDictionary[Arm, Tree] = WeakKeyDictionary()


def tree_of(arm: Arm) -> Tree:
    """An arm as a tree, made once for each arm."""
    check_arm(arm)
    if arm not in _trees:
        _trees[arm] = _make_tree(arm)
    return _trees[arm]


def _make_tree(arm: Arm) -> Tree:
    body = arm.pinocchio_model
    carried = [body.carried(k) for k in range(len(arm.tips))]
    joints = np.array([joint for joint, _ in carried])
    placements = np.array([placement for _, placement in carried])
    joint_map = arm.joint_map
    is_slide = arm.model.jnt_type[list(joint_map.joints)] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    reach = (
        max(_way(arm, int(joint)) + float(np.linalg.norm(row[9:])) for joint, row in zip(joints, placements, strict=True))
        or 1.0
    )
    return Tree(
        tips=arm.tips,
        joints=joints,
        placements=placements,
        reach=reach,
        unit=np.where(is_slide[joint_map.leaders], reach, 1.0),
        fixed=_fixed_mass(arm),
    )


def _way(arm: Arm, joint: int) -> float:
    """m, the length of the links from the first joint to a joint."""
    model = arm.pinocchio_model.pin_model
    length = 0.0
    while joint >= 0:
        above = model.parents[joint + 1] - 1
        if above >= 0:
            length += float(np.linalg.norm(model.jointPlacements[joint + 1].translation))
        joint = above
    return length


def _fixed_mass(arm: Arm) -> Array:
    """The mass of the robot that none of its joints moves, kg, and its center (3,), m."""
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_kinematics(model, data)
    roots = set(model.body_rootid[model.jnt_bodyid[list(arm.joint_map.joints)]].tolist())
    owners = last_joint_above(model, arm.joint_map.joints)
    fixed = [body for body in range(1, model.nbody) if owners[body] < 0 and int(model.body_rootid[body]) in roots]
    mass = float(model.body_mass[fixed].sum())
    center = model.body_mass[fixed] @ data.xipos[fixed] / mass if mass else np.zeros(3)
    return np.array([mass, *center])
