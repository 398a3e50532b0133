"""The collision checkers of each arm, made when they are first needed, and what a caller lets touch or wants kept."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np

from armctl.core.errors import InputError, ModelError, UnknownNameError
from armctl.core.region import Region, RegionPart
from armctl.core.validation import Array, flag, number, shown
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.model.collision.checker import CollisionChecker, allowed_geoms
from armctl.model.collision.kept_region import KeptRegion
from armctl.model.collision.moving_joints import MovingJoints
from armctl.model.collision.world_snapshot import WorldLike, read_world


def read_pairs(allow: object) -> tuple[tuple[str, str], ...]:
    """What a caller allows to touch, as a tuple; the pairs themselves are checked where they are used."""
    try:
        return tuple(allow)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"allow: expected pairs of names, got {shown(allow)}") from None


KEEP_WITHIN_RAD = 0.1
_MIN_KEEP_WITHIN_RAD = 1e-3
_MAX_KEEP_WITHIN_RAD = 0.5 * np.pi
_MIN_THICKNESS = 1e-4  # m or rad, of a region: a proof of a line in a thinner one has too many intervals


def read_kept_region(arm: Arm, keep: str | Region | None, keep_within: float, q: Array) -> KeptRegion | None:
    """What the tip keeps: "x", "y" or "z", an axis with its direction at q (n,) within an angle, or a Region; None for None."""
    within = number("keep_within", keep_within, _MIN_KEEP_WITHIN_RAD, _MAX_KEEP_WITHIN_RAD)
    if keep is None:
        return None
    if isinstance(keep, Region):
        if within != KEEP_WITHIN_RAD:
            raise InputError("keep_within: it belongs to keep='z'; a region has bounds or a cone of its own")
        return KeptRegion(arm=arm, part=_checked_part(arm, keep), q=q)
    if not isinstance(keep, str):
        raise UnknownNameError.from_known("axis to keep", shown(keep), ["x", "y", "z"])
    if keep not in ("x", "y", "z"):
        raise UnknownNameError.from_known("axis to keep", f"{keep:.80}", ["x", "y", "z"])
    upright = Region.upright(arm.fk(q), keep, cone=within)
    return KeptRegion(arm=arm, part=upright.parts[0], q=q, axis=keep)


def _checked_part(arm: Arm, region: Region) -> RegionPart:
    """The part of a region in which a tip can stay during a motion. InputError if there is none."""
    check_one_tip(arm)
    if len(region) > 1:
        raise InputError(
            f"keep: the region is a union of {len(region)} parts; the tip can stay in one part only, give region[0]"
        )
    (part,) = region.parts
    if part.free is not None and part.cone < _MIN_KEEP_WITHIN_RAD:
        raise InputError(f"keep: the cone of the region is {part.cone:g} rad; give at least {_MIN_KEEP_WITHIN_RAD:g} rad")
    widths = part.coordinate_bounds[:, 1] - part.coordinate_bounds[:, 0]
    for (name, unit), width in zip(part.coordinate_names, widths.tolist(), strict=True):
        if width < _MIN_THICKNESS:
            raise InputError(
                f"keep: the region is {width:g} {unit} thick in {name}, and no motion of joints stays in it; "
                f"give bounds at least {_MIN_THICKNESS:g} {unit} apart"
            )
    return part


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
