"""The collision checkers of each arm, made when they are first needed."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.core.validation import Array, flag, shown
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker, allowed_geoms
from armctl.model.collision.moving_joints import MovingJoints
from armctl.model.collision.world_snapshot import WorldLike, read_world


def read_pairs(allow: object) -> tuple[tuple[str, str], ...]:
    """What a caller allows to touch, as a tuple; the pairs themselves are checked where they are used."""
    try:
        return tuple(allow)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"allow: expected pairs of names, got {shown(allow)}") from None


# The checkers that were used last, of each arm. One of them takes about 0.5 MB.
_KEPT_CHECKERS = 8
_checkers: WeakKeyDictionary[MovingJoints, OrderedDict[tuple[object, ...], CollisionChecker]] = WeakKeyDictionary()
_lock = Lock()


def collision_checker(
    arm: MovingJoints,
    qpos: Array | None = None,
    allow: Iterable[tuple[str, str]] = (),
    held: Mapping[int, int] | None = None,
    world: WorldLike | None = None,
) -> CollisionChecker:
    """As `CollisionChecker(...)`, in a world; those of an arm that were used last are kept with it.

    A pair in `allow` may name bodies of the world.
    """
    allow = read_pairs(allow)
    snapshot = None if world is None else read_world(world)
    if snapshot is None:
        return _own_checker(arm, qpos, allow, held)
    if not isinstance(arm, Arm):
        raise InputError("world: only a single arm has a world")
    carried = {**(held or {}), **snapshot.carried_bodies(arm)}
    own_pairs, snapshot = snapshot.allowing(allow)
    return _own_checker(arm, qpos, own_pairs, carried).with_world(arm, snapshot)


def _own_checker(
    arm: MovingJoints, qpos: Array | None, allow: Iterable[tuple[str, str]], held: Mapping[int, int] | None
) -> CollisionChecker:
    """A checker of what the arm's model has."""
    allow = read_pairs(allow)
    carried = dict(held or {})
    where = b"" if qpos is None else np.array(qpos).tobytes()
    key = (where, frozenset(allowed_geoms(arm.model, allow)), tuple(sorted(carried.items())))
    with _lock:
        kept = _checkers.setdefault(arm, OrderedDict())
        if key not in kept:
            kept[key] = CollisionChecker(arm, qpos, allow, carried)
        kept.move_to_end(key)
        while len(kept) > _KEPT_CHECKERS:
            kept.popitem(last=False)
        return kept[key]


def avoided(arm: Arm, avoid: bool, world: WorldLike | None) -> Callable[[Array], str] | None:
    """What touches at a configuration (n,), one sentence, for searches that avoid contacts; None for others.

    InputError if there is a world that the search would not look at.
    """
    if flag("avoid", avoid):
        return checkable(arm, world).at
    if world is not None:
        raise InputError("world: it is only looked at with avoid=True; give that as well, or leave the world out")
    return None


def checkable(arm: MovingJoints, world: WorldLike | None = None) -> CollisionChecker:
    """The checker of an arm at home; ModelError if a link has no collision shape, so that "no contact" would mean nothing."""
    checker = collision_checker(arm, world=world)
    if checker.not_checkable:
        raise ModelError(checker.not_checkable)
    return checker
