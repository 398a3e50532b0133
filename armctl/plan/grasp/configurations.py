"""Configurations: those of an arm for many poses of its tip, found when they are needed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array, IntArray
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.grasp.attempts import Failures
from armctl.plan.ik.solve_batch import solve_ik_batch

_CHUNK = 64  # poses that are solved at a time
_RANDOM_STARTS = 2
_MAX_LINES = 60  # poses of which lines are tried, from one start
_SAME_RAD = 1e-2  # rad (m), below which two starts have led to the same configuration
_TURN_COST = 0.05  # 1/rad, of the joints' way
# An arm of fewer joints cannot reach a pose exactly, such as that of a body which is tilted in the gripper by a milliradian.
_JOINTS_FOR_ANY_POSE = 6
_EXACT = (1e-5, 1e-4)  # m, rad
_LOOSE = (1e-3, 2e-2)  # m, rad


class Reached(NamedTuple):
    """A pose of the tip with a configuration for it."""

    row: int  # of the pose
    tip: Pose  # T_world_tip, within the tolerance of the pose
    q: Array  # (n,) rad


class _Solved(NamedTuple):
    rows: IntArray  # of the poses that have a configuration
    q: Array  # (k, n) rad


class Configurations:
    """The configurations of an arm for many poses, looked for from where it is, from home, and from random ones."""

    def __init__(self, arm: Arm, tips: Array, costs: Array, q_start: Array):
        """For poses of the tip (N, 4, 4) in the order of their costs (N,)."""
        self._arm = arm
        self._tips = tips
        self._costs = costs
        self._q_start = q_start
        random = arm.limits.random(arm.home, _RANDOM_STARTS, np.random.default_rng(0))
        self._starts = [q_start, arm.home, *random]
        self._solved: dict[tuple[int, int], _Solved] = {}

    def free(self, checker: CollisionChecker, failures: Failures) -> Iterator[Reached]:
        """Configurations in which nothing touches, those with the least cost of some first.

        Sets `failures.pose`, and notes there what is out of reach or in contact.
        """
        tried: dict[int, list[Array]] = {}
        for start in range(len(self._starts)):
            chunks = (self._free_of_chunk(start, first, checker, failures) for first in range(0, len(self._tips), _CHUNK))
            for reached in itertools.islice(itertools.chain.from_iterable(chunks), _MAX_LINES):
                known = tried.setdefault(reached.row, [])
                if any(np.abs(reached.q - q).max() < _SAME_RAD for q in known):
                    continue
                known.append(reached.q)
                failures.pose = reached.row
                yield reached

    def _free_of_chunk(self, start: int, first: int, checker: CollisionChecker, failures: Failures) -> Iterator[Reached]:
        solved = self._chunk(start, first)
        free: list[tuple[float, int, Array]] = []
        failures.add_unreached(set(range(first, min(first + _CHUNK, len(self._tips)))) - set(solved.rows.tolist()))
        for row, q in zip(solved.rows.tolist(), solved.q, strict=True):
            hit = checker.hit(q)
            if hit >= 0:
                failures.add_contact(checker, hit, row)
            else:
                turn = float(np.abs(q - self._q_start).max())
                free.append((float(self._costs[row]) + _TURN_COST * turn, row, q))
        for _, row, q in sorted(free, key=lambda each: each[:2]):
            yield Reached(row, self._arm.fk(q), q)

    def _chunk(self, start: int, first: int) -> _Solved:
        """The configurations for some poses; from other starts than the first one only for those that have any."""
        if (start, first) in self._solved:
            return self._solved[start, first]
        rows = np.arange(first, min(first + _CHUNK, len(self._tips))) if start == 0 else self._chunk(0, first).rows
        solved = _Solved(rows, np.zeros((0, self._arm.n)))
        if len(rows):
            position, orientation = _EXACT if self._arm.n >= _JOINTS_FOR_ANY_POSE else _LOOSE
            found = solve_ik_batch(
                self._arm,
                self._tips[rows],
                self._starts[start],
                1,
                position_tolerance=position,
                orientation_tolerance=orientation,
            )
            solved = _Solved(rows[found.ok], found.q[found.ok])
        self._solved[start, first] = solved
        return solved
