"""The configurations of an arm whose tip is in a region, the nearest to a configuration first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.region import Region
from armctl.core.target import RegionMember
from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.model.arm.arm import Arm
from armctl.plan.ik.ik_result import IkResult, failure_reason, no_solution_without_contact
from armctl.plan.ik.lm import TOLERANCE_SHARE
from armctl.plan.ik.problem import IkChain, ik_chain, read_seed, read_starts, read_tolerance
from armctl.plan.ik.reachability import POSITION_TOLERANCE

# Random starts of all parts together, in rounds: the next one is made where those before have found nothing (without contact).
STARTS = (64, 256, 1024)
_MIN_STARTS_PER_PART = 2
_SLIDES = 3  # of the nearest solutions of each part, which slide towards q0
SAME_CONFIGURATION = 1e-3  # rad


class RegionSolutions(NamedTuple):
    """Distinct solutions, the nearest first; without any, the best approximations."""

    q: Array  # (K, n) rad
    part: IntArray  # (K,) the number of the part that each is in
    solved: BoolArray  # (K,)
    starts: int
    steps: int


class RegionSearch:
    """A search for the configurations of a region that are near q0; each round begins at more random configurations."""

    def __init__(self, arm: Arm, region: Region, q0: Array, tolerances: tuple[float, float], seed: int):
        """Of an arm that is an open chain; InputError if it has several tips, ModelError if it has closed loops."""
        self.arm = arm
        self._chain: IkChain = ik_chain(arm)
        self._regions = np.array([part.numbers for part in region.parts])
        self._q0 = q0
        self._tolerances = [TOLERANCE_SHARE * each for each in tolerances]
        self._rng = np.random.default_rng(seed)

    def round(self, number: int) -> RegionSolutions:
        """The solutions of one round, numbered from 0."""
        parts = len(self._regions)
        drawn = self.arm.limits.random(self._q0, max(_MIN_STARTS_PER_PART, STARTS[number] // parts), self._rng)
        first = np.array([self._q0, self.arm.home]) if number == 0 else drawn[:0]
        begin = np.concatenate([first, drawn])
        part = np.repeat(np.arange(parts), len(begin))
        met = np.tile(begin, (parts, 1))
        solved, steps = self._run(self._chain.core.search_regions, part, met)
        distance = np.where(solved, self._distances(met), np.inf)
        nearest = np.argsort(distance.reshape(parts, -1), axis=1, kind="stable")[:, :_SLIDES]
        chosen = (nearest + len(begin) * np.arange(parts)[:, None]).ravel()
        chosen = chosen[solved[chosen]]
        slid = met[chosen]
        slid_solved, more_steps = self._run(self._chain.core.slide_in_regions, part[chosen], slid)
        return self._sorted(
            RegionSolutions(
                q=np.concatenate([slid, met]),
                part=np.concatenate([part[chosen], part]),
                solved=np.concatenate([slid_solved, solved]),
                starts=len(met),
                steps=int(steps.sum() + more_steps.sum()),
            )
        )

    def _run(self, search: Callable[..., Any], part: IntArray, q: Array) -> tuple[BoolArray, IntArray]:
        """Moves configurations (K, n) by a search of the core; whether each is a solution, and the steps."""
        chain = self._chain
        units = np.ascontiguousarray(chain.to_units(q))
        solved = np.empty(len(q), np.int64)
        steps = np.empty(len(q), np.int64)
        near = np.ascontiguousarray(chain.to_units(self._q0))
        search(self._regions, part, *self._tolerances, near, units, solved, steps)
        q[:] = chain.from_units(units)
        return solved == 1, steps

    def _distances(self, q: Array) -> Array:
        return np.linalg.norm(q - self._q0, axis=1)

    def _sorted(self, found: RegionSolutions) -> RegionSolutions:
        """Those that are solutions, or else all, by their distance, without those that are equal to one before."""
        rows = np.flatnonzero(found.solved) if found.solved.any() else np.arange(len(found.q))
        rows = rows[np.argsort(self._distances(found.q[rows]), kind="stable")]
        q = found.q[rows]
        is_new = np.ones(len(q), bool)
        for k in range(1, len(q)):
            same = np.abs(q[:k][is_new[:k]] - q[k]).max(axis=1) <= SAME_CONFIGURATION
            is_new[k] = not same.any()
        rows = rows[is_new]
        return found._replace(q=found.q[rows], part=found.part[rows], solved=found.solved[rows])


def solve_region(
    arm: Arm,
    region: Region,
    q0: ArrayLike | None,
    *,
    position_tolerance: float,
    orientation_tolerance: float,
    free_axis: str | None,
    contact_at: Callable[[Array], str] | None,
    seed: int,
) -> IkResult:
    """The configuration of a region that is nearest to q0, as `solve_ik`.

    `contact_at` says what touches at one, where that counts.
    """
    if free_axis is not None:
        raise InputError("free_axis: a region has its own; armctl.Region(pose, free='z')")
    tolerances = (
        read_tolerance("position_tolerance", position_tolerance),
        read_tolerance("orientation_tolerance", orientation_tolerance),
    )
    start = read_starts(arm, q0, 1)[0]
    search = RegionSearch(arm, region, start, tolerances, read_seed(seed))
    starts = 0
    steps = 0
    in_contact: IkResult | None = None
    found: RegionSolutions | None = None
    for number in range(len(STARTS)):
        found = search.round(number)
        starts += found.starts
        steps += found.steps
        for q, part in zip(found.q[found.solved], found.part[found.solved], strict=True):
            contact = "" if contact_at is None else contact_at(q)
            result = _result(arm, region, q, int(part), contact, starts, steps)
            if not contact:
                return result
            in_contact = in_contact or result
    assert found is not None
    if in_contact is not None:
        reason = no_solution_without_contact(starts, in_contact.reason)
        return _result(arm, region, in_contact.q, in_contact.member.index if in_contact.member else 0, reason, starts, steps)
    return _best_effort(arm, region, found, starts, steps)


def _best_effort(arm: Arm, region: Region, found: RegionSolutions, starts: int, steps: int) -> IkResult:
    """The configuration nearest to the region, of a region that cannot be reached."""
    chain = ik_chain(arm)
    best: tuple[float, int] = (np.inf, 0)
    for k, (q, part) in enumerate(zip(found.q, found.part, strict=True)):
        tip = arm.fk(q)
        position_error, orientation_error = region.parts[part].nearest(tip).distance(tip)
        best = min(best, (position_error / chain.reach + orientation_error, k))
    q = found.q[best[1]]
    part = int(found.part[best[1]])
    tip = arm.fk(q)
    position_error, orientation_error = region.parts[part].nearest(tip).distance(tip)
    reason = failure_reason(position_error > POSITION_TOLERANCE, position_error, orientation_error, starts, chain.reach)
    return _result(arm, region, q, part, f"no pose of the region was found: {reason}", starts, steps)


def _result(arm: Arm, region: Region, q: Array, part: int, reason: str, starts: int, steps: int) -> IkResult:
    tip = arm.fk(q)
    member = region.parts[part].nearest(tip)
    position_error, orientation_error = member.distance(tip)
    return IkResult(
        ok=not reason,
        q=frozen(q.copy()),
        position_error=position_error,
        orientation_error=orientation_error,
        reason=reason,
        iterations=steps,
        starts=starts,
        branch=ik_chain(arm).branches(q[None])[0],
        member=RegionMember(index=part, pose=member, name=region.parts[part].name),
    )
