"""solve_ik: joint positions for one target."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from armctl.collision.checker import collision_checker
from armctl.core.errors import UnknownNameError
from armctl.core.validation import Array, IntArray, frozen
from armctl.ik import lm
from armctl.ik.problem import PoseOrPoint, Problem, read_problem, read_target
from armctl.ik.result import IkResult, why_not
from armctl.robot.arm import Arm

STARTS, MINK_STARTS = 300, 60
NEAREST_STARTS = 64
PULL = 1e-3

Search = Callable[[Problem, int, int, Array | None], tuple[Array, IntArray]]


def solve_ik(
    arm: Arm,
    target: PoseOrPoint,
    q0: ArrayLike | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    nearest: bool = False,
    avoid_collisions: bool = False,
    method: str = "lm",
    rng: int = 0,
) -> IkResult:
    """Joint positions that bring the tip to a target, inside the joint limits.

    The same call gives the same answer on any machine: steps and starts are counted, no clock decides.

    Args:
        arm: The arm.
        target: A Pose, or (3,) m for position only.
        q0: (n,) rad, where to start; the solution is near it where possible. Left out, the arm's home.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.
        nearest: Whether to look for many solutions and take the one nearest to q0.
        avoid_collisions: Whether the arm must touch neither itself nor the scene, with all else at home.
        method: "lm", the compiled Levenberg-Marquardt, or "mink", `DifferentialIk` stepped until it arrives.
        rng: The seed of the random starts.

    Returns:
        The result; where `ok` is False it holds the best effort and says why.

    Raises:
        InputError: An argument of the wrong shape, kind or value.
        LimitError: q0 is outside the joint limits.
        UnknownNameError: There is no such method.
    """
    asked, numbers = read_target(target, free_axis)
    problem = read_problem(arm, asked, numbers[None], q0, position_tolerance, orientation_tolerance, rng)
    search, most = _search(method)
    touched_at = collision_checker(arm).at if avoid_collisions else _nothing
    found = _one_by_one(problem, search, most, stay_near=q0 is not None)
    if nearest:
        found = chain(_nearest_first(problem, search), found)
    q, starts, steps, kept, touched = problem.q0[0], 0, 0, None, ""
    for q, starts, steps in found:
        off, turned = problem.residual(q)
        if off > problem.position_tolerance or turned > problem.orientation_tolerance:
            break
        touched = touched_at(q)
        kept = IkResult(not touched, frozen(q), off, turned, "", steps, starts)
        if not touched:
            return kept
    if kept is not None:
        return kept._replace(reason=f"no solution without contact found in {starts} starts: {touched}")
    best, out_of_reach = lm.best_effort(problem, q[None])
    q = frozen(best[0])
    off, turned = problem.residual(q)
    return IkResult(False, q, off, turned, why_not(bool(out_of_reach[0]), off, starts), steps, starts)


def _nothing(q: Array) -> str:
    return ""


def _search(method: str) -> tuple[Search, int]:
    if method == "lm":
        return lm.search, STARTS
    if method == "mink":
        from armctl.ik import mink_solver as stepping

        return stepping.search, MINK_STARTS
    raise UnknownNameError.of("method", str(method), ["lm", "mink"])


def _one_by_one(problem: Problem, search: Search, most: int, stay_near: bool) -> Iterator[tuple[Array, int, int]]:
    """Solutions (n,) in the order they are found, each with the starts and steps so far; the last may be a best effort."""
    start, steps = 0, 0
    while start < most:
        q, tally = search(problem, start, most, None)
        if start == 0 and stay_near:
            q = lm.stay_near(problem, q, tally)
        [(_, start, more, _)] = tally.tolist()
        steps += more
        yield q[0], start, steps


def _nearest_first(problem: Problem, search: Search) -> Iterator[tuple[Array, int, int]]:
    """Solutions from many starts, drawn towards q0 as far as they remain solutions, the nearest first."""
    many = problem.rows(np.zeros(NEAREST_STARTS, np.int64))
    begin = problem.arm.limits.random(problem.q0[0], NEAREST_STARTS, np.random.default_rng(problem.seed))
    begin[0] = problem.q0[0]
    found, first = search(many, 0, 1, begin)
    drawn, second = lm.search(many, 0, 1, lm.settle(many, found, PULL)[0])
    q = np.concatenate([found[first[:, 0] == 1], drawn[second[:, 0] == 1]])
    steps = int(first[:, 2].sum() + second[:, 2].sum())
    for k in np.argsort(np.linalg.norm(q - problem.q0, axis=1), kind="stable"):
        yield q[k], NEAREST_STARTS, steps
