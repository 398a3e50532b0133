"""solve_ik_batch: configurations for many targets, on all cores."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from armctl._core import Constraint
from armctl.core.errors import InputError
from armctl.core.pose import Pose, computed_pose, read_transforms
from armctl.core.progress import progress_bar
from armctl.core.tip_targets import TipTargets
from armctl.core.validation import Array, IntArray, array, as_array, frozen, integer, matrix
from armctl.model.arm.arm import Arm
from armctl.plan.ik import lm
from armctl.plan.ik.ik_result import BATCH_ARRAYS, IkBatch, IkResult, batch_of, failure_reason
from armctl.plan.ik.problem import IkProblem, constraint_of, open_chain, read_problem, read_starts
from armctl.plan.ik.solve import solve_ik

MAX_CHUNK = 1024  # targets
MIN_CHUNK = 128


def solve_ik_batch(
    arm: Arm,
    targets: Sequence[Pose] | Sequence[TipTargets] | ArrayLike,
    q0: ArrayLike | None = None,
    threads: int | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    seed: int = 0,
) -> IkBatch:
    """Configurations for many targets; each answer is the one that `solve_ik` gives for that target alone.

    If stderr is a terminal, a progress bar appears after two seconds.

    Args:
        targets: N Poses, (N, 4, 4) homogeneous transforms as for `Pose.from_matrix`, or (N, 3) m for positions only; or N
            dicts of targets by tip, as for `solve_ik`.
        q0: (n,) or (N, n) rad (m for a slide joint), where the search starts. By default the arm's home.
        threads: How many threads to use; by default one per core.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which every target may be turned freely.

    Raises:
        InputError: An argument has a wrong shape, type or value.
        LimitError: q0 is outside the joint limits.
    """
    threads = (os.cpu_count() or 1) if threads is None else integer("threads", threads, 1)
    solve = partial(
        solve_ik,
        arm,
        position_tolerance=position_tolerance,
        orientation_tolerance=orientation_tolerance,
        free_axis=free_axis,
        seed=seed,
    )
    if isinstance(targets, Sequence) and any(isinstance(target, Mapping) for target in targets):
        return _solve_each(arm, solve, targets, q0, threads)
    constraint, numbers = _read_targets(cast("Sequence[Pose] | ArrayLike", targets), free_axis)
    if open_chain(arm) is None:
        is_position = constraint == Constraint.POSITION
        poses = [row[9:] if is_position else computed_pose(row[9:], row[:9].reshape(3, 3)) for row in numbers]
        return _solve_each(arm, solve, poses, q0, threads)
    problem = read_problem(arm, constraint, numbers, q0, position_tolerance, orientation_tolerance, seed)
    count = len(numbers)
    parts: list[IkBatch] = []
    with progress_bar("IK", count, "targets") as progress, ThreadPoolExecutor(threads) as pool:
        try:
            for part in pool.map(lambda rows: _solve(problem, rows, q0 is not None), _chunks(count, threads)):
                parts.append(part)
                progress.update(len(part.ok))
        finally:
            pool.shutdown(cancel_futures=True)
    arrays: dict[str, Any] = {name: frozen(np.concatenate([getattr(part, name) for part in parts])) for name in BATCH_ARRAYS}
    return IkBatch(**arrays, branch=tuple(itertools.chain.from_iterable(part.branch for part in parts)))


def _solve_each(
    arm: Arm, solve: Callable[..., IkResult], targets: Sequence[Any], q0: ArrayLike | None, threads: int
) -> IkBatch:
    """The answers of `solve_ik` to single targets."""
    starts = [None] * len(targets) if q0 is None else read_starts(arm, q0, len(targets))
    with progress_bar("IK", len(targets), "targets") as progress, ThreadPoolExecutor(threads) as pool:
        results = []
        try:
            for result in pool.map(solve, targets, starts):
                results.append(result)
                progress.update()
        finally:
            pool.shutdown(cancel_futures=True)
    return batch_of(results, arm.n)


def _chunks(count: int, threads: int) -> list[IntArray]:
    """The targets' numbers in parts, smaller towards the end, so that all threads end at about the same time."""
    chunks = []
    begin = 0
    while begin < count or not chunks:
        left = count - begin
        end = begin + min(left, MAX_CHUNK, max(MIN_CHUNK, left // (2 * threads)))
        chunks.append(np.arange(begin, end))
        begin = end
    return chunks


def _solve(problem: IkProblem, rows: IntArray, stay_near: bool) -> IkBatch:
    part = problem.select(rows)
    found = lm.search(part, 0, lm.LM_STARTS)
    q = lm.stay_near(part, found) if stay_near else found.q
    position_error, orientation_error = part.residuals(q)
    ok = part.is_solved(position_error, orientation_error)
    reason = np.full(len(rows), "", object)
    failed = np.flatnonzero(~ok)
    if len(failed):
        effort = lm.best_effort(part.select(failed), q[failed])
        q[failed] = effort.q
        position_error[failed] = effort.position_error
        orientation_error[failed] = effort.orientation_error
        ok[failed] = part.is_solved(effort.position_error, effort.orientation_error)
        columns = (effort.out_of_reach, effort.position_error, effort.orientation_error, found.next_start[failed])
        reason[failed] = [failure_reason(*row, part.chain.reach) for row in zip(*columns, strict=True)]
        reason[ok] = ""
    return IkBatch(
        ok=ok,
        q=q,
        position_error=position_error,
        orientation_error=orientation_error,
        reason=reason,
        iterations=found.iterations,
        starts=found.next_start,
        branch=tuple(part.chain.branches(q)),
    )


def _read_targets(targets: Sequence[Pose] | ArrayLike, free_axis: str | None) -> tuple[Constraint, Array]:
    """The constraint of the targets and their numbers (N, 12), checked."""
    if isinstance(targets, Pose):
        raise InputError("targets: expected a list of Poses, got one Pose; solve_ik takes one")
    if isinstance(targets, Sequence) and len(targets) and isinstance(targets[0], Pose):
        poses = [target for target in targets if isinstance(target, Pose)]
        if len(poses) < len(targets):
            raise InputError(f"targets: {len(poses)} of {len(targets)} are Poses, expected all or none")
        return constraint_of(True, free_axis), np.array([T.rows for T in poses]).reshape(-1, 12)
    numbers = cast(ArrayLike, targets)
    if as_array("targets", numbers).ndim == 3:
        return constraint_of(True, free_axis), _read_transforms(array("targets", numbers, 3))
    points = matrix("targets", numbers, 3) if np.size(numbers) else np.empty((0, 3))
    return constraint_of(False, free_axis), np.concatenate([np.zeros((len(points), 9)), points], axis=1)


def _read_transforms(T: Array) -> Array:
    if T.shape[1:] != (4, 4):
        raise InputError(f"targets: expected shape (N, 4, 4) or (N, 3), got {T.shape}")
    return read_transforms("targets", T)
