"""Recognition of the arms that have a closed form, from the axes of their joints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array, frozen

# Sine of an angle, or reaches. Models round: 0.5 mm and 0.5 mrad are no offset that somebody designed.
RECOGNITION_TOLERANCE = 5e-4
EXACT_TOLERANCE = 1e-9  # up to this deviation the closed form is that of the chain itself, and not of one like it
MIN_DEXTERITY = 1e-6  # mean smallest singular value of the Jacobian in reaches: below it, the arm is singular everywhere
DEXTERITY_SAMPLES = 16

# The kernels compile the following numbers in: after a change, empty numba's cache.
# How axes are related:
NEITHER = 0
MEET = 1
PARALLEL = 2
# A form (n + 2, FORM_COLUMNS) describes a chain of n hinges in the zero configuration, lengths in reaches. A row per joint: the
# direction of its axis 0-2, a point on it 3-5, the joint's bounds. Then a row for the tip: rotation 0-8, translation 9-11. Then
# a row for the structure.
FORM_COLUMNS = 14
POINT = 3
LOW = 12
HIGH = 13
# The structure's columns:
KIND = 0  # of the three special axes: MEET or PARALLEL
FIRST = 1  # the first of them, among the six joints
PAIR_KIND = 2  # of two neighbours among the other three axes: MEET, PARALLEL or NEITHER
PAIR_FIRST = 3  # 0 if these are the first two of the three, 1 if the last two
HELD = 4  # the joint that is swept; -1 if there are six

SIGNS = ("0", "+", "-")


class Relation(NamedTuple):
    """How some axes are related: `kind` MEET, PARALLEL or NEITHER, the common point (3,), and the deviation from it."""

    kind: int
    point: Array
    deviation: float


class ClosedForm(NamedTuple):
    """A closed form of the inverse kinematics of a chain.

    Attributes:
        form: (n + 2, 14), as this module defines it.
        held: The joint that is swept, or -1.
        special: (3,) the joints whose axes meet or are parallel.
        others: (3,) the other joints, in the order of the loop.
        kind: MEET or PARALLEL.
        pair_kind: MEET, PARALLEL or NEITHER.
        pair_first: Which of the others begin the pair, 0 or 1.
        deviation: How far the axes are from meeting or being parallel, in reaches or sines.
        is_exact: Whether the closed form is that of the chain itself, up to rounding.
        branch_names: (28,) the name of each combination of the three signs, and None for an unknown branch.
    """

    form: Array
    held: int
    special: tuple[int, ...]
    others: tuple[int, ...]
    kind: int
    pair_kind: int
    pair_first: int
    deviation: float
    is_exact: bool
    branch_names: tuple[str | None, ...]


def axes_of(axes: Array, points: Array) -> Relation:
    """The relation of K lines with directions and points (K, 3)."""
    sines = np.linalg.norm(np.cross(axes[0], axes[1:]), axis=1)
    if sines.max() <= RECOGNITION_TOLERANCE:
        return Relation(PARALLEL, points[0], float(sines.max()))
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    values, vectors = np.linalg.eigh(projectors.sum(axis=0))
    if values[0] < RECOGNITION_TOLERANCE:
        return Relation(NEITHER, points[0], np.inf)
    right = np.einsum("kij,kj->i", projectors, points)
    point = vectors @ ((vectors.T @ right) / values)
    distance = float(np.linalg.norm(np.einsum("kij,kj->ki", projectors, point - points), axis=1).max())
    return Relation(MEET if distance <= RECOGNITION_TOLERANCE else NEITHER, point, distance)


def closed_form_of(axes: Array, points: Array, tip: Array, bounds: Array) -> ClosedForm | None:
    """The closed form of a chain of hinges, if it has one.

    Args:
        axes: (n, 3) the joints' axes in the zero configuration.
        points: (n, 3) a point on each, in reaches.
        tip: (12,) the tip's rotation row by row, and its translation in reaches.
        bounds: (n, 2) the joints' limits, rad.
    """
    n = len(axes)
    if n not in (6, 7):
        return None
    dexterity = _dexterity(axes, points, tip[9:])
    best: ClosedForm | None = None
    best_rank = (False, False, MIN_DEXTERITY)
    for held in [-1] if n == 6 else range(n):
        six = [k for k in range(n) if k != held]
        for first in range(4):
            special = six[first : first + 3]
            if special[2] - special[0] > 2:
                continue
            relation = axes_of(axes[special], points[special])
            if relation.kind == NEITHER:
                continue
            others = [six[(first + 3 + k) % 6] for k in range(3)]
            pair_first, pair = _best_pair(axes, points, others)
            deviation = max(relation.deviation, pair.deviation if pair.kind != NEITHER else 0.0)
            if pair.kind != NEITHER and relation.deviation <= EXACT_TOLERANCE < pair.deviation:
                pair = Relation(NEITHER, pair.point, 0.0)  # the quartic equation is exact
                deviation = relation.deviation
            rank = (deviation <= EXACT_TOLERANCE, pair.kind != NEITHER, dexterity[held])
            if rank[2] > MIN_DEXTERITY and rank > best_rank:
                best_rank = rank
                best = _closed_form(
                    axes, points, tip, bounds, held, first, special, others, relation, pair_first, pair, deviation
                )
    return best


def _best_pair(axes: Array, points: Array, others: list[int]) -> tuple[int, Relation]:
    """Which neighbours among the other three joints meet or are parallel, whatever the rest of the arm does."""
    pairs = []
    for k in range(2):
        joints = others[k : k + 2]
        if joints[1] == joints[0] + 1:
            pairs.append((k, axes_of(axes[joints], points[joints])))
    found = [pair for pair in pairs if pair[1].kind != NEITHER]
    return min(found, key=lambda pair: pair[1].deviation) if found else (0, Relation(NEITHER, np.zeros(3), 0.0))


def _closed_form(
    axes: Array,
    points: Array,
    tip: Array,
    bounds: Array,
    held: int,
    first: int,
    special: list[int],
    others: list[int],
    relation: Relation,
    pair_first: int,
    pair: Relation,
    deviation: float,
) -> ClosedForm:
    n = len(axes)
    form = np.zeros((n + 2, FORM_COLUMNS))
    form[:n, :3] = axes
    form[:n, POINT : POINT + 3] = points
    form[:n, LOW : HIGH + 1] = bounds
    form[n, :12] = tip
    if relation.kind == MEET:
        form[special, POINT : POINT + 3] = relation.point
    if pair.kind == MEET:
        form[others[pair_first : pair_first + 2], POINT : POINT + 3] = pair.point
    structure = form[n + 1]
    structure[KIND] = relation.kind
    structure[FIRST] = first
    structure[PAIR_KIND] = pair.kind
    structure[PAIR_FIRST] = pair_first
    structure[HELD] = held
    names = branch_names(relation.kind, first, pair.kind, pair_first)
    return ClosedForm(
        form=frozen(form),
        held=held,
        special=tuple(special),
        others=tuple(others),
        kind=relation.kind,
        pair_kind=pair.kind,
        pair_first=pair_first,
        deviation=deviation,
        is_exact=deviation <= EXACT_TOLERANCE,
        branch_names=names,
    )


def branch_names(kind: int, first: int, pair_kind: int, pair_first: int) -> tuple[str | None, ...]:
    """The name of each combination of signs that `armctl.ik.kernel.branch` gives, and None for an arm without them."""
    near_tip = first >= 2
    inner = "wrist" if near_tip else "shoulder"
    outer = "shoulder" if near_tip else "wrist"
    parts: tuple[str, ...]
    if kind == PARALLEL:
        parts = ("elbow", "arm", "") if pair_kind == NEITHER else ("elbow", inner, outer)
    elif pair_kind == NEITHER:
        parts = (inner, "arm", "")
    else:
        parts = (inner, "elbow", outer) if pair_kind == PARALLEL else (inner, outer, "elbow")
    places = [parts.index(part) for part in ("shoulder", "arm", "elbow", "wrist") if part in parts]
    names: list[str | None] = []
    for code in range(27):
        signs = (SIGNS[code // 9], SIGNS[code // 3 % 3], SIGNS[code % 3])
        names.append(" ".join(parts[place] + signs[place] for place in places))
    return (*names, None)


def _dexterity(axes: Array, points: Array, tip: Array) -> dict[int, float]:
    """The mean smallest singular value of the Jacobian, as it is (key -1) and without each of the joints."""
    n = len(axes)
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (DEXTERITY_SAMPLES, n))
    J = np.array([_jacobian(axes, points, tip, q) for q in angles])
    columns = {-1: list(range(n)), **{k: [j for j in range(n) if j != k] for k in range(n)}}
    regular = {k: kept for k, kept in columns.items() if len(kept) >= 6}
    return {k: float(np.linalg.svd(J[:, :, kept], compute_uv=False)[:, 5].mean()) for k, kept in regular.items()}


def _jacobian(axes: Array, points: Array, tip: Array, q: Array) -> Array:
    """(6, n) at q, from the axes in the zero configuration."""
    rotation = np.eye(3)
    translation = np.zeros(3)
    J = np.zeros((6, len(q)))
    arms = np.zeros((len(q), 3))
    for k, angle in enumerate(q):
        axis = rotation @ axes[k]
        point = rotation @ points[k] + translation
        J[3:, k] = axis
        arms[k] = point
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        translation = point + turn @ (translation - point)
        rotation = turn @ rotation
    end = rotation @ tip + translation
    J[:3] = np.cross(J[3:].T, end - arms).T
    return J
