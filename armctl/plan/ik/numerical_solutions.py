"""Solutions that a search from many starts finds, for arms and targets without a closed form."""

import itertools
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armctl import _core
from armctl._core import LIMIT_ROUNDING, SAME_SOLUTION, Constraint
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.plan.ik import lm
from armctl.plan.ik.closed_form_solutions import MIN_SAMPLES, Solutions
from armctl.plan.ik.problem import IkChain, IkProblem

# Bound on the number of isolated configurations of six hinges in series (Primrose, "On the input-output equation of the general
# 7R mechanism", Mech. Mach. Theory 21, 1986). Chains with fewer, because of special axes, have a closed form.
MAX_SOLUTIONS_6R = 16
MIN_REGULAR_SINGULAR_VALUE = 1e-6  # of the Jacobian in reaches per radian: above it a solution is isolated

STARTS_PER_CALL = 32  # of the core
PATIENCE = 300  # random starts without a new solution, after which the search ends
SWEEP_PATIENCE = 12  # the same for each further sample of a sweep, which begins at the solutions of the sample before
SOLUTIONS_PER_SAMPLE = 4  # fewest to expect: it determines the number of samples of a sweep
CONDITION_SAMPLES = 16  # configurations at which the choice of swept joints is judged


class _Found(NamedTuple):
    """Distinct solutions (N, n) in the solver's units, without regard to the limits, and the effort."""

    q: Array
    starts: int
    steps: int


def numerical_solutions(problem: IkProblem, limit: int) -> Solutions:
    """The solutions of an arm without a closed form, or for a target that leaves turns open."""
    chain = problem.chain
    swept = swept_joints(chain, problem.constraint)
    bound = _max_solutions(chain, problem.constraint)
    first = lm.search(problem, 0, lm.LM_STARTS)
    starts = int(first.next_start[0])
    steps = int(first.iterations[0])
    if swept:
        found = _sweep(problem, swept, first.q[0], limit)
    else:
        found = _find(problem, chain.to_units(first.q[:1]), bound or limit, is_first=True)
    is_complete = 0 < len(found.q) == bound and _all_regular(problem, found.q)
    return _solutions_inside(problem, _Found(found.q, found.starts + starts, found.steps + steps), is_complete)


def completed_solutions(problem: IkProblem, found: Solutions) -> Solutions:
    """The solutions of an arm whose axes are only almost special: near singularities its closed form may miss some."""
    more = _find(problem, found.q, MAX_SOLUTIONS_6R, is_first=False)
    all_found = _Found(more.q, found.starts + more.starts, found.steps + more.steps)
    return _solutions_inside(problem, all_found, len(more.q) == MAX_SOLUTIONS_6R)


def _solutions_inside(problem: IkProblem, found: _Found, is_complete: bool) -> Solutions:
    """Those of the solutions found that are inside the limits, the nearest to q0 first."""
    chain = problem.chain
    q = _inside_limits(problem, found.q)
    position_errors, orientation_errors = problem.select(np.zeros(len(q), np.int64)).residuals(q)
    ok = problem.is_solved(position_errors, orientation_errors)
    distance = np.linalg.norm(chain.to_units(q) - chain.to_units(problem.q0), axis=1)
    order = np.flatnonzero(ok)[np.argsort(distance[ok], kind="stable")]
    return Solutions(
        q=q[order],
        position_errors=position_errors[order],
        orientation_errors=orientation_errors[order],
        branches=chain.branch_numbers(q[order]),
        starts=found.starts,
        steps=found.steps,
        is_complete=is_complete,
    )


@lru_cache(maxsize=64)
def swept_joints(chain: IkChain, constraint: Constraint) -> tuple[int, ...]:
    """The surplus joints to sweep: those without which the other joints move the tip best, on average."""
    rank = {Constraint.POSE: 6, Constraint.POSITION: 3}.get(constraint, 5)
    n = len(chain.unit)
    if n <= rank:
        return ()
    rng = np.random.default_rng(0)
    samples = chain.to_units(chain.limits.random(chain.home * chain.unit, CONDITION_SAMPLES, rng))
    jacobians = np.array([_jacobian(chain, constraint, q) for q in samples])

    def dexterity(swept: tuple[int, ...]) -> float:
        others: IntArray = np.setdiff1d(np.arange(n), swept)
        return float(np.linalg.svd(jacobians[:, :, others], compute_uv=False)[:, rank - 1].mean())

    return max(itertools.combinations(range(n), n - rank), key=dexterity)


def _sweep(problem: IkProblem, swept: tuple[int, ...], begin: Array, limit: int) -> _Found:
    """The solutions at sampled positions of the swept joints."""
    chain = problem.chain
    samples = max(MIN_SAMPLES, -(-limit // SOLUTIONS_PER_SAMPLE))
    joints = list(swept)
    q0 = chain.to_units(problem.q0)[0]
    low = chain.low[joints]
    high = chain.high[joints]
    periodic = (chain.period[joints] > 0) & (high - low > 2 * np.pi)
    unbounded = periodic | ~np.isfinite(high - low)
    low = np.where(unbounded, np.maximum(low, q0[joints] - np.pi), low)
    high = np.where(unbounded, np.minimum(high, low + 2 * np.pi), high)
    positions = low + (high - low) * _low_discrepancy(samples, len(joints))
    first = chain.to_units(begin[None])
    positions[0] = first[0, joints]
    parts = []
    starts = 0
    steps = 0
    known = first
    for k, position in enumerate(positions):
        held = chain.held(np.array(joints), position)
        known = known.copy()
        known[:, joints] = position
        found = _find(problem._replace(chain=held), known, limit, is_first=k == 0)
        known = found.q if len(found.q) else first
        parts.append(found.q)
        starts += found.starts
        steps += found.steps
    return _Found(np.concatenate(parts), starts, steps)


def _low_discrepancy(count: int, dimensions: int) -> Array:
    """(count, dimensions) in [0, 1]: evenly spaced in the first coordinate, additive recurrences in the others.

    The recurrence is R_d of Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
    """
    steps = np.arange(count)
    out = np.empty((count, dimensions))
    out[:, 0] = (steps + 0.5) / count
    if dimensions > 1:
        root = 2.0
        for _ in range(60):  # the positive root of x^dimensions = x + 1
            root = (1 + root) ** (1 / dimensions)
        out[:, 1:] = (0.5 + steps[:, None] * root ** -np.arange(1.0, dimensions)) % 1
    return out


def _find(problem: IkProblem, begin: Array, bound: int, is_first: bool) -> _Found:
    """Distinct solutions, at most `bound`, without regard to the limits of hinges; their whole turns are arbitrary.

    Descents begin at each row of `begin` (B, n); then at random configurations, in turns inside the bounds and within one turn;
    and in a first search at every solution with one joint turned by quarters.
    """
    search = _SolutionSearch(problem, bound)
    period = problem.chain.period
    patience = PATIENCE if is_first else SWEEP_PATIENCE
    q0 = np.ascontiguousarray(problem.chain.to_units(problem.q0)[0])
    search.descend(np.array(begin, order="C"))
    drawn = 0
    fruitless = 0
    turned = 0  # solutions whose joints have been turned
    while len(search.known) < bound and (fruitless < patience or (is_first and turned < len(search.known))):
        if fruitless < patience:
            q = np.empty((min(patience - fruitless, STARTS_PER_CALL), len(q0)))
            problem.chain.core.random_starts(q0, drawn + 1, problem.seed, q)
            drawn += len(q)
            since = search.descend(q)
            fruitless = fruitless + len(q) if since is None else since
        else:
            q = np.tile(search.known[turned], (3 * len(q0), 1))
            q += np.kron(np.diag(period), [[0.25], [0.5], [0.75]])
            q = q[np.repeat(period > 0, 3)]
            turned += 1
            fruitless = fruitless if search.descend(q, to_the_end=True) is None else 0
    return _Found(np.array(search.known).reshape(-1, len(q0)), search.starts, search.steps)


class _SolutionSearch:
    """The solutions that are known, and the descents that find new ones."""

    def __init__(self, problem: IkProblem, bound: int):
        self._problem = problem
        self._bound = bound
        self.known: list[Array] = []
        self.starts = 0
        self.steps = 0

    def descend(self, q: Array, to_the_end: bool = False) -> int | None:
        """Descends from each of q (B, n), in order, until all solutions are known.

        Returns how many found nothing new since the last one that did, None if none did.
        """
        problem = self._problem
        solved = np.empty(len(q), np.int64)
        steps = np.empty(len(q), np.int64)
        tolerances = (problem.position_tolerance * lm.TOLERANCE_SHARE, problem.orientation_tolerance * lm.TOLERANCE_SHARE)
        problem.chain.core.descend(problem.targets[0], problem.constraint, *tolerances, q, solved, steps)
        is_new = (solved == 1) & ~self._is_any(q, np.array(self.known))
        last: int | None = None
        first_here = len(self.known)
        used = len(q)
        for row in np.flatnonzero(is_new).tolist():
            if len(self.known) == self._bound:
                break
            if not self._is_any(q[row : row + 1], np.array(self.known[first_here:]))[0]:
                self.known.append(q[row])
                last = row
        if len(self.known) == self._bound and last is not None and not to_the_end:
            used = last + 1
        self.starts += used
        self.steps += int(steps[:used].sum())
        return None if last is None else used - 1 - last

    def _is_any(self, q: Array, known: Array) -> BoolArray:
        """Which of q (B, n) are one of the known (K, n), up to whole turns of the hinges."""
        if not len(known):
            return np.zeros(len(q), bool)
        period = self._problem.chain.period
        difference = np.abs(q[:, None] - known)
        difference = np.abs(difference - period * np.round(difference / np.where(period > 0, period, np.inf)))
        return np.asarray(np.any(np.all(difference < SAME_SOLUTION, axis=2), axis=1))


def _inside_limits(problem: IkProblem, q: Array) -> Array:
    """Configurations (N, n) in rad: each hinge turned by whole turns to the position nearest to q0 inside the limits.

    Those for which there is none are left out.
    """
    chain = problem.chain
    low = chain.low - LIMIT_ROUNDING
    high = chain.high + LIMIT_ROUNDING
    period = chain.period
    turn = np.where(period > 0, period, np.inf)
    q = q + period * np.round((chain.to_units(problem.q0) - q) / turn)
    q = q - period * np.ceil(np.maximum(0.0, q - high) / turn)
    q = q + period * np.ceil(np.maximum(0.0, low - q) / turn)
    inside = np.all((q >= low) & (q <= high), axis=1)
    return chain.limits.clamp(q[inside] * chain.unit)


def _max_solutions(chain: IkChain, constraint: Constraint) -> int:
    """How many isolated solutions there can be, without regard to the limits; 0 if no bound is known."""
    n = len(chain.arrays["slides"])
    if n != 6 or len(chain.unit) != 6 or chain.has_slides or constraint != Constraint.POSE:
        return 0
    return MAX_SOLUTIONS_6R


def _all_regular(problem: IkProblem, q: Array) -> bool:
    """Whether the Jacobian has full rank at each of the configurations (N, n), in the solver's units."""
    values = np.linalg.svd(np.array([_jacobian(problem.chain, problem.constraint, row) for row in q]), compute_uv=False)
    return bool((values[:, -1] > MIN_REGULAR_SINGULAR_VALUE).all())


def _jacobian(chain: IkChain, constraint: Constraint, q: Array) -> Array:
    """(6, n), or (3, n) for a point, in the solver's units; a free axis is taken out."""
    n = len(q)
    J = np.empty((6, n))
    anywhere = np.append(np.eye(3).ravel(), np.zeros(3))
    _core.IkErrorModel(chain.core).linearize(
        anywhere, constraint, 0.0, np.ascontiguousarray(q), np.empty((n, n)), np.empty(n), J
    )
    return J[:3] if constraint == Constraint.POSITION else J
