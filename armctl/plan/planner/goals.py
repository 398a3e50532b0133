"""The goal of a motion: the poses, points, configurations and targets by tip that a caller gives, and their configurations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from armctl.core.errors import InputError, PlanError
from armctl.core.pose import Pose, computed_pose
from armctl.core.region import Region
from armctl.core.target import Target
from armctl.core.tip_targets import TipTargets, targets_by_tip
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.kept_region import KeptRegion
from armctl.plan.ik.reachability import ORIENTATION_TOLERANCE, POSITION_TOLERANCE
from armctl.plan.ik.region_solutions import SAME_CONFIGURATION, STARTS, RegionSearch
from armctl.plan.ik.resting_joints import RestingJoints, resting_joints
from armctl.plan.ik.solve import solve_ik

_IK_TRIES = 24  # starts from which solutions for a pose or a point are looked for
_MAX_IK_TRIES = 500  # as long as no solution is free
MAX_ROOTS = 8  # of the goal tree, for each pose or point
_GOAL_ROOM = 0.05  # of the range of an angle in which the tip stays, beside its limits
MAX_REGION_ROOTS = 24  # for each region

FreeGoal = Any  # Pose | ArrayLike | Sequence[Pose | ArrayLike]: the type ArrayLike includes Sequence


def overlap_in_words(checker: CollisionChecker, q: Array, pair: int) -> str:
    """Which bodies of a pair overlap, and how deep."""
    first, second = checker.names(pair)
    depth = max(checker.depth(q, pair), 0.0)
    return f"{second} is {1e3 * depth:.1f} mm inside {first}"


class FreeConfigurations(NamedTuple):
    """Free configurations of a goal."""

    q: Array  # (g, n) rad, the nearest to the start first
    freest: Array  # (n,) rad


class FreeGoals:
    """The free configurations of a goal, which are looked for in stages."""

    def __init__(
        self,
        checker: CollisionChecker,
        keep: KeptRegion | None,
        arm: Arm,
        start: Array,
        goal: FreeGoal,
        rng: np.random.Generator,
    ):
        self._checker = checker
        self._keep = keep
        self._start = start
        self._searches = [
            _search_for(arm, start, candidate, rng, lambda q: checker.nearest(q)[1] > 0.0, keep)
            for candidate in _goal_list(arm, goal)
        ]
        self._count = 0

    def first(self) -> FreeConfigurations:
        """Some of them. Raises PlanError if there is none."""
        found, refusal = self._found(_IK_TRIES + 1, 1)
        if found is None:
            # One goal of a list is enough: those that are hard to reach are searched further only if all of them are.
            found, refusal = self._found(_MAX_IK_TRIES + 2, 1)
        if found is None:
            raise PlanError(refusal)
        return found

    def more(self) -> FreeConfigurations | None:
        """Those and further ones, where no path leads to the first; None if there are no others."""
        before = self._count
        found, _ = self._found(_MAX_IK_TRIES + 2, MAX_REGION_ROOTS)
        return found if self._count > before else None

    def _found(self, tries: int, enough: int) -> tuple[FreeConfigurations | None, str]:
        """What is free after so many starts, or as soon as so many are; or why nothing is."""
        found: list[Array] = []
        distances: list[float] = []
        refusals: list[str] = []
        for search in self._searches:
            search.extend(tries, enough)
            refusals += [search.refusal] if search.refusal else []
            for q in search.found:
                if self._keep is not None and (why := _why_not_kept(self._keep, q)):
                    refusals.append(f"goal: {why}")
                    continue
                pair, distance = self._checker.nearest(q)
                if distance > 0.0:
                    found.append(q)
                    distances.append(distance)
                else:
                    refusals.append(f"the goal cannot be reached without contact: {overlap_in_words(self._checker, q, pair)}")
        self._count = len(found)
        if not found:
            return None, refusals[0] if refusals else ""
        order = np.argsort([np.linalg.norm(q - self._start) for q in found], kind="stable")
        return FreeConfigurations(np.array(found)[order], found[int(np.argmax(distances))]), ""


def _goal_list(arm: Arm, goal: FreeGoal) -> Sequence[Pose | Target | Region | Array | TipTargets]:
    """A goal, or a list of goals, as poses, points, configurations and targets by tip."""
    if isinstance(goal, (Pose, Target, Region)):
        return [goal]
    if isinstance(goal, Mapping):
        return [goal]
    try:
        is_numbers = np.ndim(goal) == 1 and np.asarray(goal).dtype.kind in "fiub"
    except ValueError:  # a list of goals of different lengths
        is_numbers = False
    goals = [goal] if is_numbers else list(goal) if isinstance(goal, (Sequence, np.ndarray)) else []
    checked: list[Pose | Target | Region | Array] = []
    for item in goals:
        if isinstance(item, (Pose, Target, Region)):
            checked.append(item)
            continue
        numbers = np.asarray(item, dtype=object).reshape(-1)
        if len(numbers) not in (3, arm.n):
            raise InputError(f"goal: {item!r:.80} is not a configuration of {arm.n} joints, a Pose, a Region or three numbers")
        checked.append(arm.checked("goal", item) if len(numbers) == arm.n else Target.read(item))
    if not checked:
        raise InputError(
            f"goal: {goal!r:.80} is not a configuration of {arm.n} joints, a Pose, a Region, a point or a list of these"
        )
    return checked


def _search_for(
    arm: Arm,
    start: Array,
    goal: Pose | Target | Region | Array | TipTargets,
    rng: np.random.Generator,
    is_free: Callable[[Array], bool],
    keep: KeptRegion | None,
) -> GoalSearch | RegionGoalSearch:
    if keep is not None and keep.part.free is None and isinstance(goal, Target) and goal.pose is None:
        goal = _kept_at(keep, goal.position, arm.fk(start))
    if isinstance(goal, Region):
        return RegionGoalSearch(arm, start, goal, int(rng.integers(2**31)), is_free)
    return GoalSearch(arm, start, goal, rng, is_free, keep)


def _kept_at(keep: KeptRegion, position: Array, tip: Pose) -> Pose | Region:
    """Where a tip at a position (3,) m is in a region: with the orientation it has now, or any that the region has."""
    part = keep.part
    if part.tip.position.any():  # the position goes with the orientation
        return part.nearest(computed_pose(position, tip.rotation))
    bounds = part.bounds.copy()
    bounds[:3] = 0.0
    bounds[3:] += _GOAL_ROOM * (bounds[3:, 1:] - bounds[3:, :1]) * np.array([1.0, -1.0])
    return Region(computed_pose(position, part.frame.rotation), bounds, tip=part.tip)


class RegionGoalSearch:
    """The configurations of a region that have been found, the nearest to the start first.

    Attributes:
        found: (n,) rad each.
        refusal: Why there is none.
    """

    def __init__(self, arm: Arm, start: Array, goal: Region, seed: int, is_free: Callable[[Array], bool]):
        self.found: list[Array] = []
        self.refusal = ""
        self._goal = goal
        self._start = start
        self._search = RegionSearch(arm, goal, start, (POSITION_TOLERANCE, ORIENTATION_TOLERANCE), seed)
        self._is_free = is_free
        self._rounds = 0

    def extend(self, most: int, enough: int) -> None:
        """Looks for more: one round if `most` is few starts, else round after round until so many are free as are enough."""
        last = 1 if most <= _IK_TRIES + 1 else len(STARTS)
        free = sum(map(self._is_free, self.found))
        while free < enough and self._rounds < last:
            solutions = self._search.round(self._rounds)
            self._rounds += 1
            for q in solutions.q[solutions.solved]:
                self.found.append(q)
                free += self._is_free(q)
                if free == MAX_REGION_ROOTS:
                    break
        if not self.found and not self.refusal and self._rounds == len(STARTS):
            self.refusal = solve_ik(self._search.arm, self._goal, self._start).reason


class GoalSearch:
    """The configurations for one goal that have been found.

    Attributes:
        found: (n,) rad each.
        refusal: Why there is none.
    """

    def __init__(
        self,
        arm: Arm,
        start: Array,
        goal: Pose | Target | Array | TipTargets,
        rng: np.random.Generator,
        is_free: Callable[[Array], bool],
        keep: KeptRegion | None = None,
    ):
        self.found: list[Array] = []
        self.refusal = ""
        self._arm = arm
        self._start = start
        self._is_free = is_free
        self._known = np.empty((_MAX_IK_TRIES + 2, arm.n))  # what was found, to compare a solution with all at once
        self._resting: RestingJoints | None = None
        self._free_axis: str | None = None
        self._free = 0
        self._tries = 0
        self._starts: list[Array] = []
        if isinstance(goal, np.ndarray):
            self.found.append(goal)
            return
        if isinstance(goal, Mapping):
            self._resting = resting_joints(arm, goal)
            goal = targets_by_tip(goal, {tip: arm.fk(start, tip) for tip in arm.tips})
        if keep is not None and isinstance(goal, Target) and goal.pose is None:
            goal = computed_pose(goal.position, arm.fk(start).rotation)
            self._free_axis = keep.part.free
        self._goal = goal
        drawn = arm.limits.random(arm.home, _MAX_IK_TRIES, rng)
        closure = arm.joint_map.closure
        self._starts += [start, arm.home, *(drawn if closure is None else closure.inward(arm.home, drawn))]

    def extend(self, most: int, enough: int) -> None:
        """Looks for more, from at most so many starts in all; from fewer if so many are free already."""
        while not self.refusal and self._tries < min(most, len(self._starts)):
            if self._free == MAX_ROOTS or (self._free >= enough and self._tries > _IK_TRIES):
                break
            result = solve_ik(self._arm, self._goal, self._starts[self._tries], free_axis=self._free_axis)
            self._tries += 1
            if result.ok:
                self._add(result.q)
            elif not self.found:
                self.refusal = result.reason  # the solver has tried all its starts

    def _add(self, q: Array) -> None:
        count = len(self.found)
        solution = q if self._resting is None else _with_resting(q, self._start, self._resting, self._is_free)
        if count and np.abs(self._known[:count] - solution).max(axis=1).min() <= SAME_CONFIGURATION:
            return
        self._known[count] = solution
        self.found.append(solution)
        self._free += self._is_free(solution)


def _with_resting(q: Array, start: Array, resting: RestingJoints, is_free: Callable[[Array], bool]) -> Array:
    """A configuration with joints that rest where they start; idle ones only if it is free with them."""
    held = np.where(resting.held, start, q)
    idle = np.where(resting.idle, start, held)
    return idle if is_free(idle) else held


def _why_not_kept(keep: KeptRegion, q: Array) -> str:
    """Why a goal (n,) is not in the region in which the tip stays; empty if it is."""
    if keep.axis is None:
        return keep.why_outside(q)
    excess = keep.excess(q)
    if excess < 0.0:
        return ""
    return (
        f"the tip's {keep.axis} axis tilts by {keep.part.cone + excess:.3g} rad from its direction at the start, "
        f"expected less than {keep.part.cone:.3g}"
    )
