"""World: what is around a robot, and may change while it runs."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from types import MappingProxyType
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from armctl.core.errors import InputError, UnknownNameError, shown
from armctl.core.other_names import with_hints
from armctl.core.pose import Pose
from armctl.core.shapes import Ball, Box, Cylinder, Mesh, Points, Shape
from armctl.core.tables import Table
from armctl.core.validation import instance, number, vector
from armctl.model.collision.world_snapshot import WorldBody, WorldSnapshot

_LIGHTEST_BODY_KG = 1e-6
_NAMES_IN_REPR = 6
_SHAPES = (Box, Ball, Cylinder, Mesh, Points)


class World:
    """Bodies around a robot under names: boxes, balls, cylinders, meshes, and clouds of points as a depth camera gives them.

    A change takes effect in the next call that takes the world: whoever plans or proves uses one snapshot from start to end.
    Nothing is compiled, and threads may change and use a world at the same time.
    """

    if not TYPE_CHECKING:
        __getattr__ = with_hints(
            {
                "add_box": "world.add(name, armctl.Box(size), at)",
                "add_ball": "world.add(name, armctl.Ball(radius), at)",
                "add_sphere": "world.add(name, armctl.Ball(radius), at)",
                "add_cylinder": "world.add(name, armctl.Cylinder(radius, length), at)",
                "add_mesh": "world.add(name, armctl.Mesh(vertices), at)",
                "add_points": "world.add(name, armctl.Points(points, radius))",
            }
        )

    def __init__(self) -> None:
        """An empty world."""
        self._lock = threading.RLock()
        self._bodies: dict[str, WorldBody] = {}
        self._allowed: set[tuple[str, str]] = set()
        self._version = 0
        self._snapshot: WorldSnapshot | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its bodies, in the order in which they were added."""
        with self._lock:
            return tuple(self._bodies)

    def __contains__(self, name: object) -> bool:
        return name in self._bodies

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self._bodies)

    def __getitem__(self, name: str) -> WorldBody:
        with self._lock:
            return self._body(name)

    def add(self, name: str, shape: Shape, at: Pose | ArrayLike | None = None, mass: float | None = None) -> World:
        """Adds a body that stands, or replaces the body of that name.

        Args:
            name: Its name.
            shape: A Box, Ball, Cylinder, Mesh or Points.
            at: T_world_body, or (3,) m where the frame of the shape is; left out, that is the frame of the world.
            mass: kg, if it is known. A body with a mass is loose in `armctl.load(..., scene=world)`, and a payload when it is
                attached.

        Returns:
            The world itself.

        Raises:
            InputError: A name that is no text, no shape, no pose, or points with a mass.
        """
        checked_name(name)
        instance("shape", shape, _SHAPES, "armctl.Box([0.1, 0.1, 0.1]) is one")
        if mass is not None:
            mass = number("mass", mass, _LIGHTEST_BODY_KG)
            if isinstance(shape, Points):
                raise InputError("mass: points are no body that could be loose; give an armctl.Mesh or an armctl.Box a mass")
        body = WorldBody(name=name, shape=shape, pose=_pose(at), mass=mass)
        with self._lock:
            self._bodies[name] = body
            self._change()
        return self

    def remove(self, name: str) -> World:
        """Takes a body away, attached or not, and the pairs with it that may touch.

        Args:
            name: Its name.

        Returns:
            The world itself.

        Raises:
            UnknownNameError: The world has no such body.
        """
        with self._lock:
            self._body(name)
            del self._bodies[name]
            self._allowed = {pair for pair in self._allowed if name not in pair}
            self._change()
        return self

    def move(self, name: str, at: Pose | ArrayLike) -> World:
        """Moves a body that stands.

        Args:
            name: Its name.
            at: T_world_body, or (3,) m; then it is not turned.

        Returns:
            The world itself.

        Raises:
            UnknownNameError: The world has no such body.
            InputError: It is attached.
        """
        pose = _pose(at)
        with self._lock:
            body = self._body(name)
            if body.tip is not None:
                raise InputError(f"name: {name:.60} is attached to the tip {body.tip!r}; detach it first")
            self._bodies[name] = WorldBody(name=name, shape=body.shape, pose=pose, mass=body.mass)
            self._change()
        return self

    def attach(self, name: str, at: Pose | ArrayLike | None = None, tip: str = "") -> World:
        """Makes a body a part of a tip, with which it moves; its mass, if it has one, counts as a payload in plans.

        Args:
            name: Its name.
            at: T_tip_body, or (3,) m. In the world of a simulation or a robot it may be left out: then the body is taken from
                where it is.
            tip: The tip; the first one if left out.

        Returns:
            The world itself.

        Raises:
            UnknownNameError: There is no such body, or the arm has no such tip.
            InputError: `at` is left out and unknown, or the body is a cloud of points.
        """
        instance("tip", tip, str, "such as 'tool'")
        with self._lock:
            body = self._body_to_attach(name)
            if isinstance(body.shape, Points):
                raise InputError(f"name: {name:.60} is a cloud of points, which stands; attach an armctl.Mesh of them or a Box")
            self._bodies[name] = WorldBody(
                name=name, shape=body.shape, pose=self._pose_at_tip(body, at, tip), mass=body.mass, tip=self._tip_named(tip)
            )
            self._change()
        return self

    def detach(self, name: str, at: Pose | ArrayLike | None = None) -> World:
        """Makes an attached body stand.

        Args:
            name: Its name.
            at: T_world_body, or (3,) m. In the world of a simulation or a robot it may be left out: then the body stays where
                the tip has it now.

        Returns:
            The world itself.

        Raises:
            UnknownNameError: The world has no such body.
            InputError: It is not attached, or `at` is left out and unknown.
        """
        with self._lock:
            body = self._body(name)
            if body.tip is None:
                raise InputError(f"name: {name:.60} is not attached to a tip")
            if body.shape is None:
                del self._bodies[name]
            else:
                pose = self._pose_in_world(body, at)
                self._bodies[name] = WorldBody(name=name, shape=body.shape, pose=pose, mass=body.mass)
            self._change()
        return self

    def allow(self, first: str, second: str) -> World:
        """Lets two bodies touch, such as a cup and its table.

        Args:
            first: A body of the world, or a body or geom of the arm's model.
            second: Likewise. A plan with names that nothing has raises an error.

        Returns:
            The world itself.
        """
        pair = (checked_name(first), checked_name(second))
        with self._lock:
            self._allowed.add(pair)
            self._change()
        return self

    def snapshot(self) -> WorldSnapshot:
        """What is in it now, as an immutable value; the same object until something changes."""
        with self._lock:
            if self._snapshot is None:
                self._snapshot = WorldSnapshot(
                    version=self._version, bodies=MappingProxyType(dict(self._bodies)), allowed=frozenset(self._allowed)
                )
            return self._snapshot

    def __repr__(self) -> str:
        names = self.names
        more = f" and {len(names) - _NAMES_IN_REPR} more" if len(names) > _NAMES_IN_REPR else ""
        return f"World({', '.join(f'{name:.60}' for name in names[:_NAMES_IN_REPR])}{more})"

    def _repr_html_(self) -> str:
        rows = []
        for body in self.snapshot().bodies.values():
            place = ", ".join(f"{x:g}" for x in body.pose.position)
            mass = "" if body.mass is None else f"{body.mass:g}"
            rows.append([body.name, type(body.shape).__name__.lower(), place, mass, body.tip or ""])
        return Table(["body", "shape", "at, m", "mass, kg", "tip"], rows).html()

    def _change(self) -> None:
        """Notes that something has changed."""
        self._version += 1
        self._snapshot = None

    def _body(self, name: str) -> WorldBody:
        checked_name(name)
        if name not in self._bodies:
            raise UnknownNameError.from_known("body in the world", name, list(self._bodies))
        return self._bodies[name]

    def _body_to_attach(self, name: str) -> WorldBody:
        return self._body(name)

    def _tip_named(self, tip: str) -> str:
        """The tip that is meant; empty for the first one of the arm that is planned for."""
        return tip

    def _pose_at_tip(self, body: WorldBody, at: Pose | ArrayLike | None, tip: str) -> Pose:
        """T_tip_body of a body that is attached."""
        if at is None:
            raise InputError(
                f"at: where {body.name:.60} is in the frame of the tip is not known; give T_tip_body, or use the world of a "
                "simulation or a robot, which knows where the tip is"
            )
        return _pose(at)

    def _pose_in_world(self, body: WorldBody, at: Pose | ArrayLike | None) -> Pose:
        """T_world_body of a body that is detached."""
        if at is None:
            raise InputError(f"at: where {body.name:.60} is in the world is not known; give T_world_body")
        return _pose(at)


def checked_name(name: str, what: str = "name") -> str:
    """A name that is a text, and not empty."""
    instance(what, name, str, "such as 'table'")
    if not name:
        raise InputError(f"{what}: {shown(name)} is empty; give the body a name, such as 'table'")
    return name


def _pose(at: Pose | ArrayLike | None) -> Pose:
    """A pose from one, from a position, or from nothing."""
    if at is None:
        return Pose([0.0, 0.0, 0.0])
    return at if isinstance(at, Pose) else Pose(vector("at", at, 3))
