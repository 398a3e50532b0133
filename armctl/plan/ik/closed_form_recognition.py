"""Recognition of the arms that have a closed form, from the axes of their joints."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from armctl._core import AxesRelation
from armctl.core.validation import Array, frozen

# Sine of an angle, or reaches. Models round: 0.5 mm and 0.5 mrad are no offset that somebody designed.
RECOGNITION_TOLERANCE = 5e-4
EXACT_TOLERANCE = 1e-9  # up to this deviation the closed form is that of the chain itself, and not of one like it
MIN_DEXTERITY = 1e-6  # mean smallest singular value of the Jacobian in reaches: below it, the arm is singular everywhere
DEXTERITY_SAMPLES = 16

SIGNS = ("0", "+", "-")


class Relation(NamedTuple):
    """How some axes are related, the common point (3,), and the deviation from it."""

    kind: AxesRelation
    point: Array
    deviation: float


class ClosedForm(NamedTuple):
    """A closed form of the inverse kinematics of a chain."""

    # (n, 3) a point on each axis in the zero configuration, in reaches: where special axes meet it is the common one
    points: Array
    held: int | None  # the joint that is swept, or None
    special: tuple[int, ...]  # (3,) the joints whose axes meet or are parallel
    others: tuple[int, ...]  # (3,) the other joints, in the order of the loop
    kind: AxesRelation  # of the special axes: MEET or PARALLEL
    pair_kind: AxesRelation  # of two neighbours among the others
    pair_first: int  # which of the others begin the pair, 0 or 1
    deviation: float  # how far the axes are from meeting or being parallel, in reaches or sines
    is_exact: bool  # whether the closed form is that of the chain itself, up to rounding
    # (28,) the name of each combination of the three signs, and None for an unknown branch
    branch_names: tuple[str | None, ...]


class Hinges(NamedTuple):
    """A chain of hinges in one configuration, lengths in reaches."""

    axes: Array  # (n, 3) the joints' axes
    points: Array  # (n, 3) a point on each
    tip_rotation: Array  # (3, 3)
    tip_translation: Array  # (3,)


def axes_of(axes: Array, points: Array) -> Relation | None:
    """The relation of K lines with directions and points (K, 3); None if they neither meet nor are parallel."""
    sines = np.linalg.norm(np.cross(axes[0], axes[1:]), axis=1)
    if sines.max() <= RECOGNITION_TOLERANCE:
        return Relation(AxesRelation.PARALLEL, points[0], float(sines.max()))
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    values, vectors = np.linalg.eigh(projectors.sum(axis=0))
    if values[0] < RECOGNITION_TOLERANCE:
        return None
    right = np.einsum("kij,kj->i", projectors, points)
    point = vectors @ ((vectors.T @ right) / values)
    distance = float(np.linalg.norm(np.einsum("kij,kj->ki", projectors, point - points), axis=1).max())
    return Relation(AxesRelation.MEET, point, distance) if distance <= RECOGNITION_TOLERANCE else None


def closed_form_of(hinges: Hinges, jacobian: Callable[[Array], Array]) -> ClosedForm | None:
    """The closed form of a chain of hinges, if it has one; `jacobian` is that (6, n) of its tip at q (n,), in reaches."""
    n = len(hinges.axes)
    if n not in (6, 7):
        return None
    axes = hinges.axes
    points = hinges.points
    dexterity = _dexterity(jacobian, n)
    best: ClosedForm | None = None
    best_rank = (False, MIN_DEXTERITY)
    for held in [None] if n == 6 else range(n):
        six = [k for k in range(n) if k != held]
        for first in range(4):
            special = six[first : first + 3]
            relation = axes_of(axes[special], points[special]) if special[2] - special[0] == 2 else None
            others = [six[(first + 3 + k) % 6] for k in range(3)]
            pair_first, pair = _best_pair(axes, points, others)
            if relation is None or pair is None:
                continue
            deviation = max(relation.deviation, pair.deviation)
            rank = (deviation <= EXACT_TOLERANCE, dexterity[held])
            if rank[1] > MIN_DEXTERITY and rank > best_rank:
                best_rank = rank
                common = points.copy()
                if relation.kind == AxesRelation.MEET:
                    common[special] = relation.point
                if pair.kind == AxesRelation.MEET:
                    common[others[pair_first : pair_first + 2]] = pair.point
                best = ClosedForm(
                    points=frozen(common),
                    held=held,
                    special=tuple(special),
                    others=tuple(others),
                    kind=relation.kind,
                    pair_kind=pair.kind,
                    pair_first=pair_first,
                    deviation=deviation,
                    is_exact=deviation <= EXACT_TOLERANCE,
                    branch_names=branch_names(relation.kind, first, pair.kind, pair_first),
                )
    return best


def _best_pair(axes: Array, points: Array, others: list[int]) -> tuple[int, Relation | None]:
    """Which neighbours among the other three joints meet or are parallel, whatever the rest of the arm does."""
    found = []
    for k in range(2):
        joints = others[k : k + 2]
        pair = axes_of(axes[joints], points[joints]) if joints[1] == joints[0] + 1 else None
        if pair is not None:
            found.append((k, pair))
    return min(found, key=lambda each: each[1].deviation, default=(0, None))


def branch_names(kind: AxesRelation, first: int, pair_kind: AxesRelation, pair_first: int) -> tuple[str | None, ...]:
    """The name of each combination of signs that the core gives as a number, and None for an arm without them."""
    near_tip = first >= 2
    inner = "wrist" if near_tip else "shoulder"
    outer = "shoulder" if near_tip else "wrist"
    if kind == AxesRelation.PARALLEL:
        parts = ("elbow", inner, outer)
    else:
        parts = (inner, "elbow", outer) if pair_kind == AxesRelation.PARALLEL else (inner, outer, "elbow")
    places = [parts.index(part) for part in ("shoulder", "elbow", "wrist")]
    names: list[str | None] = []
    for code in range(27):
        signs = (SIGNS[code // 9], SIGNS[code // 3 % 3], SIGNS[code % 3])
        names.append(" ".join(parts[place] + signs[place] for place in places))
    return (*names, None)


def _dexterity(jacobian: Callable[[Array], Array], n: int) -> dict[int | None, float]:
    """The mean smallest singular value of the Jacobian, as it is (key None) and without each of the joints."""
    J = np.array([jacobian(q) for q in np.random.default_rng(0).uniform(-np.pi, np.pi, (DEXTERITY_SAMPLES, n))])
    columns: dict[int | None, list[int]] = {None: list(range(n)), **{k: [j for j in range(n) if j != k] for k in range(n)}}
    regular = {k: kept for k, kept in columns.items() if len(kept) >= 6}
    return {k: float(np.linalg.svd(J[:, :, kept], compute_uv=False)[:, 5].mean()) for k, kept in regular.items()}
