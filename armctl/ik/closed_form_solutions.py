"""Solutions of a closed form: found by its kernels, refined by those of the solver."""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array, BoolArray, IntArray
from armctl.ik.geometry import ClosedForm
from armctl.ik.problem import PackedChain, Problem

MIN_SAMPLES = 16  # of a sweep
MAX_SEEDS_PER_SAMPLE = 16
MIN_EMPTY_SAMPLES = 256  # of a sweep that finds nothing
SAMPLES_PER_SOLUTION = 4  # of a sweep
FIRST_SAMPLES = 64  # of a sweep that ends at the first solution
# How far outside the limits a solution of the closed form may be before it is refined: at a double root, slack in a cosine
# moves a joint by its square root.
SINGULAR_MARGIN = 0.03  # rad
INEXACT_MARGIN = 0.2  # rad, if the axes are only almost special
DEVIATION_FACTOR = 10.0  # slack in cosines for each unit by which the axes deviate


class Solutions(NamedTuple):
    """Distinct solutions inside the limits, the nearest to q0 first.

    Attributes:
        q: (N, n) rad.
        position_error: (N,) m.
        orientation_error: (N,) rad.
        branch: (N,) numbers of the branches, as floats.
        starts: How many configurations were begun with.
        steps: Solver steps.
        is_complete: Whether there is proved to be no other.
    """

    q: Array
    position_error: Array
    orientation_error: Array
    branch: Array
    starts: int
    steps: int
    is_complete: bool

    def select(self, rows: IntArray) -> Solutions:
        """Those with the numbers (K,)."""
        return self._replace(
            q=self.q[rows],
            position_error=self.position_error[rows],
            orientation_error=self.orientation_error[rows],
            branch=self.branch[rows],
        )


def closed_form_solutions(problem: Problem, closed_form: ClosedForm, limit: int) -> Solutions:
    """The solutions of an arm with a closed form, refined; of seven joints a sample."""
    chain = problem.chain
    n = len(chain.unit)
    q0 = problem.q0[0]
    slack = problem.position_tolerance / chain.reach + problem.orientation_tolerance
    margin = SINGULAR_MARGIN
    if not closed_form.is_exact:
        slack += DEVIATION_FACTOR * closed_form.deviation
        margin = INEXACT_MARGIN
    is_swept = closed_form.held >= 0
    seeds = np.empty((limit + MAX_SEEDS_PER_SAMPLE * MIN_SAMPLES if is_swept else MAX_SEEDS_PER_SAMPLE, n))
    target = problem.targets[0]
    count, doubtful, samples = _kernels().find(
        closed_form.form,
        chain.reach,
        target,
        q0,
        slack,
        margin,
        MIN_SAMPLES,
        max(MIN_EMPTY_SAMPLES, SAMPLES_PER_SOLUTION * limit),
        limit,
        seeds,
    )
    return polished(problem, seeds[:count], samples, closed_form.is_exact and not doubtful and not is_swept)


def first_solutions(chain: PackedChain, closed_form: ClosedForm, targets: Array, q: Array) -> BoolArray:
    """Fills q (N, n) with one solution for each of the targets (N, 12) that has any inside the limits; returns which have.

    They are exact as far as the closed form is. `q` also holds the configurations near which to search first.
    """
    found = np.empty(len(targets), np.bool_)
    margin = 0.0 if closed_form.is_exact else INEXACT_MARGIN
    slack = 0.0 if closed_form.is_exact else DEVIATION_FACTOR * closed_form.deviation
    _kernels().find_first(closed_form.form, chain.reach, targets, slack, margin, FIRST_SAMPLES, q, found)
    return found


def polished(problem: Problem, seeds: Array, starts: int, is_complete: bool) -> Solutions:
    """The solutions that seeds (M, n) lead to, the nearest to q0 first; `is_complete` holds if none of the seeds is lost."""
    chain = problem.chain
    q = np.empty(seeds.shape)
    details = np.empty((3, len(seeds)))
    found, steps, lost = chain.kernel.polish(
        chain.rows,
        chain.reach,
        problem.targets[0],
        problem.position_tolerance,
        problem.orientation_tolerance,
        problem.q0[0],
        seeds,
        q,
        details,
    )
    if found < len(seeds):
        q = q[:found]
        details = details[:, :found]
    return Solutions(q, details[0], details[1], details[2], starts, steps, is_complete and lost == 0)


@cache
def _kernels() -> ModuleType:
    """The compiled kernels of the closed form; numba is imported when they are first used."""
    from armctl.ik import closed_form

    return closed_form
