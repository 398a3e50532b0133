"""solve_ik: the configuration for one target."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl._core import Constraint
from armctl.core.errors import InputError
from armctl.core.pose import Pose
from armctl.core.region import Region
from armctl.core.target import TargetLike
from armctl.core.tip_targets import TipTargets
from armctl.core.validation import Array, flag, frozen
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import avoided
from armctl.model.collision.world_snapshot import WorldLike
from armctl.plan.ik import lm
from armctl.plan.ik.closed_form_solutions import closed_form_solutions
from armctl.plan.ik.ik_result import IkResult, failure_reason, no_solution_without_contact
from armctl.plan.ik.numerical_solutions import numerical_solutions, swept_joints
from armctl.plan.ik.problem import MIN_TOLERANCE, IkProblem, open_chain, read_seed, read_start, read_target, read_tolerance

NEAREST_STARTS = 64
NEAREST_SAMPLE = 64  # solutions of a closed form
NEAREST_PULLED = 8  # of them, if they are a sample of a self-motion
_POSE = Constraint.POSE  # a global name is read faster than a member of an enumeration
NEAREST_PULL = 1e-3  # squared reaches per squared radian: small, so that solutions remain solutions


class IkCandidate(NamedTuple):
    """A configuration that may be a solution, with the starts and iterations so far."""

    q: Array
    starts: int
    iterations: int


def solve_ik(
    arm: Arm,
    target: TargetLike | Region | TipTargets,
    q0: ArrayLike | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    nearest: bool = False,
    avoid: bool = False,
    seed: int = 0,
    center_of_mass_within: ArrayLike | None = None,
    world: WorldLike | None = None,
) -> IkResult:
    """The configuration that brings the tip to a target, or several tips to theirs, inside the joint limits.

    The same call gives the same answer on any machine, because steps and starts are counted and nothing depends on a clock.

    Args:
        target: A Pose, (3,) m for position only, or a Target, whose own tolerances are not used here. Of several tips a dict
            of such targets by the names of tips; a target can also be `armctl.STAY`, `RelativeTo` or `LookAt`. Tips without a
            target are free. Of targets out of reach, tips that stay or are relative hold, and the sum of the other squared
            errors becomes least. Or a Region: of its poses that are found the one with the nearest configuration is taken.
        q0: (n,) rad (m for a slide joint), where the search starts; the solution is near it if possible. By default the arm's
            home.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.
        nearest: Whether to take the solution nearest to q0 of all that `solve_ik_all` finds; with surplus joints, of a sample.
        avoid: Whether a solution must be free of contact of the arm with itself and with the scene. Everything
            outside the chain is at home.
        center_of_mass_within: (K, 2) m, the corners of a convex polygon on the ground above which the robot's center of mass is
            kept, with targets by tip.
        world: What is around the arm besides its scene, with `avoid`: a World, or a snapshot of one.

    Returns:
        The result. If `ok` is False, it holds the best approximation, and `reason` tells whether the point is out of reach, is
        reachable but not with this orientation, or is reachable only in contact.

    Raises:
        InputError: An argument has a wrong shape, type or value.
        LimitError: q0 is outside the joint limits.
        ModelError: Collisions are to be avoided, and a link of the arm has no collision shape.
    """
    if isinstance(target, Region):
        from armctl.plan.ik.region_solutions import solve_region

        flag("nearest", nearest)  # it is the nearest one in any case
        if center_of_mass_within is not None:
            raise InputError("center_of_mass_within: it is for targets by tip; give a pose of each tip, or leave it out")
        return solve_region(
            arm,
            target,
            q0,
            position_tolerance=position_tolerance,
            orientation_tolerance=orientation_tolerance,
            free_axis=free_axis,
            contact_at=avoided(arm, avoid, world),
            seed=seed,
        )
    # The checks of the usual types are inline: each as a function of its own would take 1 % of the call.
    chain = None
    if center_of_mass_within is None and (type(target) is Pose or not isinstance(target, Mapping)):
        chain = open_chain(arm)
    if chain is None or isinstance(target, Mapping):  # with closed loops, too
        from armctl.plan.ik.solve_tree import solve_tree

        return solve_tree(
            arm,
            target if isinstance(target, Mapping) else {arm.tip: target},
            q0,
            position_tolerance=position_tolerance,
            orientation_tolerance=orientation_tolerance,
            free_axis=free_axis,
            nearest=nearest,
            avoid=avoid,
            seed=seed,
            center_of_mass_within=center_of_mass_within,
            world=world,
        )
    if type(target) is Pose and free_axis is None:
        constraint = _POSE
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
    if nearest is not False or avoid is not False or world is not None:
        starts = read_start(arm, chain, q0)[None]
        problem = IkProblem(
            arm, chain, constraint, rows.reshape(1, 12), starts, position_tolerance, orientation_tolerance, seed
        )
        contact_at = avoided(arm, avoid, world)
        candidates = _candidates(problem, stay_near=q0 is not None)
        if flag("nearest", nearest):
            candidates = itertools.chain(_nearest_candidates(problem), candidates)
        return _first_solution(problem, candidates, contact_at)
    start = chain.home if q0 is None else chain.to_units(read_start(arm, chain, q0))
    q = start.copy()
    answer = chain.core.search_one(
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
    position_error = answer.position_error
    orientation_error = answer.orientation_error
    is_near = q0 is None or not answer.jumped
    if is_near and position_error <= position_tolerance and orientation_error <= orientation_tolerance:
        q.setflags(write=False)
        return IkResult(
            ok=True,
            q=q,
            position_error=position_error,
            orientation_error=orientation_error,
            reason="",
            iterations=answer.steps,
            starts=answer.next_start,
            branch=chain.branch_names[answer.branch],
        )
    starts = read_start(arm, chain, q0)[None]
    problem = IkProblem(arm, chain, constraint, rows.reshape(1, 12), starts, position_tolerance, orientation_tolerance, seed)
    if q0 is not None:
        found = lm.SearchResult(
            q=q[None],
            solved=np.array([answer.solved]),
            next_start=np.array([answer.next_start]),
            iterations=np.array([answer.steps]),
            jumped=np.array([answer.jumped]),
        )
        q = lm.stay_near(problem, found)[0]
    return _first_solution(problem, iter([IkCandidate(q, answer.next_start, answer.steps)]), None)


def _first_solution(
    problem: IkProblem, candidates: Iterator[IkCandidate], contact_at: Callable[[Array], str] | None
) -> IkResult:
    """The first candidate that is a solution, or else the best approximation."""
    in_contact: IkResult | None = None
    candidate = IkCandidate(problem.q0[0], 0, 0)
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
        return replace(in_contact, reason=no_solution_without_contact(candidate.starts, in_contact.reason))
    effort = lm.best_effort(problem, candidate.q[None])
    position_error = float(effort.position_error[0])
    orientation_error = float(effort.orientation_error[0])
    if position_error <= problem.position_tolerance and orientation_error <= problem.orientation_tolerance:
        reason = contact_at(effort.q[0]) if contact_at is not None else ""
    else:
        out_of_reach = bool(effort.out_of_reach[0])
        reason = failure_reason(out_of_reach, position_error, orientation_error, candidate.starts, problem.chain.reach)
    return _result(problem, candidate._replace(q=effort.q[0]), position_error, orientation_error, reason)


def _result(
    problem: IkProblem, candidate: IkCandidate, position_error: float, orientation_error: float, reason: str
) -> IkResult:
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


def _candidates(problem: IkProblem, stay_near: bool) -> Iterator[IkCandidate]:
    """Solutions in the order they are found; the last may be a best approximation."""
    start = 0
    iterations = 0
    while start == 0 or start < lm.CONTACT_STARTS:
        found = lm.search(problem, start, lm.LM_STARTS if start == 0 else lm.CONTACT_STARTS)
        q = lm.stay_near(problem, found) if start == 0 and stay_near else found.q
        start = int(found.next_start[0])
        iterations += int(found.iterations[0])
        yield IkCandidate(q[0], start, iterations)


def _nearest_candidates(problem: IkProblem) -> Iterator[IkCandidate]:
    """All solutions, the nearest first; with surplus joints a sample, pulled towards q0 while they remain solutions."""
    form = problem.chain.closed_form
    if form is not None and problem.constraint == Constraint.POSE:
        target = problem.targets.reshape(4, 3)
        tolerances = (problem.position_tolerance, problem.orientation_tolerance)
        found = closed_form_solutions(problem.chain, form, target, problem.q0[0], *tolerances, NEAREST_SAMPLE)
        nearest = found.q[:0] if form.held is None else found.q[:NEAREST_PULLED]
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
        scattered = lm.search(many, 0, 1, begin)
        pulled = lm.search(many, 0, 1, lm.refine(many, scattered.q, NEAREST_PULL).q)
        solutions = np.concatenate([scattered.q[scattered.solved], pulled.q[pulled.solved]])
        starts = NEAREST_STARTS
        iterations = int(scattered.iterations.sum() + pulled.iterations.sum())
    for k in np.argsort(np.linalg.norm(solutions - problem.q0, axis=1), kind="stable"):
        yield IkCandidate(solutions[k], starts, iterations)
