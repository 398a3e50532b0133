"""Two motions that overlap in time: the second begins before the first ends, and both are added up."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array
from armctl.motion.trajectory.piecewise import Pieces, locate, shifted

_MIN_PIECE_S = 1e-9  # a knot that comes sooner after another one is left out


def overlapped(first: Pieces, second: Pieces, overlap: float) -> Pieces:
    """q(t) = first(t) + second(t - begin) - c, where c is the configuration at which the first ends and the second starts.

    Both are at rest at c, so that the sum is continuous in position, velocity and acceleration.
    """
    end = float(first.knots[-1])
    begin = end - overlap
    total = begin + float(second.knots[-1])
    inner = np.unique(np.concatenate([[0.0, end], first.knots, begin + second.knots]))
    inner = inner[(inner >= 0.0) & (inner < total - _MIN_PIECE_S)]
    starts = inner[np.concatenate([[True], np.diff(inner) > _MIN_PIECE_S])]
    knots = np.append(starts, total)
    middle = 0.5 * (knots[1:] + knots[:-1])
    coefficients = np.zeros((len(starts), *first.coefficients.shape[1:]))
    is_first = middle < end
    is_second = middle > begin
    coefficients[is_first] += _at(first, middle[is_first], starts[is_first])
    coefficients[is_second] += _at(second, middle[is_second] - begin, starts[is_second] - begin)
    coefficients[is_first & is_second, 0] -= second.coefficients[0, 0]
    return Pieces(knots, coefficients)


def _at(motion: Pieces, inside: Array, starts: Array) -> Array:
    """The polynomials of the pieces that contain the times `inside`, as polynomials of the time since `starts`."""
    k = locate(motion.knots, inside)[1]
    return shifted(motion.coefficients[k], starts - motion.knots[k])
