"""Several arms of one model to goals of their own at once, proved to touch neither each other nor anything else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, product

import mujoco
import numpy as np

from armctl.core.errors import PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm
from armctl.model.arm.joint_map import JointMap
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import restarted
from armctl.plan.planner.move_free import (
    MAX_ROOTS,
    MAX_SAMPLES,
    FreeSpace,
    find_path,
    flowing_motion,
    overlap_in_words,
    require_free_start,
    shorten,
    spaces_between,
)

_MAX_COMBINATIONS = 256  # of the solutions of all arms
_TORQUE_STRETCH = 1.05
_MAX_STRETCHES = 60


@dataclass(frozen=True, eq=False)
class ArmGroup:
    """Several arms as one: their joints one after another. It has what planning needs of an Arm."""

    model: mujoco.MjModel
    joint_names: tuple[str, ...]  # the N joints
    joint_map: JointMap  # how they move all joints that are coupled to them
    limits: Limits  # their limits
    units: tuple[str, ...]  # what each is measured in
    home: Array  # (N,) rad
    home_qpos: Array  # (nq,) the whole model at home
    unchecked_links: tuple[str, ...]  # links without a collision shape that they need

    @classmethod
    def from_arms(cls, arms: Sequence[Arm], speed: float = 1.0) -> ArmGroup:
        """The group of some arms of one model, with the limits of a fraction of the full speed."""
        actuation = Actuation.concatenated([arm.actuation for arm in arms])
        return cls(
            model=arms[0].model,
            joint_names=actuation.joint_names,
            joint_map=actuation.joint_map,
            limits=actuation.limits.at_speed(speed),
            units=actuation.units,
            home=np.concatenate([arm.home for arm in arms]),
            home_qpos=arms[0].home_qpos,
            unchecked_links=arms[0].unchecked_links,
        )


def plan_together(
    checker: CollisionChecker,
    arms: Mapping[str, Arm],
    starts: Mapping[str, Array],
    solutions: Mapping[str, Sequence[Array]],
    speed: float,
) -> dict[str, JointTrajectory]:
    """Motions of several arms that start at once and are proved together.

    Each arm goes straight if all together are proved free. Otherwise one path is planned in the joint space of all arms.
    """
    rng = np.random.default_rng(0)
    group = ArmGroup.from_arms(list(arms.values()), speed)
    start = np.concatenate([starts[tip] for tip in arms])
    require_free_start(checker, start)
    goals, freest = _goals(checker, arms, starts, solutions)
    ends = np.cumsum([arm.n for arm in arms.values()]).tolist()
    columns = {tip: slice(end - arm.n, end) for (tip, arm), end in zip(arms.items(), ends, strict=True)}
    straight = [{tip: move_j(arms[tip], starts[tip], goal[columns[tip]], speed=speed) for tip in solutions} for goal in goals]
    refusal = ""
    for path_space, motion_space in spaces_between(FreeSpace(checker), [start, freest]):
        for motions in straight:
            if motion_space.checker.motion_hit(*combined(motions, columns, start), motion_space.clearance) is None:
                return motions
        found = find_path(path_space, start, goals, group.limits, rng)
        if found is None:
            refusal = f"no collision-free path of the arms together found after {MAX_SAMPLES} samples; move one after the other"
            continue
        motion = flowing_motion(motion_space, group, shorten(path_space, found.points, rng))
        if motion is not None:
            return _within_torques({tip: _part(motion, arms[tip], columns[tip]) for tip in solutions}, arms)
        refusal = "the path of the arms is free, but no motion along it could be proved; move one after the other"
    raise PlanError(refusal)


def _part(motion: JointTrajectory, arm: Arm, columns: slice) -> JointTrajectory:
    """The motion of one arm of several."""
    coefficients = np.ascontiguousarray(motion.coefficients[:, :, columns])
    return JointTrajectory(
        knots=motion.knots, coefficients=coefficients, joint_names=arm.joint_names, limits=arm.limits, units=arm.units
    )


def combined(motions: Mapping[str, JointTrajectory], columns: Mapping[str, slice], start: Array) -> tuple[Array, Array]:
    """Motions that start at once as one: knots (K + 1,) s, coefficients (K, 6, N). Joints without a motion stay at `start`."""
    # Motions that take no time at all still need one interval, in which the arms stand.
    knots = np.unique(np.concatenate([[0.0, 1e-9], *(motion.knots for motion in motions.values())]))
    starts = knots[:-1]
    middles = 0.5 * (starts + knots[1:])
    coefficients = np.zeros((len(starts), 6, len(start)))
    coefficients[:, 0] = start
    for tip, motion in motions.items():
        moves = middles < motion.duration
        coefficients[moves, :, columns[tip]] = restarted(motion.pieces, middles[moves], starts[moves])
        coefficients[~moves, 0, columns[tip]] = motion(motion.duration).q
    return knots, coefficients


def _goals(
    checker: CollisionChecker, arms: Mapping[str, Arm], starts: Mapping[str, Array], solutions: Mapping[str, Sequence[Array]]
) -> tuple[Array, Array]:
    """(g, N) combinations of the arms' solutions that touch nothing, the nearest first, and the freest of them."""
    choices = [solutions.get(tip, [starts[tip]]) for tip in arms]
    start = np.concatenate([starts[tip] for tip in arms])
    candidates = [np.concatenate(parts) for parts in islice(product(*choices), _MAX_COMBINATIONS)]
    candidates.sort(key=lambda q: float(np.linalg.norm(q - start)))
    free: list[Array] = []
    distances: list[float] = []
    for q in candidates:
        _, distance = checker.nearest(q)
        if distance > 0.0:
            free.append(q)
            distances.append(distance)
        if len(free) == MAX_ROOTS:
            break
    if not free:
        pair, _ = checker.nearest(candidates[0])
        words = overlap_in_words(checker, candidates[0], pair)
        raise PlanError(f"the goals cannot be reached together without contact: {words}")
    return np.array(free), free[int(np.argmax(distances))]


def _within_torques(motions: dict[str, JointTrajectory], arms: Mapping[str, Arm]) -> dict[str, JointTrajectory]:
    """All motions slower by one factor, so that they stay together, until no motor saturates."""
    for _ in range(_MAX_STRETCHES):
        worst = max((check_torque(arms[tip], motion) for tip, motion in motions.items()), key=lambda check: check.ratio)
        if worst.ok:
            return motions
        motions = {tip: motion.scaled(1 / _TORQUE_STRETCH) for tip, motion in motions.items()}
    raise PlanError("the motors saturate however slowly the arms move; take a lighter payload or another path")
