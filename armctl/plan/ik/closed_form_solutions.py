"""Solutions of a closed form, found and refined by the compiled core."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.plan.ik.closed_form_recognition import ClosedForm
from armctl.plan.ik.problem import IkChain

_ONE_POSITION = np.zeros(1)  # of a sweep that six joints do not need
MIN_SAMPLES = 16  # of a sweep
MAX_SEEDS_PER_SAMPLE = 8
MIN_EMPTY_SAMPLES = 256  # of a sweep that finds nothing
SAMPLES_PER_SOLUTION = 4  # of a sweep
FIRST_SAMPLES = 64  # of a sweep that ends at the first solution
# How far outside the limits a solution of the closed form may be before it is refined: at a double root, slack in a cosine
# moves a joint by its square root.
SINGULAR_MARGIN = 0.03  # rad
INEXACT_MARGIN = 0.2  # rad, if the axes are only almost special
DEVIATION_FACTOR = 10.0  # slack in cosines for each unit by which the axes deviate


class Solutions(NamedTuple):
    """Distinct solutions inside the limits, the nearest to q0 first."""

    q: Array  # (N, n) rad
    position_errors: Array  # (N,) m
    orientation_errors: Array  # (N,) rad
    branches: IntArray  # (N,) the core's numbers of the branches
    starts: int  # how many configurations were begun with
    steps: int  # solver steps
    is_complete: bool  # whether there is proved to be no other

    def select(self, rows: IntArray) -> Solutions:
        """Those with the numbers (K,)."""
        return self._replace(
            q=self.q[rows],
            position_errors=self.position_errors[rows],
            orientation_errors=self.orientation_errors[rows],
            branches=self.branches[rows],
        )


def closed_form_solutions(
    chain: IkChain,
    closed_form: ClosedForm,
    target: Array,
    q0: Array,
    position_tolerance: float,
    orientation_tolerance: float,
    limit: int,
) -> Solutions:
    """The solutions for a target (4, 3) of an arm with a closed form, refined; of seven joints a sample."""
    slack = position_tolerance / chain.reach + orientation_tolerance
    margin = SINGULAR_MARGIN
    if not closed_form.is_exact:
        slack += DEVIATION_FACTOR * closed_form.deviation
        margin = INEXACT_MARGIN
    min_samples = 1
    positions = _ONE_POSITION
    room = MAX_SEEDS_PER_SAMPLE
    if closed_form.held is not None:
        min_samples = MIN_SAMPLES
        positions = _swept(chain, closed_form.held, q0, max(MIN_EMPTY_SAMPLES, SAMPLES_PER_SOLUTION * limit))
        room = limit + MAX_SEEDS_PER_SAMPLE * MIN_SAMPLES
    # The core fills as many rows as there are solutions.
    rows = (np.empty((room, len(chain.unit))), np.empty(room), np.empty(room), np.empty(room, np.int64))
    assert chain.closed_form_core is not None
    found = chain.closed_form_core.solve_all(
        target, q0, position_tolerance, orientation_tolerance, slack, margin, positions, min_samples, limit, *rows
    )
    count = found.count
    q, position_errors, orientation_errors, branches = rows
    is_complete = not found.lost and not found.doubtful and closed_form.is_exact and closed_form.held is None
    return Solutions(
        q[:count],
        position_errors[:count],
        orientation_errors[:count],
        branches[:count],
        found.samples,
        found.steps,
        is_complete,
    )


def first_solutions(chain: IkChain, closed_form: ClosedForm, targets: Array, q0: Array, q: Array) -> BoolArray:
    """Fills q (N, n) with one solution for each of the targets (N, 12) that has any inside the limits; returns which have.

    They are exact as far as the closed form is, and near q0 (n,) where possible.
    """
    found = np.empty(len(targets), np.int64)
    margin = 0.0 if closed_form.is_exact else INEXACT_MARGIN
    slack = 0.0 if closed_form.is_exact else DEVIATION_FACTOR * closed_form.deviation
    positions = _ONE_POSITION if closed_form.held is None else _swept(chain, closed_form.held, q0, FIRST_SAMPLES)
    assert chain.closed_form_core is not None
    chain.closed_form_core.find_first(targets, q0, slack, margin, positions, q, found)
    return found == 1


def _swept(chain: IkChain, joint: int, q0: Array, count: int) -> Array:
    """(count,) positions of a joint: that of q0 first, then inside its bounds, or inside one turn if they are wider."""
    low = chain.low[joint]
    high = chain.high[joint]
    span = high - low
    if not span <= 2 * np.pi:  # also if the joint has no bounds
        low = max(low, min(q0[joint] - np.pi, high - 2 * np.pi))
        span = 2 * np.pi
    positions = low + span * _van_der_corput(count)
    positions[0] = q0[joint]
    return positions


@lru_cache(maxsize=8)
def _van_der_corput(count: int) -> Array:
    """The sequence in base 2, in [0, 1): any beginning of it is spread evenly."""
    k = np.arange(count)
    value = np.zeros(count)
    for bit in range(count.bit_length()):
        value += ((k >> bit) & 1) * 0.5 ** (bit + 1)
    return frozen(value)
