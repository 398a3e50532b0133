"""The mink method of `solve_ik`: DifferentialIk stepped until it converges, from counted starts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array
from armctl.ik.differential import DifferentialIk, unchecked_velocity
from armctl.ik.lm import SearchResult
from armctl.ik.problem import Problem, compiled

STEP_S = 1.0  # the velocity limits then bound a step, not a motion
MAX_STEPS = 60
STALL_STEPS = 4  # a descent ends after so many steps ...
STALL_RATIO = 0.7  # ... in which the error stays above this share of what it was
ROTATION_WEIGHT = 0.5  # reaches per rad


class _Descent(NamedTuple):
    """The best configuration that a descent met, its error, whether it is a solution, and the number of steps."""

    q: Array
    error: float
    solved: bool
    steps: int


def search(problem: Problem, first: int, last: int, begin: Array | None = None) -> SearchResult:
    """Searches from the starts `first` to `last - 1`. Start 0 is `begin` (N, n), by default q0; the others are random."""
    follower = DifferentialIk(problem.arm, posture_gain=0.0)
    follower.tip.converges_out_of_reach = False
    count = len(problem.targets)
    begin = problem.q0 if begin is None else begin
    found = SearchResult(np.empty_like(problem.q0), np.zeros((compiled().SEARCH_ROWS, count), np.int64))
    for t in range(count):
        part = problem.select(np.array([t]))
        starts = problem.arm.limits.random(part.q0[0], last, np.random.default_rng(problem.seed))
        starts[0] = begin[t]
        best: _Descent | None = None
        for start in range(first, last):
            descent = _descend(follower, part, starts[start])
            found.iterations[t] += descent.steps
            found.next_start[t] = start + 1
            if best is None or descent.solved or descent.error < best.error:
                best = descent
            if descent.solved:
                break
        if best is not None:
            found.q[t] = best.q
            found.report[compiled().SOLVED, t] = best.solved
    return found


def _descend(follower: DifferentialIk, problem: Problem, q: Array) -> _Descent:
    best = np.inf
    best_q = q
    reference = np.inf
    stalled = 0
    steps = 0
    solved = False
    while steps < MAX_STEPS and stalled < STALL_STEPS and not solved:
        steps += 1
        position_error, orientation_error = problem.residual(q)
        error = float(np.hypot(position_error / problem.chain.reach, ROTATION_WEIGHT * orientation_error))
        solved = position_error <= problem.position_tolerance and orientation_error <= problem.orientation_tolerance
        if solved or error < best:
            best = error
            best_q = q
        stalled += 1
        if error < STALL_RATIO * reference:
            reference = error
            stalled = 0
        if not solved:
            q = unchecked_velocity(follower, q, problem.constraint, problem.targets[0], STEP_S) * STEP_S + q
            q = problem.arm.limits.clamp(q)
    return _Descent(best_q, best, solved, steps)
