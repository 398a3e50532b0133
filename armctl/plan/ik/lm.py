"""The Levenberg-Marquardt method of the compiled core, called with a Problem."""

from typing import NamedTuple

import numpy as np

from armctl._core import ROTATION_WEIGHT, Constraint
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.plan.ik.problem import IkProblem

# Of 760 000 targets with joints at their bounds, on 38 arms, the slowest was solved after 778 starts, the next after 366.
LM_STARTS = 2000
CONTACT_STARTS = 300  # in which a solution without contact must be found
# The search uses this share of the tolerances, so that rounding does not decide when the answer is measured.
TOLERANCE_SHARE = 0.999
NEARBY_TRIALS = 4
NEARBY_NOISE = 0.2  # rad, or m for a slide joint
POSITION_FIRST_WEIGHT = 3e-3  # reaches per rad: an orientation out of reach then moves the tip by little
REACH_STARTS = 12  # configurations from which the nearest reachable point is looked for
MIN_REACH_GAIN = 1e-6  # relative: a smaller decrease of the squared error is rounding


class SearchResult(NamedTuple):
    """What a search found for N targets."""

    q: Array  # (N, n) rad, inside the joint limits: the solutions, or the best configurations met
    solved: BoolArray  # (N,) whether q is a solution
    next_start: IntArray  # (N,) the start after the last one used
    iterations: IntArray  # (N,) steps over all starts
    jumped: BoolArray  # (N,) whether q is far from q0 although the tip began near the target


class Refined(NamedTuple):
    """Local minima of the squared error."""

    q: Array  # (N, n) rad, inside the joint limits
    squared_error: Array  # (N,) squared reaches


class BestEffort(NamedTuple):
    """The best approximations for targets without a solution."""

    q: Array  # (N, n) rad, inside the joint limits
    position_error: Array  # (N,) m, measured at q
    orientation_error: Array  # (N,) rad, measured at q
    out_of_reach: BoolArray  # (N,) whether the point itself is out of reach


def search(problem: IkProblem, first: int, last: int, begin: Array | None = None) -> SearchResult:
    """Searches from the starts `first` to `last - 1`. Start 0 is `begin` (N, n), by default q0; the others are random."""
    chain = problem.chain
    q0 = np.ascontiguousarray(chain.to_units(problem.q0))
    q = q0.copy() if begin is None else np.array(chain.to_units(begin), order="C")
    outcomes = np.empty((len(q0), 4), np.int64)
    chain.core.search(
        problem.targets,
        problem.constraint,
        problem.position_tolerance * TOLERANCE_SHARE,
        problem.orientation_tolerance * TOLERANCE_SHARE,
        q0,
        first,
        last,
        problem.seed,
        q,
        outcomes,
    )
    solved, jumped, next_start, iterations = np.ascontiguousarray(outcomes.T)
    return SearchResult(chain.from_units(q), solved == 1, next_start, iterations, jumped == 1)


def refine(problem: IkProblem, q: Array, pull: float = 0.0, rotation_weight: float = ROTATION_WEIGHT) -> Refined:
    """Descends from q (N, n) to local minima of the squared error, where every step decreases it.

    `pull` adds the squared distance from q0: it is the weight of a squared radian beside a squared reach from the target.
    `rotation_weight` is the weight of a radian beside a reach, by default that of the search.
    """
    chain = problem.chain
    q = np.array(chain.to_units(q), order="C")
    q0 = np.ascontiguousarray(chain.to_units(problem.q0))
    squared_error = np.empty(len(q))
    chain.core.refine(problem.targets, problem.constraint, rotation_weight, q0, pull, q, squared_error)
    return Refined(chain.from_units(q), squared_error)


def stay_near(problem: IkProblem, found: SearchResult) -> Array:
    """Solutions (N, n) nearer to q0, if the search jumped although the target is close to the tip at q0."""
    q = found.q
    if not found.jumped.any():
        return q
    far = np.flatnonzero(found.jumped & found.solved)
    rng = np.random.default_rng(problem.seed)
    for attempt in range(NEARBY_TRIALS):
        part = problem.select(far)
        noise = rng.uniform(-NEARBY_NOISE, NEARBY_NOISE, part.arm.n) if attempt else 0.0
        begin = refine(part, part.arm.limits.clamp(part.q0 + noise)).q
        trial = search(part, 0, 1, begin)
        nearer = np.abs(trial.q - part.q0).max(axis=1) < np.abs(q[far] - part.q0).max(axis=1)
        better = nearer & trial.solved
        q[far[better]] = trial.q[better]
        far = far[~better]
    return q


def best_effort(problem: IkProblem, q: Array) -> BestEffort:
    """The best approximations from q (N, n), the best configurations that the search met.

    The position comes first: if the tip cannot reach its point at all, it is as near to it as possible; else it is at its
    point, with the least orientation error that a descent finds.
    """
    points = problem._replace(constraint=Constraint.POSITION)
    limit = (problem.position_tolerance / problem.chain.reach) ** 2
    least = np.full(len(q), np.inf)
    nearest = q.copy()
    others = problem.arm.limits.random(problem.arm.home, REACH_STARTS, np.random.default_rng(problem.seed))
    for begin in (q, *others):
        trial = refine(points, np.broadcast_to(begin, q.shape))
        better = trial.squared_error < least * (1 - MIN_REACH_GAIN)
        nearest[better] = trial.q[better]
        least[better] = trial.squared_error[better]
        if (least <= limit).all():
            break
    out_of_reach = least > limit
    q = np.where(out_of_reach[:, None], nearest, _at_point(problem, points, q, nearest))
    return BestEffort(q, *problem.residuals(q), out_of_reach)


def _at_point(problem: IkProblem, points: IkProblem, q: Array, at_point: Array) -> Array:
    """Configurations with the tip at its point and a locally least orientation error, near q (N, n) if a descent gets there.

    `at_point` (N, n) are configurations with the tip at its point, for descents that do not get there from q.
    """
    balanced = refine(problem, q).q
    if problem.constraint == points.constraint:
        return balanced
    best = at_point
    for begin in (at_point, balanced):
        turned = refine(problem, begin, rotation_weight=POSITION_FIRST_WEIGHT).q
        placed = search(points, 0, 1, turned)
        best = np.where(placed.solved[:, None], placed.q, best)
    return best
