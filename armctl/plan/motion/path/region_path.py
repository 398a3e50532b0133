"""From a path of regions to a path of the joints: which branch, which turn of the tool, and then the shortest way.

The configurations of some points are the rungs of a ladder, between which dynamic programming finds the shortest way (J. De
Maeyer, B. Moyaers, E. Demeester, "Cartesian path planning for arc welding robots: evaluation of the Descartes algorithm", ETFA
2017). It is then shortened within the regions, first between few points and at last between all of them, as in a multigrid
method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.region import RegionPart
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.model.arm.arm import Arm
from armctl.plan.ik.problem import IkChain, ik_chain
from armctl.plan.ik.region_solutions import SAME_CONFIGURATION
from armctl.plan.ik.solve import solve_ik

_RUNGS = 48  # points of the first ladder
_SEEDS = 64  # configurations that are descended from at the first one
_FURTHER_SEEDS = 24  # and at each other one, in turn
_BEAM = 96  # configurations of a point that are kept
_MAX_RUNG_STEP = 0.7  # rad (m), of any joint from one rung to the next: a longer way may pass a singularity
_MAX_POINT_STEP = 0.5  # rad (m), from one point to the next
_MAX_LADDERS = 12  # with a rung more where the one before broke
_COARSE_SWEEPS = 120
_SWEEPS = 10
_SMOOTHING_SHARE = 0.007  # of the points: the width over which the way is smoothed, where it meets a cone or a limit
_SMOOTHINGS = 3
_CONE_SHARE = 0.95  # of a cone, in which the way is shortened; the smooth way has the whole
_MAX_RESIDUAL = 1e-9  # m and rad: what is left makes a jerk
_ROTATION_LENGTH = 0.2  # m for a rad, in the distance between two regions
_MIN_SPACING = 1e-9  # m, between points that are not the same


class RegionPath(NamedTuple):
    """Regions of one part each, which the tip passes in turn."""

    parts: list[RegionPart]
    numbers: Array  # (N, 38) as the core takes them
    lengths: Array  # (N,) m, from the first one; strictly increasing
    given: IntArray  # (N,) the numbers of the points of the caller that they are, or come after


def region_path(parts: list[RegionPart], given: IntArray) -> RegionPath:
    """The path of regions in turn, without those that are the same as the one before; `given` (N,) as in `RegionPath`."""
    rows = nominal_poses(parts)
    moved = np.linalg.norm(np.diff(rows[:, 3], axis=0), axis=1)
    turned = np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=(1, 2)) / np.sqrt(2.0)
    spacing = moved + _ROTATION_LENGTH * turned
    kept = np.append(True, spacing > _MIN_SPACING)
    chosen = [part for part, is_kept in zip(parts, kept, strict=True) if is_kept]
    lengths = np.append(0.0, np.cumsum(spacing[kept[1:]]))
    return RegionPath(chosen, np.array([part.numbers for part in chosen]), lengths, given[kept])


def nominal_poses(parts: list[RegionPart]) -> Array:
    """(N, 4, 3) the rows of the middle poses of regions, as those of a Pose."""
    frames = np.array([part.frame.rows for part in parts])
    tips = np.array([part.tip.rows for part in parts])
    rows = np.einsum("nij,njk->nik", frames[:, :3], tips[:, :3])
    positions = frames[:, 3] + np.einsum("nij,nj->ni", frames[:, :3], tips[:, 3])
    return np.concatenate([rows, positions[:, None]], axis=1)


def joint_path_through(arm: Arm, path: RegionPath, q_start: Array | None) -> Array:
    """(N, n) the configurations of a short joint path through regions, from q_start if it is given; else a PlanError."""
    ladder = _Ladder(arm, path, q_start)
    rungs = _evenly(path.lengths, _RUNGS)
    broken = rungs
    for _ in range(_MAX_LADDERS):
        q, broken = ladder.shortened(ladder.climbed(rungs), rungs)
        if not len(broken):
            return q
        rungs = np.union1d(rungs, broken)
    raise PlanError(
        f"{ladder.where(int(broken[0]))}: no joint path passes it without a jump; a singularity or a limit of a joint is in "
        "between: widen the cone, or divide the path"
    )


def _evenly(lengths: Array, count: int) -> IntArray:
    """Numbers of about so many points, evenly spaced in length, the first and the last among them."""
    return np.unique(np.abs(lengths[:, None] - np.linspace(0.0, lengths[-1], count)).argmin(axis=0))


class _Ladder:
    """A path of regions, and the searches on it."""

    def __init__(self, arm: Arm, path: RegionPath, q_start: Array | None):
        self._arm = arm
        self._chain: IkChain = ik_chain(arm)
        self._path = path
        self._narrowed = path.numbers.copy()
        self._narrowed[:, -1] *= _CONE_SHARE
        self._start = q_start
        self._near = np.ascontiguousarray(self._chain.to_units(arm.home if q_start is None else q_start))
        drawn = arm.limits.random(arm.home, _SEEDS - 1, np.random.default_rng(0))
        self._seeds = self._chain.to_units(np.vstack([arm.home, drawn]))

    def climbed(self, rungs: IntArray) -> Array:
        """(R, n) configurations of the rungs on the shortest way up. PlanError at the first rung that is not reached."""
        beams: list[Array] = []
        parents: list[IntArray] = []
        costs = np.empty(0)
        for step, point in enumerate(rungs.tolist()):
            if step == 0:
                beam = self._first_rung(point)
                costs = np.zeros(len(beam))
                parent = np.zeros(len(beam), np.int64)
            else:
                beam, costs, parent = self._next_rung(int(rungs[step - 1]), point, beams[-1], costs)
            beams.append(beam)
            parents.append(parent)
        best = int(costs.argmin())
        q = np.empty((len(rungs), self._arm.n))
        for step in range(len(rungs) - 1, -1, -1):
            q[step] = beams[step][best]
            best = int(parents[step][best])
        return q

    def _first_rung(self, point: int) -> Array:
        if self._start is not None:
            q = self._chain.to_units(self._start[None])
            solved, placed = self._into(np.array([point]), q)
            if not solved[0] or np.abs(placed - q).max() > SAME_CONFIGURATION:
                raise PlanError(f"{self.where(point)}: the tip is not there at q_start; move to it first, or give q_start=None")
            return q
        solved, found = self._into(np.full(len(self._seeds), point), self._seeds)
        if not solved.any():
            raise self._out_of_reach(point)
        return _distinct(found[solved], np.zeros(int(solved.sum())))[0]

    def _next_rung(self, before: int, point: int, beam: Array, costs: Array) -> tuple[Array, Array, IntArray]:
        """The configurations of a rung, their costs and the numbers of those before."""
        seeds = self._seeds[(point + np.arange(_FURTHER_SEEDS)) % len(self._seeds)]
        begin = np.vstack([beam, seeds])
        solved, found = self._into(np.full(len(begin), point), begin)
        if not solved.any():
            raise self._out_of_reach(point)
        found = found[solved]
        steps = found[:, None] - beam
        ways = np.where(np.abs(steps).max(axis=2) <= _MAX_RUNG_STEP, np.linalg.norm(steps, axis=2), np.inf) + costs
        parent = ways.argmin(axis=1)
        total = ways[np.arange(len(found)), parent]
        if not np.isfinite(total).any():
            raise self._broken(before, point, beam)
        reached = np.isfinite(total)
        kept, rows = _distinct(found[reached], total[reached])
        return kept, total[reached][rows], parent[reached][rows]

    def shortened(self, q: Array, rungs: IntArray) -> tuple[Array, IntArray]:
        """(N, n) the way between the rungs through all points, and the numbers of points at which it breaks."""
        points = rungs
        q = self._relaxed(points, q, _COARSE_SWEEPS)
        count = len(self._path.lengths)
        while len(points) < count:
            finer = (
                np.arange(count)
                if 2 * len(points) >= count
                else np.union1d(points, _evenly(self._path.lengths, 2 * len(points)))
            )
            lengths = self._path.lengths
            between = np.column_stack([np.interp(lengths[finer], lengths[points], column) for column in q.T])
            solved, q = self._into(finer, between)
            points = finer
            if not solved.all():
                return self._chain.from_units(q), points[~solved][:1]
            q = self._relaxed(points, q, _SWEEPS)
        jumps = np.abs(np.diff(q, axis=0)).max(axis=1) > _MAX_POINT_STEP
        if not jumps.any():
            return self._chain.from_units(self._smoothed(q)), np.empty(0, np.int64)
        first = int(jumps.argmax())
        return self._chain.from_units(q), np.array([first, first + 1])

    def _smoothed(self, q: Array) -> Array:
        """The way without the kinks where it meets a cone or a limit: filtered, and back in the regions. Its start stays."""
        from scipy.ndimage import gaussian_filter1d

        width = _SMOOTHING_SHARE * len(q)
        reach = min(int(4.0 * width) + 1, len(q) - 1)
        if width < 1.0:
            return q
        for _ in range(_SMOOTHINGS):
            # Beyond its ends the way goes on as its mirror image about them, so that they stay.
            head = 2.0 * q[0] - q[reach:0:-1]
            tail = 2.0 * q[-1] - q[-2 : -reach - 2 : -1]
            filtered = gaussian_filter1d(np.vstack([head, q, tail]), width, axis=0)[reach : reach + len(q)]
            solved, smoother = self._into(np.arange(len(q)), np.clip(filtered, self._chain.low, self._chain.high))
            if not solved.all() or np.abs(np.diff(smoother, axis=0)).max() > _MAX_POINT_STEP:
                break
            smoother[0] = q[0] if self._start is not None else smoother[0]
            q = smoother
        return q

    def _relaxed(self, points: IntArray, q: Array, sweeps: int) -> Array:
        q = np.ascontiguousarray(q)
        spacing = np.diff(self._path.lengths[points])
        numbers = np.ascontiguousarray(self._narrowed[points])
        is_held = self._start is not None
        self._chain.core.relax_in_regions(numbers, spacing, _MAX_RESIDUAL, _MAX_RESIDUAL, is_held, sweeps, q)
        return q

    def _into(self, points: IntArray, begin: Array) -> tuple[BoolArray, Array]:
        """Which descents into the regions of points end there, and where."""
        q = np.array(begin, order="C")
        solved = np.empty(len(q), np.int64)
        steps = np.empty(len(q), np.int64)
        numbers = np.asarray(points, np.int64)
        # q0 is only what whole turns are counted from: each row is wound to where it begins.
        self._chain.core.search_regions(self._path.numbers, numbers, _MAX_RESIDUAL, _MAX_RESIDUAL, self._near, q, solved, steps)
        period = self._chain.period
        turns = np.where(period > 0, np.rint((begin - q) / np.where(period > 0, period, 1.0)), 0.0)
        wound = q + turns * period
        is_outside = np.maximum(self._chain.low - wound, wound - self._chain.high).max(axis=1, keepdims=True) > 0.0
        return solved == 1, np.where(is_outside, q, wound)

    def where(self, point: int) -> str:
        x, y, z = (self._path.parts[point].frame @ self._path.parts[point].tip).position
        return f"point {self._path.given[point]} of {self._path.given[-1] + 1}, at [{x:.3f}, {y:.3f}, {z:.3f}] m"

    def _out_of_reach(self, point: int) -> PlanError:
        """The error at the first point that no configuration reaches, up to one that none was found for."""
        first = point
        for k in range(point + 1):
            solved, _ = self._into(np.full(len(self._seeds), k), self._seeds)
            if not solved.any():
                first = k
                break
        part = self._path.parts[first]
        nominal = part.frame @ part.tip
        reached = solve_ik(self._arm, nominal.position)
        reason = reached.reason if not reached.ok else "the point is reachable, but not with the tool within its cone"
        return PlanError(f"{self.where(first)}: {reason}")

    def _broken(self, before: int, point: int, beam: Array) -> PlanError:
        """The error at the first point between two rungs to which no configuration of the first one can be continued."""
        q = beam
        for k in range(before + 1, point + 1):
            solved, moved = self._into(np.full(len(q), k), q)
            small = np.abs(moved - q).max(axis=1) <= _MAX_POINT_STEP
            if not (solved & small).any():
                steps = np.where(solved[:, None], np.abs(moved - q), np.inf)
                row = int(steps.max(axis=1).argmin())
                return PlanError(f"{self.where(k)}: no joint path passes it, {self._limit(q[row], steps[row])}")
            q = moved[np.flatnonzero(solved & small)]
        return PlanError(
            f"{self.where(point)}: no joint path passes it; the tool turns too far between two points: give more points between"
        )

    def _limit(self, q: Array, step: Array) -> str:
        """What stops the arm at a configuration from which a step would be so large."""
        limits = self._arm.limits
        q = self._chain.from_units(q)
        margin = np.minimum(q - limits.q_min, limits.q_max - q)
        tight = int(margin.argmin())
        if margin[tight] < 0.05:
            return f"{self._arm.joint_names[tight]} is at its limit, {q[tight]:.3g} {self._arm.units[tight]}"
        if np.isfinite(step).all():
            i = int(step.argmax())
            return f"{self._arm.joint_names[i]} would have to jump by {step[i]:.2g} {self._arm.units[i]}"
        smallest = float(np.linalg.svd(self._arm.pinocchio_model.jacobian(q), compute_uv=False)[-1])
        return f"the arm is stretched out or folded there (smallest singular value {smallest:.2g})"


def _distinct(q: Array, costs: Array) -> tuple[Array, IntArray]:
    """The cheapest configurations that differ, at most a beam of them, and their numbers."""
    order = np.argsort(costs, kind="stable")
    first = np.unique(np.round(q[order] / SAME_CONFIGURATION), axis=0, return_index=True)[1]
    rows = order[np.sort(first)[:_BEAM]]
    return q[rows], rows
