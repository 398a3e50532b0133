"""Targets by tip: one configuration in which all tips are at their targets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.tip_targets import TipTargets, read_polygon
from armctl.core.validation import Array, flag, frozen
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import avoided
from armctl.model.collision.world_snapshot import WorldLike
from armctl.plan.ik.ik_result import FAR_M, IkResult, no_solution_without_contact
from armctl.plan.ik.lm import CONTACT_STARTS, LM_STARTS
from armctl.plan.ik.problem import read_seed, read_starts, read_tolerance
from armctl.plan.ik.tree_problem import TreeTasks, read_tasks, shortfall

NEAREST_STARTS = 24  # of them for the solution that is nearest to the start
TOLERANCE_SHARE = 0.5  # of the tolerances, which rounding must not reach


class _Candidate(NamedTuple):
    q: Array
    solved: bool
    starts: int
    steps: int


def solve_tree(
    arm: Arm,
    targets: TipTargets,
    q0: ArrayLike | None,
    *,
    position_tolerance: float,
    orientation_tolerance: float,
    free_axis: str | None,
    nearest: bool,
    avoid: bool,
    seed: int,
    center_of_mass_within: ArrayLike | None,
    world: WorldLike | None,
) -> IkResult:
    """The configuration for targets by tip; arguments and errors as for `solve_ik`."""
    tasks = read_tasks(arm, targets, free_axis)
    tolerances = (
        read_tolerance("position_tolerance", position_tolerance),
        read_tolerance("orientation_tolerance", orientation_tolerance),
    )
    tree = TreeTasks(arm, tasks, read_polygon("center_of_mass_within", center_of_mass_within))
    start = read_starts(arm, q0, 1)[0]
    goals = tree.targets(start)
    refusal_at = _refusal(arm, avoided(arm, avoid, world))
    enough = NEAREST_STARTS if flag("nearest", nearest) else 0
    best: IkResult | None = None
    rank = (False, False, -np.inf)
    starts = 0
    for found in _candidates(tree, goals, start, tolerances, read_seed(seed)):
        contact = refusal_at(found.q) if found.solved else ""
        result = _result(tree, goals, found, tolerances, contact)
        own_rank = (result.ok, found.solved, -float(np.linalg.norm(found.q - start)))
        if best is None or own_rank > rank:
            best = result
            rank = own_rank
        if best.ok and found.starts >= enough:
            return best
        starts = found.starts
    assert best is not None  # the first candidate is one
    is_blocked = not best.ok and rank[1]
    if not is_blocked:
        return best
    if closed_reason(arm, best.q):
        return replace(best, reason=f"no solution with closed loops found in {starts} starts: {best.reason}")
    return replace(best, reason=no_solution_without_contact(starts, best.reason))


def closed_reason(arm: Arm, q: Array) -> str:
    """Why closed loops of an arm do not close at q (n,), or which passive joint leaves its limits there; empty if they do."""
    closure = arm.joint_map.closure
    return "" if closure is None else closure.first_refusal(q[None])[1]


def _refusal(arm: Arm, contact_at: Callable[[Array], str] | None) -> Callable[[Array], str]:
    """What refuses a configuration (n,) at which all tips are: closed loops that do not close there, or a contact."""

    def refusal_at(q: Array) -> str:
        return closed_reason(arm, q) or (contact_at(q) if contact_at is not None else "")

    return refusal_at


def _candidates(
    tree: TreeTasks, goals: Array, start: Array, tolerances: tuple[float, float], seed: int
) -> Iterator[_Candidate]:
    """Solutions in the order they are found; the last may be a best approximation."""
    first = 0
    steps = 0
    while first < CONTACT_STARTS:
        q = start.copy()
        inner = (TOLERANCE_SHARE * tolerances[0], TOLERANCE_SHARE * tolerances[1])
        outcome = tree.core.search(goals, *inner, first, LM_STARTS, seed, q)
        first += outcome.starts
        steps += outcome.steps
        yield _Candidate(q, outcome.solved, first, steps)
        if not outcome.solved:
            return


def _result(tree: TreeTasks, goals: Array, found: _Candidate, tolerances: tuple[float, float], contact: str) -> IkResult:
    """The result of a candidate, measured; without a reason against it, it is a solution."""
    errors, outside = tree.errors(goals, found.q)
    missed = shortfall(tree.tasks, errors, outside, tolerances)
    units = "; positions are in metres" if errors[:, 0].max() > FAR_M else ""
    reason = f"{missed} in the best of {found.starts} starts{units}" if missed else contact
    return IkResult(
        ok=not reason,
        q=frozen(found.q),
        position_error=float(errors[:, 0].max()),
        orientation_error=float(errors[:, 1].max()),
        reason=reason,
        iterations=found.steps,
        starts=found.starts,
        tip_errors={task.tip: (position, angle) for task, (position, angle) in zip(tree.tasks, errors.tolist(), strict=True)},
    )
