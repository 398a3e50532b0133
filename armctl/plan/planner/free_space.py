"""FreeSpace: what a motion around obstacles keeps, and how it is proved."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from armctl._core import Hit
from armctl.core.validation import Array
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.clearance import PiecewiseTrajectory
from armctl.model.collision.kept_region import KeptRegion
from armctl.plan.ik.resting_joints import Mask

CLEARANCE_M = 2e-3
_MIN_CLEARANCE_M = 1e-5  # of a motion, where start and goal leave it: how fine a proof is follows from the clearance


class FreeSpace(NamedTuple):
    """What a motion must keep, and the checker that proves it."""

    checker: CollisionChecker  # what may not be touched
    clearance: float = CLEARANCE_M  # m, from everything
    keep: KeptRegion | None = None  # where the tip stays
    held: Mask | None = None  # (n,) joints that keep their positions; None for none

    def line_is_free(self, start: Array, end: Array) -> bool:
        """Whether a straight line between two configurations is proved."""
        return self.checker.line_hit(start, end, self.clearance, self.keep) is None

    def motion_hit(self, motion: PiecewiseTrajectory) -> Hit | None:
        """Where a motion is not known to keep it; None if it is proved."""
        return self.checker.motion_hit(motion.knots, motion.coefficients, self.clearance, self.keep)

    def least_distance(self, motion: PiecewiseTrajectory) -> float:
        """m, that a motion which touches nothing is proved to keep; infinite if nothing can touch."""
        if not len(self.checker.geometry.pairs):
            return math.inf
        return self.checker.closest_approach(motion.knots, motion.coefficients, 0.0).bound


def spaces_between(space: FreeSpace, ends: Sequence[Array]) -> Iterator[tuple[FreeSpace, FreeSpace]]:
    """The spaces of a path and of the smooth motion along it, between ends that may be nearer to something than the clearance.

    In the first ones, only those pairs come nearer that are so at an end, which leaves half of their distance there; in the
    last ones all pairs may.
    """
    checker = space.checker
    distance = min(checker.nearest(q)[1] for q in ends)
    least = min(space.clearance, 0.5 * distance)
    least_of_motion = max(0.5 * least, min(_MIN_CLEARANCE_M, 0.5 * distance))
    if least < space.clearance:
        clearances = np.full(len(checker.geometry.pairs), space.clearance)
        for q in ends:
            near = checker.near(q, np.zeros(len(q)), 1.0, np.full(len(clearances), 2.0 * space.clearance))
            clearances[near.pairs] = np.minimum(clearances[near.pairs], 0.5 * near.distances)
        clearances = np.maximum(clearances, least)
        of_motion = np.maximum(0.5 * clearances, least_of_motion)
        yield (
            space._replace(checker=checker.with_clearances(clearances - least), clearance=least),
            space._replace(checker=checker.with_clearances(of_motion - least_of_motion), clearance=least_of_motion),
        )
    yield space._replace(clearance=least), space._replace(clearance=least_of_motion)
