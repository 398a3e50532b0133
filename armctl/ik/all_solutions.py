"""solve_ik_all: all configurations for one target."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.collision.checkers import collision_checker
from armctl.core.pose import Pose
from armctl.core.target import TargetLike
from armctl.core.validation import Array, BoolArray, IntArray, TextArray, flag, frozen, integer
from armctl.ik import lm
from armctl.ik.closed_form_solutions import MIN_SAMPLES, Solutions, closed_form_solutions, polished
from armctl.ik.lm import TOLERANCE_SHARE
from armctl.ik.problem import (
    MIN_TOLERANCE,
    PackedChain,
    Problem,
    compiled,
    packed_chain,
    read_seed,
    read_starts,
    read_target,
    read_tolerance,
)
from armctl.ik.result import IkBatch, IkResult, batch_of_solutions
from armctl.ik.solve import LM_STARTS, solve_ik
from armctl.robot.arm import Arm

# Bounds on the number of isolated configurations of six hinges in series: 16 in general (Primrose, "On the input-output
# equation of the general 7R mechanism", Mech. Mach. Theory 21, 1986), 8 if three consecutive axes are parallel or meet in a
# point (Mavroidis and Roth, "Structural parameters which reduce the number of manipulator configurations", ASME J. Mech. Design
# 116, 1994).
MAX_SOLUTIONS_6R = 16
MAX_SOLUTIONS_SPECIAL_6R = 8
SPECIAL_AXES_TOLERANCE = 1e-9  # reaches, or sine of an angle
MIN_REGULAR_SINGULAR_VALUE = 1e-6  # of the Jacobian in reaches per radian: above it a solution is isolated

PATIENCE = 300  # random starts without a new solution, after which the search ends
SWEEP_PATIENCE = 12  # the same for each further sample of a sweep, which begins at the solutions of the sample before
SOLUTIONS_PER_SAMPLE = 4  # fewest to expect: it determines the number of samples of a sweep
CONDITION_SAMPLES = 16  # configurations at which the choice of swept joints is judged


class _Found(NamedTuple):
    """Distinct solutions (N, n) in the solver's units, without regard to the limits, and the effort."""

    q: Array
    starts: int
    steps: int


def solve_ik_all(
    arm: Arm,
    target: TargetLike,
    limit: int = 256,
    q0: ArrayLike | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    avoid_collisions: bool = False,
    seed: int = 0,
) -> IkBatch:
    """All configurations that bring the tip to a target, inside the joint limits, the nearest to q0 first.

    An arm of six hinges has a closed form for poses if three consecutive axes meet in a point or are parallel. It gives all
    solutions, and `is_complete` is True unless one of them is within rounding of a singularity, where their number is not
    certain. If the axes are special only up to 5e-4 rad or reaches, a numerical search begins at its solutions.

    An arm of seven hinges is swept: one joint is held at sampled positions, each of which gives all configurations of the other
    six, in closed form if their axes permit. The result is a sample of the self-motion, evenly spread over the joint's range.

    In all other cases the search is numerical: it descends from many starts and keeps the distinct solutions. It ends when 300
    random starts in a row found nothing new. `is_complete` is True if an arm of six hinges has as many isolated solutions as
    such a chain can have at most (16, or 8 with special axes). If the arm has more joints than the target has constraints, the
    surplus joints are swept. Otherwise a solution may be missing, although the tests have not found such a case.

    Configurations that differ by whole turns are one solution; of these the nearest to q0 inside the limits is returned.

    Args:
        arm: The arm.
        target: A Pose, (3,) m for position only, or a Target, whose own tolerances are not used here.
        limit: The largest number of solutions to return.
        q0: (n,) rad (m for a slide joint), from which distances are measured. By default the arm's home.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.
        avoid_collisions: Whether solutions must be free of contact of the arm with itself and with the scene.
        seed: The seed of the random starts.

    Returns:
        The solutions, sorted by their distance from q0. If there is none, the result has one row, which is the best
        approximation, with `ok` False and a reason. `starts` and `iterations` count those of the whole call.

    Raises:
        InputError: An argument has a wrong shape, type or value.
        LimitError: q0 is outside the joint limits.
    """
    # The checks of the usual types are inline, as in solve_ik.
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
    starts = read_starts(arm, q0, 1)
    if type(seed) is not int or not 0 <= seed < 2**63:
        seed = read_seed(seed)
    if type(limit) is not int or limit < 1:
        limit = integer("limit", limit, 1)
    if avoid_collisions is not False:
        avoid_collisions = flag("avoid_collisions", avoid_collisions)
    form = chain.closed_form
    if form is not None and form.is_exact and constraint == chain.kernel.POSE:
        found = closed_form_solutions(chain, form, rows, starts[0], position_tolerance, orientation_tolerance, limit)
    else:
        problem = Problem(arm, chain, constraint, rows.reshape(1, 12), starts, position_tolerance, orientation_tolerance, seed)
        found = _inexact_solutions(problem, limit)
    is_complete = found.is_complete and len(found.q) <= limit
    if avoid_collisions:
        contact_at = collision_checker(arm).at
        found = found.select(np.array([k for k, q in enumerate(found.q) if not contact_at(q)], np.int64))
    count = len(found.q)
    if count == 0:
        return _one_row(
            solve_ik(
                arm,
                target,
                starts[0],
                position_tolerance=position_tolerance,
                orientation_tolerance=orientation_tolerance,
                free_axis=free_axis,
                avoid_collisions=avoid_collisions,
                seed=seed,
            )
        )
    if count > limit:
        count = limit
        found = found.select(np.arange(count))
    found.q.setflags(write=False)
    return batch_of_solutions(found.q, is_complete, partial(_columns, found, chain.branch_names))


def _columns(found: Solutions, branch_names: tuple[str | None, ...]) -> dict[str, Any]:
    """The fields of an IkBatch for solutions of one target."""
    ok, reason, iterations, starts = _equal_rows(len(found.q), found.steps, found.starts)
    found.details.setflags(write=False)
    position_error, orientation_error, branch = found.details
    return {
        "ok": ok,
        "position_error": position_error,
        "orientation_error": orientation_error,
        "reason": reason,
        "iterations": iterations,
        "starts": starts,
        "branch": tuple([branch_names[int(number)] for number in branch.tolist()]),
    }


@lru_cache(maxsize=1024)
def _equal_rows(count: int, steps: int, starts: int) -> tuple[BoolArray, TextArray, IntArray, IntArray]:
    """The fields that are the same for each of `count` solutions: read-only, and shared, because making them takes longer."""
    return (
        frozen(np.full(count, True)),
        frozen(np.full(count, "", object)),
        frozen(np.full(count, steps)),
        frozen(np.full(count, starts)),
    )


def _inexact_solutions(problem: Problem, limit: int) -> Solutions:
    """The solutions of a problem that has no closed form, or only almost."""
    chain = problem.chain
    form = chain.closed_form
    if form is None or problem.constraint != chain.kernel.POSE:
        return _numerical_solutions(problem, limit)
    tolerances = (problem.position_tolerance, problem.orientation_tolerance)
    found = closed_form_solutions(chain, form, problem.targets.reshape(4, 3), problem.q0[0], *tolerances, limit)
    return found if form.held >= 0 else _completed(problem, found)


def _completed(problem: Problem, found: Solutions) -> Solutions:
    """The solutions of an arm whose axes are only almost special: near singularities its closed form may miss some."""
    chain = problem.chain
    more = _find(problem, chain.rows, found.q, MAX_SOLUTIONS_6R, is_first=False)
    complete = polished(problem, more.q, found.starts + more.starts, len(more.q) == MAX_SOLUTIONS_6R)
    return complete._replace(steps=found.steps + more.steps + complete.steps)


def _numerical_solutions(problem: Problem, limit: int) -> Solutions:
    """The solutions of an arm without a closed form, or for a target that leaves turns open."""
    chain = problem.chain
    swept = _swept_joints(chain, problem.constraint)
    bound = _max_solutions(chain, problem.constraint)
    first = lm.search(problem, 0, LM_STARTS)
    starts = int(first.next_start[0])
    steps = int(first.iterations[0])
    found = _sweep(problem, swept, first.q[0], limit) if swept else _isolated(problem, bound, first.q[0], limit)
    q = _inside_limits(problem, found.q)
    position_error, orientation_error = problem.select(np.zeros(len(q), np.int64)).residuals(q)
    ok = (position_error <= problem.position_tolerance) & (orientation_error <= problem.orientation_tolerance)
    distance = np.linalg.norm(chain.to_units(q) - chain.to_units(problem.q0), axis=1)
    order = np.flatnonzero(ok)[np.argsort(distance[ok], kind="stable")]
    q = q[order]
    details = np.array([position_error[order], orientation_error[order], chain.branch_numbers(q).astype(float)])
    is_complete = 0 < len(found.q) == bound and _all_regular(problem, found.q)
    return Solutions(q, details, found.starts + starts, found.steps + steps, is_complete)


def _one_row(result: IkResult) -> IkBatch:
    return IkBatch(
        ok=frozen(np.array([result.ok])),
        q=frozen(result.q[None].copy()),
        position_error=frozen(np.array([result.position_error])),
        orientation_error=frozen(np.array([result.orientation_error])),
        reason=frozen(np.array([result.reason], object)),
        iterations=frozen(np.array([result.iterations])),
        starts=frozen(np.array([result.starts])),
        branch=(result.branch,),
    )


def _isolated(problem: Problem, bound: int, begin: Array, limit: int) -> _Found:
    """The solutions of an arm without surplus joints."""
    chain = problem.chain
    return _find(problem, chain.rows, chain.to_units(begin[None]), bound or limit, is_first=True)


def _sweep(problem: Problem, swept: tuple[int, ...], begin: Array, limit: int) -> _Found:
    """The solutions at sampled positions of the swept joints."""
    kernel = compiled()
    chain = problem.chain
    samples = max(MIN_SAMPLES, -(-limit // SOLUTIONS_PER_SAMPLE))
    joints = list(swept)
    q0 = chain.to_units(problem.q0)[0]
    low = chain.rows[joints, kernel.LOW]
    high = chain.rows[joints, kernel.HIGH]
    periodic = (chain.rows[joints, kernel.PERIOD] > 0) & (high - low > 2 * np.pi)
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
        rows = chain.rows.copy()
        for column in (kernel.LOW, kernel.HIGH, kernel.FREE_LOW, kernel.FREE_HIGH):
            rows[joints, column] = position
        rows[joints, kernel.PERIOD] = 0.0
        known = known.copy()
        known[:, joints] = position
        found = _find(problem, frozen(rows), known, limit, is_first=k == 0)
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


def _find(problem: Problem, rows: Array, begin: Array, bound: int, is_first: bool) -> _Found:
    kernel = compiled()
    chain = problem.chain
    n = problem.arm.n
    whole = rows.copy()
    turns = rows[:n, kernel.PERIOD] > 0
    whole[:n, kernel.LOW][turns] = -np.pi
    whole[:n, kernel.HIGH][turns] = np.pi
    known = np.empty((bound, n))
    count, starts, steps = kernel.find_all(
        rows,
        frozen(whole),
        chain.reach,
        problem.targets[0],
        problem.constraint,
        problem.position_tolerance * TOLERANCE_SHARE,
        problem.orientation_tolerance * TOLERANCE_SHARE,
        frozen(chain.to_units(problem.q0)[0].copy()),
        frozen(np.ascontiguousarray(begin)),
        bound,
        PATIENCE if is_first else SWEEP_PATIENCE,
        is_first,
        problem.seed,
        known,
    )
    return _Found(known[:count], starts, steps)


def _inside_limits(problem: Problem, q: Array) -> Array:
    """Configurations (N, n) in rad: each hinge turned by whole turns to the position nearest to q0 inside the limits.

    Those for which there is none are left out.
    """
    kernel = compiled()
    chain = problem.chain
    n = problem.arm.n
    low = chain.rows[:n, kernel.LOW] - kernel.LIMIT_ROUNDING
    high = chain.rows[:n, kernel.HIGH] + kernel.LIMIT_ROUNDING
    period = chain.rows[:n, kernel.PERIOD]
    turn = np.where(period > 0, period, np.inf)
    q = q + period * np.round((chain.to_units(problem.q0) - q) / turn)
    q = q - period * np.ceil(np.maximum(0.0, q - high) / turn)
    q = q + period * np.ceil(np.maximum(0.0, low - q) / turn)
    inside = np.all((q >= low) & (q <= high), axis=1)
    return chain.limits.clamp(q[inside] * chain.unit)


def _max_solutions(chain: PackedChain, constraint: int) -> int:
    """How many isolated solutions there can be, without regard to the limits; 0 if no bound is known."""
    kernel = compiled()
    n = len(chain.rows) - 1
    if n != 6 or len(chain.unit) != 6 or chain.has_slides or constraint != kernel.POSE:
        return 0
    work = kernel.scratch(n, n)
    kernel.forward(chain.rows, np.full(n, 0.3), work)
    axes = work[:n, kernel.AXIS : kernel.AXIS + 3]
    origins = work[:n, kernel.ORIGIN : kernel.ORIGIN + 3]
    for k in range(n - 2):
        are_parallel = all(_sine(axes[k], axes[j]) < SPECIAL_AXES_TOLERANCE for j in (k + 1, k + 2))
        if are_parallel or _meet(origins[k : k + 3], axes[k : k + 3]):
            return MAX_SOLUTIONS_SPECIAL_6R
    return MAX_SOLUTIONS_6R


def _sine(a: Array, b: Array) -> float:
    return float(np.linalg.norm(np.cross(a, b)))


def _meet(origins: Array, axes: Array) -> bool:
    """Whether three lines have a point in common: the least-squares point nearest to all of them lies on each."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    point = np.linalg.lstsq(across.reshape(9, 3), np.einsum("kij,kj->ki", across, origins).reshape(9), rcond=None)[0]
    distance = np.linalg.norm(np.einsum("kij,kj->ki", across, point - origins), axis=1)
    return bool((distance < SPECIAL_AXES_TOLERANCE).all())


def _all_regular(problem: Problem, q: Array) -> bool:
    """Whether the Jacobian has full rank at each of the configurations (N, n), in the solver's units."""
    values = np.linalg.svd(np.array([_jacobian(problem.chain, problem.constraint, row) for row in q]), compute_uv=False)
    return bool((values[:, -1] > MIN_REGULAR_SINGULAR_VALUE).all())


def _jacobian(chain: PackedChain, constraint: int, q: Array) -> Array:
    """(6, n), or (3, n) for a point, in the solver's units; a free axis is taken out."""
    kernel = compiled()
    n = len(q)
    work = kernel.scratch(len(chain.rows) - 1, n)
    kernel.forward(chain.rows, q, work)
    target = work[-2, :12].copy()
    target[9:] *= chain.reach
    hessian = np.empty((n, n))
    gradient = np.empty(n)
    J = np.empty((6, n))
    kernel.objective(chain.rows, chain.reach, target, constraint, 0.0, False, q, hessian, gradient, J, work)
    return J[:3] if constraint == kernel.POSITION else J


@lru_cache(maxsize=64)
def _swept_joints(chain: PackedChain, constraint: int) -> tuple[int, ...]:
    """The surplus joints to sweep: those without which the other joints move the tip best, on average."""
    kernel = compiled()
    rank = {kernel.POSE: 6, kernel.POSITION: 3}.get(constraint, 5)
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
