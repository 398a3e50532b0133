"""solve_ik_all: all configurations for one target."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl._core import Constraint
from armctl.core.pose import Pose
from armctl.core.target import TargetLike
from armctl.core.validation import frozen, integer
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import avoided
from armctl.model.collision.world_snapshot import WorldLike
from armctl.plan.ik.closed_form_solutions import Solutions, closed_form_solutions
from armctl.plan.ik.ik_result import IkBatch, batch_of
from armctl.plan.ik.numerical_solutions import completed_solutions, numerical_solutions
from armctl.plan.ik.problem import MIN_TOLERANCE, IkProblem, ik_chain, read_seed, read_start, read_target, read_tolerance
from armctl.plan.ik.solve import solve_ik

_POSE = Constraint.POSE  # a global name is read faster than a member of an enumeration


def solve_ik_all(
    arm: Arm,
    target: TargetLike,
    limit: int = 256,
    q0: ArrayLike | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    avoid: bool = False,
    seed: int = 0,
    world: WorldLike | None = None,
) -> IkBatch:
    """All configurations that bring the tip to a target, inside the joint limits, the nearest to q0 first.

    An arm of six hinges has a closed form for poses if three consecutive axes meet in a point or are parallel, and so do two
    neighbours of the others. It gives all solutions, and `is_complete` is True unless one of them is within rounding of a
    singularity, where their number is not certain. If the axes are special only up to 5e-4 rad or reaches, a numerical search
    begins at its solutions.

    An arm of seven hinges is swept: one joint is held at sampled positions, each of which gives all configurations of the other
    six, in closed form if their axes permit. The result is a sample of the self-motion, evenly spread over the joint's range.

    In all other cases the search is numerical: it descends from many starts and keeps the distinct solutions. It ends when 300
    random starts in a row found nothing new. `is_complete` is True if an arm of six hinges has as many isolated solutions as
    such a chain can have at most (16). If the arm has more joints than the target has constraints, the
    surplus joints are swept. Otherwise a solution may be missing, although the tests have not found such a case.

    Configurations that differ by whole turns are one solution; of these the nearest to q0 inside the limits is returned.

    Args:
        target: A Pose, (3,) m for position only, or a Target, whose own tolerances are not used here.
        limit: The largest number of solutions to return.
        q0: (n,) rad (m for a slide joint), from which distances are measured. By default the arm's home.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.
        avoid: Whether solutions must be free of contact of the arm with itself and with the scene.
        world: What is around the arm besides its scene, with `avoid`: a World, or a snapshot of one.

    Returns:
        The solutions, sorted by their distance from q0. If there is none, the result has one row, which is the best
        approximation, with `ok` False and a reason. `starts` and `iterations` count those of the whole call.

    Raises:
        InputError: An argument has a wrong shape, type or value.
        LimitError: q0 is outside the joint limits.
    """
    # The checks of the usual types are inline, as in solve_ik.
    chain = ik_chain(arm)
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
    start = read_start(arm, chain, q0)
    if type(seed) is not int or not 0 <= seed < 2**63:
        seed = read_seed(seed)
    if type(limit) is not int or limit < 1:
        limit = integer("limit", limit, 1)
    contact_at = None if avoid is False and world is None else avoided(arm, avoid, world)
    form = chain.closed_form
    if form is not None and form.is_exact and constraint == _POSE:
        found = closed_form_solutions(chain, form, rows, start, position_tolerance, orientation_tolerance, limit)
    else:
        goal = rows.reshape(1, 12)
        problem = IkProblem(arm, chain, constraint, goal, start[None], position_tolerance, orientation_tolerance, seed)
        found = _inexact_solutions(problem, limit)
    is_complete = found.is_complete and len(found.q) <= limit
    if contact_at is not None:
        found = found.select(np.array([k for k, q in enumerate(found.q) if not contact_at(q)], np.int64))
    count = len(found.q)
    if count == 0:
        return batch_of(
            [
                solve_ik(
                    arm,
                    target,
                    start,
                    position_tolerance=position_tolerance,
                    orientation_tolerance=orientation_tolerance,
                    free_axis=free_axis,
                    avoid=avoid,
                    seed=seed,
                    world=world,
                )
            ],
            arm.n,
        )
    if count > limit:
        count = limit
        found = found.select(np.arange(count))
    return IkBatch(
        ok=_column(True, count),
        q=frozen(found.q),
        position_error=frozen(found.position_errors),
        orientation_error=frozen(found.orientation_errors),
        reason=_column("", count),
        iterations=_column(found.steps, count),
        starts=_column(found.starts, count),
        branch=tuple([chain.branch_names[number] for number in found.branches.tolist()]),
        is_complete=is_complete,
    )


@lru_cache(maxsize=1024, typed=True)
def _column(value: bool | int | str, count: int) -> Any:
    """(count,) of one value, read-only: calls with the same numbers share it."""
    return frozen(np.full(count, value, object if isinstance(value, str) else None))


def _inexact_solutions(problem: IkProblem, limit: int) -> Solutions:
    """The solutions of a problem that has no closed form, or only almost."""
    chain = problem.chain
    form = chain.closed_form
    if form is None or problem.constraint != _POSE:
        return numerical_solutions(problem, limit)
    tolerances = (problem.position_tolerance, problem.orientation_tolerance)
    found = closed_form_solutions(chain, form, problem.targets.reshape(4, 3), problem.q0[0], *tolerances, limit)
    return completed_solutions(problem, found) if form.held is None else found
