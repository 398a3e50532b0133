"""What an arm could touch in a simulation, where everything is at this moment."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker, read_pairs
from armctl.model.collision.world import World
from armctl.model.collision.world_snapshot import WorldSnapshot, read_world
from armctl.model.mjmodel.queries import acts, body_name, is_loose, name_of

_KEPT_CHECKERS = 4  # of the last scenes: building one takes longer than planning in it
_SAME_M = 1e-6  # rad, m: a smaller displacement is no new scene
_NOTICED_M = 5e-4  # rad, m: a larger displacement is a new scene for `recent_checker`
_TOUCHED_S = 1.0
_NOTHING: Mapping[str, int] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Carried:
    """A body that was picked."""

    name: str
    is_of_model: bool  # and not of the world around the arm
    upright: Array  # (3, 3) how it stood before
    loaded: Arm  # the arm with it as a payload


class Obstacles:
    """Collision checkers of an arm among loose bodies, fingers and other arms, where a simulation has them now."""

    def __init__(self, arm: Arm, data: mujoco.MjData, allow: Iterable[tuple[str, str]] = ()):
        """What there is in a simulation's state; pairs of names of bodies or geoms in `allow` may touch in `recent_checker`."""
        self.world: World | None = None  # what is seen besides, once somebody asks for it
        self._arm = arm
        self._data = data
        self._allow = tuple(allow)
        self._links = [body_name(arm.model, body) for body in range(1, arm.model.nbody) if _is_link(arm, body)]
        self._loose = [body for body in range(1, arm.model.nbody) if is_loose(arm.model, body)]
        self._touched_at: dict[str, float] = {}  # s, when the arm touched loose bodies last
        self._is_own = np.zeros(arm.model.nq, bool)
        self._is_own[arm.joint_map.qpos_adr] = True
        self._checkers: OrderedDict[tuple[object, ...], CollisionChecker] = OrderedDict()
        self._recent: _Recent | None = None

    def recent_checker(self, held: Mapping[str, int] = _NOTHING) -> CollisionChecker:
        """A checker of the scene up to displacements of half a millimeter. Building a new one takes tens of milliseconds.

        A loose body that touches the arm, or did so a second ago, may do so, because the arm pushes it or carries it.
        """
        outside = self._data.qpos[~self._is_own]
        recent = self._recent
        snapshot = None if self.world is None else read_world(self.world)
        carried = self._carried(snapshot, held)
        touched = self._touched_loose()
        is_same = recent is not None and (recent.held, recent.touched) == (carried, touched)
        if recent is None or not is_same or np.abs(outside - recent.outside).max(initial=0.0) > _NOTICED_M:
            pairs = ((link, body) for body in touched for link in self._links)
            recent = _Recent(self._own_checker((*self._allow, *pairs), carried), outside, carried, touched)
            self._recent = recent
        return recent.checker if snapshot is None else recent.checker.with_world(self._arm, snapshot)

    def checker(self, allow: Iterable[tuple[str, str]] = (), held: Mapping[str, int] = _NOTHING) -> CollisionChecker:
        """A checker of the scene as it is, in which pairs of names of bodies or geoms may touch.

        A held body moves with a tip's body, whose number is its value in `held`, and may keep the contacts it has now, such as
        with the table it was picked from.
        """
        snapshot = None if self.world is None else read_world(self.world)
        pairs = read_pairs(allow)
        if snapshot is None:
            return self._own_checker(pairs, held)
        own_pairs, snapshot = snapshot.allowing(pairs)
        return self._own_checker(own_pairs, self._carried(snapshot, held)).with_world(self._arm, snapshot)

    def qpos(self) -> Array:
        """(nq,) where everything is now, with the arm inside its limits."""
        return self._at(np.array(self._data.qpos))

    def _touched_loose(self) -> tuple[str, ...]:
        """The loose bodies that the arm touches, or has touched a moment ago: they may bounce."""
        model = self._arm.model
        now = self._data.time
        if self._loose and self._data.ncon:
            pairs = model.geom_bodyid[self._data.contact.geom[self._data.contact.exclude == 0]]
            touched = {body for body in self._loose for a, b in pairs if body in (a, b) and _is_link(self._arm, a + b - body)}
            self._touched_at.update({body_name(model, body): now for body in touched})
        return tuple(sorted(name for name, at in self._touched_at.items() if 0.0 <= now - at < _TOUCHED_S))

    def _carried(self, snapshot: WorldSnapshot | None, held: Mapping[str, int]) -> dict[str, int]:
        """What is held, and the bodies of the model that are attached to a tip, by the number of the body that carries each."""
        attached = {} if snapshot is None else snapshot.carried_bodies(self._arm)
        return {**held, **{self._arm.model.body(body).name: carrier for body, carrier in attached.items()}}

    def _own_checker(self, allow: Iterable[tuple[str, str]], held: Mapping[str, int]) -> CollisionChecker:
        """A checker of what the model has."""
        kept = [pair for body in held for pair in touched_by(self._arm.model, self._data, body)]
        allowed = [*allow, *kept]
        qpos = np.array(self._data.qpos)
        outside = qpos[~self._is_own]
        is_home = not held and np.abs(outside - self._arm.home_qpos[~self._is_own]).max(initial=0.0) < _SAME_M
        if is_home and not allowed:
            return collision_checker(self._arm)
        key = (repr(allowed), tuple(held.items()), np.round(outside / _SAME_M).tobytes(), qpos.tobytes() if held else b"")
        if key not in self._checkers:
            carried = {self._arm.model.body(body).id: tip_body for body, tip_body in held.items()}
            self._checkers[key] = collision_checker(self._arm, self._at(qpos), allowed, carried)
            while len(self._checkers) > _KEPT_CHECKERS:
                self._checkers.popitem(last=False)
        self._checkers.move_to_end(key)
        return self._checkers[key]

    def _at(self, qpos: Array) -> Array:
        """The configuration with the arm inside its limits, where it may have sagged."""
        own = self._arm.limits.clamp(qpos[self._arm.qpos_adr])
        qpos[self._arm.joint_map.qpos_adr] = self._arm.joint_map.positions(own)
        return qpos


class _Recent(NamedTuple):
    checker: CollisionChecker  # of what the model has
    outside: Array
    held: dict[str, int]
    touched: tuple[str, ...]  # loose bodies


def touched_at_home(arm: Arm) -> tuple[tuple[str, str], ...]:
    """What links of an arm touch at home, such as the ground under feet, as pairs of names of geoms."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, data)
    pairs = {tuple(map(int, contact.geom)) for contact in filter(acts, data.contact)}
    bodies = arm.model.geom_bodyid
    own = [pair for pair in sorted(pairs) if any(_is_link(arm, int(bodies[geom])) for geom in pair)]
    names = [[name_of(arm.model, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in pair] for pair in own]
    return tuple((first, second) for first, second in names)


def _is_link(arm: Arm, body: int) -> bool:
    """Whether an arm moves a body."""
    return int(arm.model.body_weldid[body]) in arm.moved_bodies


def touched_by(model: mujoco.MjModel, data: mujoco.MjData, held: str) -> list[tuple[str, str]]:
    """What a held body touches now, as pairs of names that may touch."""
    body = model.body(held).id
    touched = set()
    for contact in filter(acts, data.contact):
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        if body in bodies:
            other = int(contact.geom[1 - bodies.index(body)])
            owner = int(model.geom_bodyid[other])
            touched.add((held, body_name(model, owner) if owner else model.geom(other).name))
    return sorted(pair for pair in touched if pair[1])
