"""WorldSnapshot: what is around a robot at one moment. Who plans or proves uses one snapshot from start to end."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, runtime_checkable
from weakref import WeakKeyDictionary

import mujoco

from armctl.core.errors import InputError, UnknownNameError, shown
from armctl.core.pose import Pose
from armctl.core.shapes import Shape
from armctl.model.arm.arm import Arm, with_model
from armctl.model.mjmodel.edit import add_payload
from armctl.model.mjmodel.queries import object_id
from armctl.model.mjmodel.shape_geoms import mass_distribution


@dataclass(frozen=True, eq=False)
class WorldBody:
    """A body of a world.

    Attributes:
        name: Its name.
        shape: Its shape; None for a body of the arm's model, which has shapes of its own.
        pose: T_world_body of a body that stands, T_tip_body of one that is attached.
        mass: kg; None where it is not known. Bodies with a mass are loose in MuJoCo, and payloads where they are attached.
        tip: The tip that carries it; None for a body that stands.
    """

    name: str
    shape: Shape | None
    pose: Pose
    mass: float | None = None
    tip: str | None = None


@dataclass(frozen=True, eq=False)
class WorldSnapshot:
    """What is around a robot at one moment; immutable.

    Attributes:
        version: Which change of its world was the last one; larger is newer.
        bodies: The bodies by their names.
        allowed: Pairs of names of bodies or geoms that may touch.
    """

    version: int
    bodies: Mapping[str, WorldBody]
    allowed: frozenset[tuple[str, str]] = frozenset()
    _derived: WeakKeyDictionary[object, object] = field(default_factory=WeakKeyDictionary, repr=False)

    @property
    def derived(self) -> WeakKeyDictionary[object, object]:
        """What was made of this snapshot, by what it was made for: checkers, and arms with payloads."""
        return self._derived

    def is_empty(self) -> bool:
        """Whether it changes nothing."""
        return not self.bodies and not self.allowed

    def allowing(self, pairs: Iterable[tuple[str, str]]) -> tuple[list[tuple[str, str]], WorldSnapshot]:
        """Divides pairs of names that may touch into those of the arm's model and those of this world.

        Args:
            pairs: Pairs of names of bodies or geoms.

        Returns:
            The pairs of which none is a body of the world, and the same snapshot, in which the other pairs may touch.
        """
        own: list[tuple[str, str]] = []
        further: set[tuple[str, str]] = set()
        for pair in pairs:
            is_pair = isinstance(pair, (tuple, list)) and len(pair) == 2 and all(isinstance(name, str) for name in pair)
            if is_pair and not self.bodies.keys().isdisjoint(pair):
                further.add((pair[0], pair[1]))
            else:
                own.append(pair)
        if further <= self.allowed:
            return own, self
        return own, WorldSnapshot(version=self.version, bodies=self.bodies, allowed=self.allowed | further)

    def carried_bodies(self, arm: Arm) -> dict[int, int]:
        """The attached bodies of the arm's model.

        Returns:
            The number of each in the model, with that of the body of the tip that carries it.
        """
        of_tip = {frame.name: frame.body for frame in arm.tip_frames}
        return {
            arm.model.body(body.name).id: of_tip[checked_tip(arm, body)]
            for body in self.bodies.values()
            if body.tip is not None and is_of_model(arm, body.name)
        }

    def loaded_arm(self, arm: Arm) -> Arm:
        """The arm with the masses of the attached bodies as payloads; the arm itself if there are none."""
        carried = [
            body
            for body in self.bodies.values()
            if body.tip is not None and body.mass is not None and not is_of_model(arm, body.name)
        ]
        if not carried:
            return arm
        known = self._derived.get(arm)
        if isinstance(known, Arm):
            return known
        frames = {frame.name: frame for frame in arm.tip_frames}
        model = arm.model
        for body in carried:
            frame = frames[checked_tip(arm, body)]
            model = _with_payload(model, frame.body, frame.T_body_tip, body)
        loaded = with_model(arm, model)
        self._derived[arm] = loaded
        return loaded


def _with_payload(model: mujoco.MjModel, tip_body: int, T_body_tip: Pose, body: WorldBody) -> mujoco.MjModel:
    """A copy of a model with a body at a tip."""
    model = copy.copy(model)
    assert body.shape is not None
    assert body.mass is not None
    solid = mass_distribution(body.shape, body.mass)
    R = body.pose.rotation
    center = R @ solid.center + body.pose.position
    add_payload(model, tip_body, T_body_tip, body.mass, center, R @ solid.inertia @ R.T)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@runtime_checkable
class HasSnapshot(Protocol):
    """A World: what has snapshots."""

    def snapshot(self) -> WorldSnapshot: ...


WorldLike: TypeAlias = HasSnapshot | WorldSnapshot


def read_world(world: WorldLike | None) -> WorldSnapshot | None:
    """The newest snapshot of a world; None for None, and for a world in which nothing is."""
    if world is None:
        return None
    if not isinstance(world, WorldSnapshot):
        if not isinstance(world, HasSnapshot):
            raise InputError(f"world: expected a World or a snapshot of one, got {shown(world)}; armctl.World() makes one")
        world = world.snapshot()
    return None if world.is_empty() else world


def is_of_model(arm: Arm, name: str) -> bool:
    """Whether an arm's model has a body of a name."""
    return object_id(arm.model, mujoco.mjtObj.mjOBJ_BODY, name) > 0


def checked_tip(arm: Arm, body: WorldBody) -> str:
    """The tip of an attached body; UnknownNameError if the arm has no such tip."""
    tip = body.tip or arm.tip
    if tip not in arm.tips:
        raise UnknownNameError.from_known("tip", tip, list(arm.tips))
    return tip
