"""solve_ik_batch: joint positions for many targets, on all cores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.pose import Pose
from armctl.core.progress import progress_bar
from armctl.core.validation import Array, IntArray, array, frozen, matrix
from armctl.ik import lm
from armctl.ik.problem import Problem, asked_for, compiled, read_problem
from armctl.ik.result import IkBatch, why_not
from armctl.ik.solve import STARTS
from armctl.robot.arm import Arm

CHUNK, LAST_CHUNK = 1024, 128


def solve_ik_batch(
    arm: Arm,
    targets: Sequence[Pose] | ArrayLike,
    q0: ArrayLike | None = None,
    threads: int | None = None,
    *,
    position_tolerance: float = 1e-5,
    orientation_tolerance: float = 1e-4,
    free_axis: str | None = None,
    rng: int = 0,
) -> IkBatch:
    """Joint positions for many targets; each answer is what `solve_ik` gives for it alone.

    A progress bar appears on stderr after two seconds where a person watches.

    Args:
        arm: The arm.
        targets: N Poses, (N, 4, 4) homogeneous transforms, or (N, 3) m for positions only.
        q0: (n,) or (N, n) rad, where to start. Left out, the arm's home.
        threads: How many cores to use; all of them where left out.
        position_tolerance: m.
        orientation_tolerance: rad.
        free_axis: "x", "y" or "z": the tip's axis about which every target may be turned freely.
        rng: The seed of the random starts.

    Returns:
        The fields of IkResult as arrays.

    Raises:
        InputError: An argument of the wrong shape, kind or value.
        LimitError: q0 is outside the joint limits.
    """
    asked, numbers = _read_targets(targets, free_axis)
    problem = read_problem(arm, asked, numbers, q0, position_tolerance, orientation_tolerance, rng)
    if threads is not None and (isinstance(threads, bool) or not isinstance(threads, int) or threads < 1):
        raise InputError(f"threads: {threads!r} given, an integer of at least 1 wanted")
    count, workers = len(numbers), threads or os.cpu_count() or 1
    chunks = _chunks(count, workers)
    parts: dict[int, IkBatch] = {}
    with progress_bar("IK", count, "targets") as progress, ThreadPoolExecutor(workers) as pool:
        jobs = {pool.submit(_solve, problem, rows, q0 is not None): i for i, rows in enumerate(chunks)}
        try:
            for job in as_completed(jobs):
                parts[jobs[job]] = job.result()
                progress.update(len(chunks[jobs[job]]))
        finally:
            pool.shutdown(cancel_futures=True)
    columns = ([getattr(parts[i], field) for i in range(len(chunks))] for field in IkBatch.__slots__)
    return IkBatch(*(frozen(np.concatenate(column)) for column in columns))


def _chunks(count: int, workers: int) -> list[IntArray]:
    """The targets' numbers in parts, smaller towards the end: nobody waits long for the one who is last."""
    ends = [0]
    while len(ends) == 1 or ends[-1] < count:
        left = count - ends[-1]
        ends.append(ends[-1] + min(left, CHUNK, max(LAST_CHUNK, left // (2 * workers))))
    return [np.arange(*part) for part in pairwise(ends)]


def _solve(problem: Problem, rows: IntArray, stay_near: bool) -> IkBatch:
    part = problem.rows(rows)
    q, tally = lm.search(part, 0, STARTS)
    if stay_near:
        q = lm.stay_near(part, q, tally)
    off, turned = part.residuals(q)
    ok = (off <= part.position_tolerance) & (turned <= part.orientation_tolerance)
    reason = np.full(len(rows), "", object)
    failed = np.flatnonzero(~ok)
    if len(failed):
        q[failed], out_of_reach = lm.best_effort(part.rows(failed), q[failed])
        off, turned = part.residuals(q)
        reason[failed] = [why_not(*row) for row in zip(out_of_reach, off[failed], tally[failed, 1], strict=True)]
    return IkBatch(ok, q, off, turned, reason, tally[:, 2], tally[:, 1])


def _read_targets(targets: Sequence[Pose] | ArrayLike, free_axis: str | None) -> tuple[int, Array]:
    """What is asked for, and (N, 12): rotation row by row (zeros for points), position."""
    if isinstance(targets, Pose):
        raise InputError("targets: one Pose given, a list of them wanted; solve_ik takes one")
    if isinstance(targets, Sequence) and len(targets) and isinstance(targets[0], Pose):
        poses = [target for target in targets if isinstance(target, Pose)]
        if len(poses) < len(targets):
            raise InputError(f"targets: {len(poses)} of {len(targets)} are Poses; all or none wanted")
        return asked_for(True, free_axis), np.array([T.rows for T in poses]).reshape(-1, 12)
    numbers = cast(ArrayLike, targets)
    if np.ndim(numbers) == 3:
        T = array("targets", numbers, 3)
        if T.shape[1:] != (4, 4):
            raise InputError(f"targets: shape {T.shape} given, (N, 4, 4) or (N, 3) wanted")
        rows = np.empty((len(T), 12))
        read = compiled().read_transforms(T, rows)
        if read < len(T):
            raise InputError(f"targets: element {read} is no rigid transform")
        return asked_for(True, free_axis), rows
    points = matrix("targets", numbers, 3) if np.size(numbers) else np.empty((0, 3))
    return asked_for(False, free_axis), np.concatenate([np.zeros((len(points), 9)), points], axis=1)
