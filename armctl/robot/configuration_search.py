"""A search for the configuration at which a figure of an arm is smallest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array

_FIRST_STEP = 0.2  # of the range of each joint, and at most of a turn
_DISTANCE_FROM_LIMITS = 0.01  # of the range: controllers that respect limits act differently there
_GROWTH = 1.5  # of the step after a success, and to the power of -1/4 after a failure: Rechenberg's rule of 1/5 of successes


def smallest_configuration(
    limits: Limits, score: Callable[[Array], float], starts: Sequence[Array], steps: int, rng: np.random.Generator
) -> Array:
    """The configuration with the smallest score that random steps find, without gradients.

    An evolution strategy of one parent and one child from each start (Rechenberg, Evolutionsstrategie, 1973).

    Args:
        limits: Of the configurations.
        score: A figure of a configuration (n,) rad; one that is not finite is no improvement.
        starts: Configurations, rad.
        steps: Evaluations per start, besides that of the start.
    """
    width = np.minimum(limits.q_max - limits.q_min, 2 * np.pi)
    low = limits.q_min + _DISTANCE_FROM_LIMITS * width
    high = limits.q_max - _DISTANCE_FROM_LIMITS * width
    best = starts[0]
    least = np.inf
    for start in starts:
        q = start
        value = score(q)
        step = _FIRST_STEP
        for _ in range(steps):
            child = np.clip(q + step * width * rng.standard_normal(len(q)), low, high)
            childs = score(child)
            if childs < value:
                q = child
                value = childs
                step *= _GROWTH
            else:
                step *= _GROWTH**-0.25
        if value < least:
            best = q
            least = value
    return best
