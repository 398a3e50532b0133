"""Refusal: why a motion may not be made: which bodies would touch, when, and how near they come."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armctl._core import Hit
from armctl.core.validation import Array
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.motion.trajectory.piecewise import Pieces, sample

# s into the motion, when the reason of a refusal occurs that no proof found.
UNKNOWN_TIME_S = math.inf


_TIME_RESOLUTION_S = 1e-3  # of the time of a contact
_HALVINGS = 20


class Refusal(NamedTuple):
    """Why a motion may not be made."""

    what: str  # without the time, such as "hand would touch wall", for what is shown many times a second
    bodies: tuple[str, ...] = ()  # the two that would touch; none if something else is in the way
    time: float = UNKNOWN_TIME_S  # s into the motion
    distance: float = math.nan  # m between the bodies then: what is left of the clearance, zero or less if they overlap

    @property
    def reason(self) -> str:
        """One sentence, with the time if it is known."""
        return f"{self.what} at {self.time:.3f} s" if math.isfinite(self.time) else self.what


def quick_refusal(checker: CollisionChecker | None, pieces: Pieces, clearance: float) -> Refusal | None:
    """As `contact_refusal`, of any place where the motion comes too near, for what is planned many times a second."""
    hit = _hit(checker, pieces, clearance)
    return None if checker is None or hit is None else Refusal(checker.refusal(hit), time=hit.time)


def _hit(checker: CollisionChecker | None, pieces: Pieces, clearance: float) -> Hit | None:
    """Any place where a motion is not proved to keep more than a clearance, m; None if it is proved, or nothing has to be."""
    if checker is None or pieces.knots[-1] == 0.0:
        return None
    return checker.motion_hit(pieces.knots, pieces.coefficients, clearance)


def contact_refusal(checker: CollisionChecker | None, pieces: Pieces, clearance: float) -> Refusal | None:
    """Why a motion is not proved to keep more than a clearance, m, at all times; None if it is, or nothing has to be proved.

    This is the refusal of everything that is sent to motors: of gates, streams, robots, and of the page.
    """
    hit = _hit(checker, pieces, clearance)
    if checker is None or hit is None:
        return None
    hit = _first(checker, pieces, clearance, hit)
    if checker.opens(hit):
        return Refusal(checker.refusal(hit), time=hit.time)
    q = sample(pieces, np.array([hit.time])).q[0]
    return Refusal(checker.refusal(hit), checker.names(hit.pair), hit.time, checker.distance(q, hit.pair))


def _first(checker: CollisionChecker, pieces: Pieces, clearance: float, hit: Hit) -> Hit:
    """Where a motion first comes too near: a proof stops at any place where it does, often in the middle of a contact."""
    proved = 0.0
    for _ in range(_HALVINGS):
        if hit.time - proved < _TIME_RESOLUTION_S:
            break
        middle = 0.5 * (proved + hit.time)
        count = int(np.searchsorted(pieces.knots, middle, side="left"))
        earlier = checker.motion_hit(np.append(pieces.knots[:count], middle), pieces.coefficients[:count], clearance)
        if earlier is None:
            proved = middle
        else:
            hit = earlier
    return hit


def rest_refusal(checker: CollisionChecker, q: Array, clearance: float) -> Refusal | None:
    """Why an arm may not rest at q (n,) rad: what is not farther apart there than a clearance, m; None if it may."""
    pair = checker.hit(q, clearance)
    if pair < 0:
        return None
    distance = checker.distance(q, pair)
    first, second = checker.names(pair)
    verb = "touches" if distance <= 0.0 else f"is within {1e3 * clearance:.3g} mm of"
    return Refusal(f"{second} {verb} {first}", (first, second), 0.0, distance)
