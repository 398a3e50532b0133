"""The Levenberg-Marquardt method: the compiled kernels, called with a Problem."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array, BoolArray, IntArray
from armctl.ik.problem import POSITION, Problem, compiled

MARGIN = 0.999  # of the tolerance, so that rounding decides nothing when the answer is measured
NEAR_TRIES, NEAR_NOISE = 4, 0.2
REACH_STARTS = 12


def search(problem: Problem, first: int, last: int, begin: Array | None = None) -> tuple[Array, IntArray]:
    """Solutions, from the starts of the numbers `first` to `last`. Start 0 is `begin`, the others are random.

    Args:
        problem: N targets.
        first: The first start.
        last: The one after the last start.
        begin: (N, n) rad, inside the joint limits; left out, q0.

    Returns:
        (N, n) rad inside the joint limits, the solutions or the best positions met, and (N, 4): 1 for a solution, the start
        after the last one used, steps, 1 for a suspicious jump.
    """
    chain, q0 = problem.chain, problem.chain.units(problem.q0)
    q, tally = (q0 if begin is None else chain.units(begin)).copy(), np.empty((len(q0), 4), np.int64)
    compiled().search(
        chain.rows,
        chain.reach,
        problem.targets,
        problem.asked,
        problem.position_tolerance * MARGIN,
        problem.orientation_tolerance * MARGIN,
        q0,
        first,
        last,
        problem.seed,
        q,
        tally,
    )
    return chain.joints(q), tally


def settle(problem: Problem, q: Array, pull: float = 0.0) -> tuple[Array, Array]:
    """The nearest to each target that a descent finds whose every step comes nearer.

    Args:
        problem: N targets.
        q: (N, n) rad, where to begin.
        pull: How much a squared radian from q0 counts beside a squared reach from the target.

    Returns:
        (N, n) rad inside the joint limits, and (N,) the squared error that is left, in squared reaches.
    """
    chain, sizes = problem.chain, np.empty(len(q))
    q = chain.units(q) + 0.0
    compiled().settle(
        chain.rows,
        chain.reach,
        problem.targets,
        problem.asked,
        chain.units(problem.q0),
        pull,
        q,
        sizes,
    )
    return chain.joints(q), sizes


def stay_near(problem: Problem, q: Array, tally: IntArray) -> Array:
    """Solutions nearer to q0, where the search jumped although the target is close to where the tip is at q0.

    Args:
        problem: N targets.
        q: (N, n) rad, what `search` found.
        tally: (N, 4) what it said.

    Returns:
        (N, n) rad, `q` or what is nearer.
    """
    if not tally[:, 3].any():
        return q
    far, rng = np.flatnonzero(tally[:, 3] & tally[:, 0]), np.random.default_rng(problem.seed)
    for attempt in range(NEAR_TRIES):
        part = problem.rows(far)
        noise = rng.uniform(-NEAR_NOISE, NEAR_NOISE, part.arm.n) if attempt else 0.0
        trial, verdict = search(part, 0, 1, settle(part, part.arm.limits.clamp(part.q0 + noise))[0])
        nearer = np.abs(trial - part.q0).max(axis=1) < np.abs(q[far] - part.q0).max(axis=1)
        better = nearer & (verdict[:, 0] == 1)
        q[far[better]] = trial[better]
        far = far[~better]
    return q


def best_effort(problem: Problem, q: Array) -> tuple[Array, BoolArray]:
    """The best that can be done where there is no solution.

    If the tip cannot come to its point at all, it is as near to it as it can be; else the error of position and orientation is
    least.

    Args:
        problem: N targets.
        q: (N, n) rad, the best positions met.

    Returns:
        (N, n) rad inside the joint limits, and (N,) whether the point itself is out of reach.
    """
    points = problem._replace(asked=POSITION)
    limit = (problem.position_tolerance / problem.chain.reach) ** 2
    least, nearest = np.full(len(q), np.inf), q.copy()
    others = problem.arm.limits.random(problem.arm.home, REACH_STARTS, np.random.default_rng(problem.seed))
    for begin in (q, *others):
        trial, sizes = settle(points, np.broadcast_to(begin, q.shape))
        better = sizes < least * (1 - 1e-6)
        nearest[better], least[better] = trial[better], sizes[better]
        if (least <= limit).all():
            break
    out_of_reach = least > limit
    return np.where(out_of_reach[:, None], nearest, settle(problem, q)[0]), out_of_reach
