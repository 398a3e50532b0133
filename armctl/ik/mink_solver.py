"""The mink method of `solve_ik`: DifferentialIk stepped until it arrives, from counted starts."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.ik.differential import DifferentialIk
from armctl.ik.problem import Problem

STEP = 1.0  # s: the velocity limits bound a step, not a motion
STEPS = 60
STALL_STEPS, STALL_GAIN = 4, 0.7


def search(problem: Problem, first: int, last: int, begin: Array | None = None) -> tuple[Array, IntArray]:
    """Solutions, from the starts of the numbers `first` to `last`. Start 0 is `begin`, the others are random.

    Args:
        problem: N targets.
        first: The first start.
        last: The one after the last start.
        begin: (N, n) rad, inside the joint limits; left out, q0.

    Returns:
        (N, n) rad inside the joint limits, the solutions or the best positions met, and (N, 4): 1 for a solution, the start
        after the last one used, steps, 0.
    """
    follower = DifferentialIk(problem.arm, posture_gain=0.0)
    follower.tip.settles = False
    q, tally = np.empty_like(problem.q0), np.zeros((len(problem.targets), 4), np.int64)
    for t in range(len(problem.targets)):
        part = problem.rows(np.array([t]))
        others = problem.arm.limits.random(part.q0[0], last, np.random.default_rng(problem.seed))
        best, start, ok = np.inf, first, False
        while start < last and not ok:
            trial = others[start] if start else (part.q0 if begin is None else begin)[0 if begin is None else t]
            start += 1
            trial, size, ok, steps = _descend(follower, part, trial)
            tally[t, 2] += steps
            if ok or size < best:
                q[t], best = trial, size
        tally[t, :2] = ok, start
    return q, tally


def _descend(follower: DifferentialIk, problem: Problem, q: Array) -> tuple[Array, float, bool, int]:
    """Steps from q: the best position met, its error, whether it is inside the tolerance, and how many steps."""
    best, kept, reference, stalled, steps, ok = np.inf, q, np.inf, 0, 0, False
    while steps < STEPS and stalled < STALL_STEPS and not ok:
        steps += 1
        off, turned = problem.residual(q)
        size = float(np.hypot(off / problem.chain.reach, 0.5 * turned))
        ok = off <= problem.position_tolerance and turned <= problem.orientation_tolerance
        if ok or size < best:
            best, kept = size, q
        stalled += 1
        if size < STALL_GAIN * reference:
            reference, stalled = size, 0
        if not ok:
            q = follower.toward(q, problem.asked, problem.targets[0], STEP) * STEP + q
            q = problem.arm.limits.clamp(q)
    return kept, best, ok, steps
