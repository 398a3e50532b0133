"""The collision checker of each arm, made when it is first needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from armctl.collision.interface import KeptAxis, MovingJoints
from armctl.core.errors import InputError, UnknownNameError
from armctl.core.validation import Array, IntArray, number, shown
from armctl.mjmodel.queries import last_joint_above
from armctl.robot.arm import Arm

if TYPE_CHECKING:
    from armctl.collision.checker import CollisionChecker


def read_pairs(allow: object) -> tuple[tuple[str, str], ...]:
    """What a caller allows to touch, as a tuple; the pairs themselves are checked where they are used."""
    if not isinstance(allow, Iterable):
        raise InputError(f"allow: expected pairs of names, got {shown(allow)}")
    return tuple(allow)


KEEP_WITHIN_RAD = 0.1
_MIN_KEEP_WITHIN_RAD = 1e-3
_MAX_KEEP_WITHIN_RAD = 0.5 * np.pi


def read_kept_axis(arm: Arm, keep: str | None, keep_within: float, q: Array) -> KeptAxis | None:
    """The axis of the tip that keeps the direction it has at a configuration.

    Args:
        arm: The arm.
        keep: "x", "y" or "z"; None for none.
        keep_within: rad that it may tilt.
        q: (n,) rad.

    Returns:
        The axis, or None.

    Raises:
        InputError: `keep_within` is no number from 0.001 to pi / 2.
        UnknownNameError: There is no such axis.
    """
    within = number("keep_within", keep_within, _MIN_KEEP_WITHIN_RAD, _MAX_KEEP_WITHIN_RAD)
    if keep is None:
        return None
    if not isinstance(keep, str) or keep not in ("x", "y", "z"):
        raise UnknownNameError.of("axis to keep", f"{keep!s:.80}", ["x", "y", "z"])
    return KeptAxis(keep, arm.tip_body, q, arm.fk(q).rotation[:, "xyz".index(keep)], within)


def geom_owners(arm: Arm) -> IntArray:
    """Which joint of the chain moves each geom.

    Args:
        arm: The arm.

    Returns:
        (ngeom,) the last joint above it, counted from the base; -1 where none is.
    """
    return np.array(last_joint_above(arm.model, arm.joint_map.joints), np.int64)[arm.model.geom_bodyid]


_checkers: WeakKeyDictionary[MovingJoints, CollisionChecker] = WeakKeyDictionary()


def collision_checker(
    arm: MovingJoints,
    qpos: Array | None = None,
    allow: Iterable[tuple[str, str]] = (),
    held: Mapping[int, int] | None = None,
) -> CollisionChecker:
    """A checker of an arm in its scene; with everything at home and nothing allowed or held, it is made once for each arm.

    Args:
        arm: The arm, or several as one.
        qpos: As for `CollisionChecker`, like all that follow.
        allow: Pairs of names.
        held: Bodies that the arm carries.

    Returns:
        The checker.
    """
    from armctl.collision.checker import CollisionChecker  # loads numba

    allow = read_pairs(allow)
    if qpos is not None or allow or held:
        return CollisionChecker(arm, qpos, allow, held)
    checker = _checkers.get(arm)
    if checker is None:
        checker = CollisionChecker(arm)
        _checkers[arm] = checker
    return checker
