"""solve_ik: the configuration for one target."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.collision.checkers import collision_checker
from armctl.core.errors import UnknownNameError
from armctl.core.pose import Pose
from armctl.core.target import TargetLike
from armctl.core.validation import Array, flag, frozen
from armctl.ik import lm
from armctl.ik.closed_form_solutions import closed_form_solutions
from armctl.ik.numerical_solutions import numerical_solutions, swept_joints
from armctl.ik.problem import (
    MIN_TOLERANCE,
    Problem,
    packed_chain,
    read_seed,
    read_starts,
    read_target,
    read_tolerance,
)
from armctl.ik.result import IkResult, failure_reason
from armctl.robot.arm import Arm

CONTACT_STARTS = 300  # in which a solution without contact must be found
MINK_STARTS = 60
NEAREST_STARTS = 64
NEAREST_SAMPLE = 64  # solutions of a closed form
NEAREST_PULLED = 8  # of them, if they are a sample of a self-motion
NEAREST_PULL = 1e-3  # squared reaches per squared radian: small, so that solutions remain solutions

Search = Callable[[Problem, int, int, Array | None], lm.SearchResult]


class Candidate(NamedTuple):
    """A configuration that may be a solution, with the starts and iterations so far."""

    q: Array
    starts: int
    iterations: int


def solve_ik(
    arm: Arm,
    target: TargetLike,
    q0: ArrayLike | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    nearest: bool = False,
    avoid_collisions: bool = False,
    method: str = "lm",
    seed: int = 0,
) -> IkResult:
    """The configuration that brings the tip to a target, inside the joint limits.

    The same call gives the same answer on any machine, because steps and starts are counted and nothing depends on a clock.

    Args:
        arm: The arm.
        target: A Pose, (3,) m for position only, or a Target, whose own tolerances are not used here.
        q0: (n,) rad (m for a slide joint), where the search starts; the solution is near it if possible. By default the arm's
            home.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.
        nearest: Whether to take the solution nearest to q0 of all that `solve_ik_all` finds; with surplus joints, of a sample.
        avoid_collisions: Whether a solution must be free of contact of the arm with itself and with the scene. Everything
            outside the chain is at home.
        method: "lm", the compiled Levenberg-Marquardt solver, or "mink", `DifferentialIk` stepped until it converges.
        seed: The seed of the random starts.

    Returns:
        The result. If `ok` is False, it holds the best approximation, and `reason` tells whether the point is out of reach, is
        reachable but not with this orientation, or is reachable only in contact.

    Raises:
        InputError: An argument has a wrong shape, type or value.
        LimitError: q0 is outside the joint limits.
        UnknownNameError: There is no such method.
    """
    # The checks of the usual types are inline: each as a function of its own would take 1 % of the call.
    chain = packed_chain(arm)
    if type(target) is Pose and free_axis is None:
        constraint = chain.kernel.POSE
        rows = target.rows
    else:
        constraint, numbers = read_target(target, free_axis)
        rows = numbers.reshape(4, 3)
    if type(position_tolerance) is not float or not MIN_TOLERANCE <= position_tolerance < math.inf:
        position_tolerance = read_tolerance("position_tolerance", position_tolerance)
    if type(orientation_tolerance) is not float or not MIN_TOLERANCE <= orientation_tolerance < math.inf:
        orientation_tolerance = read_tolerance("orientation_tolerance", orientation_tolerance)
    if type(seed) is not int or not 0 <= seed < 2**63:
        seed = read_seed(seed)
    if nearest is not False or avoid_collisions is not False or type(method) is not str or method != "lm":
        starts = read_starts(arm, q0, 1)
        problem = Problem(arm, chain, constraint, rows.reshape(1, 12), starts, position_tolerance, orientation_tolerance, seed)
        return _solve_with(problem, method, nearest, avoid_collisions, stay_near=q0 is not None)
    start = chain.home if q0 is None else frozen(chain.to_units(read_starts(arm, q0, 1)[0]))
    q = start.copy()
    solved, jumped, next_start, iterations, position_error, orientation_error, branch = chain.kernel.search_one(
        chain.rows,
        chain.reach,
        rows,
        constraint,
        position_tolerance * lm.TOLERANCE_SHARE,
        orientation_tolerance * lm.TOLERANCE_SHARE,
        start,
        lm.LM_STARTS,
        seed,
        q,
    )
    if chain.has_slides:
        q = chain.from_units(q)
    if position_error <= position_tolerance and orientation_error <= orientation_tolerance and (q0 is None or not jumped):
        q.setflags(write=False)
        name = chain.branch_names[branch]
        return IkResult(True, q, position_error, orientation_error, "", iterations, next_start, name)  # by names: 0.2 us longer
    starts = read_starts(arm, q0, 1)
    problem = Problem(arm, chain, constraint, rows.reshape(1, 12), starts, position_tolerance, orientation_tolerance, seed)
    if q0 is not None:
        report = np.array([[solved], [next_start], [iterations], [jumped]], np.int64)
        q = lm.stay_near(problem, lm.SearchResult(q[None], report))[0]
    return _first_solution(problem, iter([Candidate(q, next_start, iterations)]), None)


def _solve_with(problem: Problem, method: str, nearest: bool, avoid_collisions: bool, stay_near: bool) -> IkResult:
    """The solution that meets further conditions, or that another method finds."""
    search, max_starts = _method(method)
    contact_at = collision_checker(problem.arm).at if flag("avoid_collisions", avoid_collisions) else None
    candidates = _candidates(problem, search, max_starts, stay_near)
    if flag("nearest", nearest):
        candidates = itertools.chain(_nearest_candidates(problem, search), candidates)
    return _first_solution(problem, candidates, contact_at)


def _first_solution(problem: Problem, candidates: Iterator[Candidate], contact_at: Callable[[Array], str] | None) -> IkResult:
    """The first candidate that is a solution, or else the best approximation."""
    in_contact: IkResult | None = None
    candidate = Candidate(problem.q0[0], 0, 0)
    for candidate in candidates:
        position_error, orientation_error = problem.residual(candidate.q)
        if position_error > problem.position_tolerance or orientation_error > problem.orientation_tolerance:
            break
        contact = contact_at(candidate.q) if contact_at is not None else ""
        result = _result(problem, candidate, position_error, orientation_error, contact)
        if not contact:
            return result
        in_contact = result
    if in_contact is not None:
        in_contact.reason = f"no solution without contact found in {candidate.starts} starts: {in_contact.reason}"
        return in_contact
    effort = lm.best_effort(problem, candidate.q[None])
    position_error = float(effort.position_error[0])
    orientation_error = float(effort.orientation_error[0])
    if position_error <= problem.position_tolerance and orientation_error <= problem.orientation_tolerance:
        reason = contact_at(effort.q[0]) if contact_at is not None else ""
    else:
        reason = failure_reason(bool(effort.out_of_reach[0]), position_error, orientation_error, candidate.starts)
    return _result(problem, candidate._replace(q=effort.q[0]), position_error, orientation_error, reason)


def _result(problem: Problem, candidate: Candidate, position_error: float, orientation_error: float, reason: str) -> IkResult:
    """The result of a candidate; without a reason against it, it is a solution."""
    return IkResult(
        ok=not reason,
        q=frozen(candidate.q),
        position_error=position_error,
        orientation_error=orientation_error,
        reason=reason,
        iterations=candidate.iterations,
        starts=candidate.starts,
        branch=problem.chain.branches(candidate.q[None])[0],
    )


def _method(name: str) -> tuple[Search, int]:
    """The search of a method, and from how many starts."""
    if isinstance(name, str) and name == "lm":
        return lm.search, lm.LM_STARTS
    if isinstance(name, str) and name == "mink":
        from armctl.ik import mink_solver

        return mink_solver.search, MINK_STARTS
    raise UnknownNameError.of("method", f"{name!s:.80}", ["lm", "mink"])


def _candidates(problem: Problem, search: Search, max_starts: int, stay_near: bool) -> Iterator[Candidate]:
    """Solutions in the order they are found; the last may be a best approximation."""
    start = 0
    iterations = 0
    while start == 0 or start < min(max_starts, CONTACT_STARTS):
        found = search(problem, start, max_starts if start == 0 else min(max_starts, CONTACT_STARTS), None)
        q = lm.stay_near(problem, found) if start == 0 and stay_near else found.q
        start = int(found.next_start[0])
        iterations += int(found.iterations[0])
        yield Candidate(q[0], start, iterations)


def _nearest_candidates(problem: Problem, search: Search) -> Iterator[Candidate]:
    """All solutions, the nearest first; with surplus joints a sample, pulled towards q0 while they remain solutions."""
    form = problem.chain.closed_form
    if form is not None and problem.constraint == problem.chain.kernel.POSE:
        target = problem.targets.reshape(4, 3)
        tolerances = (problem.position_tolerance, problem.orientation_tolerance)
        found = closed_form_solutions(problem.chain, form, target, problem.q0[0], *tolerances, NEAREST_SAMPLE)
        nearest = found.q[:NEAREST_PULLED] if form.held >= 0 else found.q[:0]
        many = problem.select(np.zeros(len(nearest), np.int64))
        pulled = lm.search(many, 0, 1, lm.refine(many, nearest, NEAREST_PULL).q)
        solutions = np.concatenate([pulled.q[pulled.solved], found.q])
        starts = found.starts
        iterations = found.steps + int(pulled.iterations.sum())
    elif not swept_joints(problem.chain, problem.constraint):
        found = numerical_solutions(problem, NEAREST_SAMPLE)
        solutions = found.q
        starts = found.starts
        iterations = found.steps
    else:
        many = problem.select(np.zeros(NEAREST_STARTS, np.int64))
        begin = problem.arm.limits.random(problem.q0[0], NEAREST_STARTS, np.random.default_rng(problem.seed))
        begin[0] = problem.q0[0]
        scattered = search(many, 0, 1, begin)
        pulled = lm.search(many, 0, 1, lm.refine(many, scattered.q, NEAREST_PULL).q)
        solutions = np.concatenate([scattered.q[scattered.solved], pulled.q[pulled.solved]])
        starts = NEAREST_STARTS
        iterations = int(scattered.iterations.sum() + pulled.iterations.sum())
    for k in np.argsort(np.linalg.norm(solutions - problem.q0, axis=1), kind="stable"):
        yield Candidate(solutions[k], starts, iterations)
