"""Region: a set of poses of the tip, such as all grasps around a can."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.core.errors import InputError
from armctl.core.faces import face
from armctl.core.pose import Pose, computed_pose
from armctl.core.shapes import Ball, Box, Cylinder
from armctl.core.target import RegionMember
from armctl.core.validation import Array, array, choice, flag, frozen, instance, integer, matrix, number, shown, vector

_COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
_ANGLES = slice(3, 6)
_NO_AXIS = -1.0
_IDENTITY = Pose([0.0, 0.0, 0.0])
_DOWN = Pose([0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0])  # half a turn about x
_VERTICAL = 1e-3  # the sine of an angle to the vertical below which no level direction is across
_MIN_NORMAL = 1e-9  # of the length of a normal


@dataclass(frozen=True, eq=False)
class RegionPart:
    """One part of a region: the poses frame @ displacement @ tip, each coordinate of the displacement in its bounds.

    Attributes:
        frame: T_world_frame.
        bounds: (6, 2) the least and the greatest x, y, z, m, and roll, pitch, yaw, rad, of the displacement.
        tip: T_frame_tip where the displacement is zero.
        free: "x", "y" or "z": the axis of the tip about which it turns freely; None if the angles have bounds.
        cone: rad, by which this axis may tilt.
        name: What the part is called; empty if it has no name.
    """

    frame: Pose
    bounds: Array
    tip: Pose
    free: str | None
    cone: float
    name: str

    @property
    def numbers(self) -> Array:
        """(38,) as the core takes it."""
        axis = _NO_AXIS if self.free is None else float("xyz".index(self.free))
        return np.concatenate(
            [self.frame.rows.ravel(), self.tip.rows.ravel(), self.bounds.ravel(), [axis, self.cone if axis >= 0.0 else 0.0]]
        )

    @property
    def coordinate_names(self) -> list[tuple[str, str]]:
        """What each coordinate is called, and its unit: six with bounds of angles, four with a free axis."""
        lengths = [(name, "m") for name in _COORDINATES[:3]]
        return [*lengths, *[(name, "rad") for name in (_COORDINATES[_ANGLES] if self.free is None else ("tilt",))]]

    @property
    def coordinate_bounds(self) -> Array:
        """(6, 2) or (4, 2) the least and the greatest of each coordinate, m and rad; angles without bounds are infinite."""
        if self.free is not None:
            return np.vstack([self.bounds[:3], [-np.inf, self.cone if self.cone < math.pi else np.inf]])
        bounds = self.bounds.copy()
        for row, turn in ((3, 2 * np.pi), (4, np.pi), (5, 2 * np.pi)):
            if bounds[row, 1] - bounds[row, 0] >= turn:
                bounds[row] = [-np.inf, np.inf]
        return bounds

    def coordinates(self, tip: Pose) -> Array:
        """The coordinates of a tip, which are in their bounds if it is in the region.

        Args:
            tip: T_world_tip.

        Returns:
            (6,) x, y, z, m, and roll, pitch, yaw, rad; with a free axis (4,) x, y, z and the tilt.
        """
        found = np.empty((1, len(_COORDINATES)))
        _core.region_coordinates(self.numbers, np.ascontiguousarray(tip.rows.reshape(1, 12)), found)
        return found[0, : len(self.coordinate_names)]

    def nearest(self, tip: Pose) -> Pose:
        """The member with the nearest coordinates to those of a pose of the tip: turned into the region first, then moved.

        Args:
            tip: T_world_tip.
        """
        member = np.empty((1, 12))
        _core.nearest_members(self.numbers, np.ascontiguousarray(tip.rows.reshape(1, 12)), member)
        return computed_pose(member[0, 9:].copy(), member[0, :9].reshape(3, 3).copy())


class Region:
    """A set of poses of the tip, any of which will do: all grasps around a can, anywhere on a shelf, along a seam.

    It is taken wherever a target is. Its poses are frame @ displacement @ tip, where each of the six coordinates of the
    displacement is in its bounds; or one axis of the tip may tilt by a cone, and the tip turns freely about it. `a | b` is the
    union of two regions. Frozen.

    Attributes:
        parts: What it is the union of, at least one.
    """

    __slots__ = ("parts",)

    parts: tuple[RegionPart, ...]

    def __init__(
        self,
        frame: Pose | ArrayLike,
        bounds: ArrayLike | None = None,
        *,
        tip: Pose | None = None,
        free: str | None = None,
        cone: float = 0.0,
        name: str = "",
    ):
        """A region of one part.

        Args:
            frame: T_world_frame; or (3,) m, a point, with the axes of the world.
            bounds: (6, 2) the least and the greatest x, y, z, m, and roll, pitch, yaw, rad, where R = Rz(yaw) Ry(pitch)
                Rx(roll). They may be infinite; left out, all are zero.
            tip: T_frame_tip where all coordinates are zero; left out, the tip is in the frame.
            free: "x", "y" or "z": the axis of the tip about which it turns freely. The three angles have no bounds then.
            cone: rad, by which this axis may tilt; with `free`.
            name: What it is called in results.

        Raises:
            InputError: A wrong shape, reversed bounds, a pitch beyond a quarter turn, or an axis beside bounds of angles.
        """
        place = frame if isinstance(frame, Pose) else Pose(vector("frame", frame, 3))
        offset = _IDENTITY if tip is None else tip
        instance("tip", offset, Pose, "armctl.Pose(position) makes one")
        instance("name", name, str, "give a text")
        limits = np.zeros((6, 2)) if bounds is None else _read_bounds(bounds)
        if free is not None:
            choice("free", free, "xyz")
            if limits[_ANGLES].any():
                raise InputError("free: the tip turns about it and tilts by the cone; leave the bounds of angles at zero")
        tilt = number("cone", cone, 0.0, math.pi)
        if tilt > 0.0 and free is None:
            raise InputError("cone: it is the tilt of an axis; say which one with free='x', 'y' or 'z'")
        part = RegionPart(frame=place, bounds=frozen(limits), tip=offset, free=free, cone=tilt, name=name)
        object.__setattr__(self, "parts", (part,))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a Region is frozen; make a new one instead of setting {name!r}")

    def __reduce__(self):
        return _region_of, (self.parts,)

    @classmethod
    def union(cls, regions: Iterable[Region]) -> Region:
        """The union of several regions.

        Args:
            regions: At least one region.

        Raises:
            InputError: There is none, or something else among them.
        """
        if isinstance(regions, (Pose, str)) or not isinstance(regions, Iterable):
            raise InputError(f"regions: expected a list of regions, got {shown(regions)}")
        given = list(regions)
        if not given:
            raise InputError("regions: the union of none is empty, and no pose is in it; give at least one region")
        for region in given:
            instance("regions", region, Region, "armctl.Region(pose) is the region of one pose")
        return reduce(or_, given)

    @classmethod
    def of(cls, points: ArrayLike, normals: ArrayLike, *, free: str = "z", cone: float = 0.0, distance: float = 0.0) -> Region:
        """The union of a region for each point of a surface: the tip is at the point, its axis against the normal.

        Args:
            points: (N, 3) or (3,) m.
            normals: (N, 3), or (3,) for all points, out of the surface, of any length.
            free: "x", "y" or "z": the axis of the tip that points into the surface, about which it turns freely.
            cone: rad, by which this axis may tilt.
            distance: m, of the tip from the surface along the normal.

        Raises:
            InputError: Wrong shapes, no point, or a normal of no length.
        """
        choice("free", free, "xyz")
        positions, directions = read_surface(points, normals)
        positions = positions + number("distance", distance) * directions
        frames = frames_along(-directions, free)
        poses = [computed_pose(position, rotation) for position, rotation in zip(positions, frames, strict=True)]
        return _region_of(tuple(cone_parts(poses, free, cone)))

    @classmethod
    def around(
        cls,
        shape: Cylinder | Ball,
        at: Pose | ArrayLike,
        *,
        distance: float = 0.0,
        margin: float = 0.0,
        closing: str = "y",
        name: str = "",
    ) -> Region:
        """The grasps around a cylinder from its sides, or around a ball from everywhere.

        The tip's z axis points to the axis of the cylinder, or to the centre of the ball. At a cylinder a gripper closes across
        it; both ways to turn a gripper of two jaws are in the region.

        Args:
            shape: An armctl.Cylinder or armctl.Ball.
            at: T_world_shape, or (3,) m, its centre.
            distance: m, from the tip to the axis or the centre.
            margin: m, that the tip stays away from both ends of a cylinder.
            closing: "x" or "y": the axis of the tip along which the gripper closes.
            name: What it is called in results.

        Raises:
            InputError: Another shape, or a margin of more than half of the cylinder.
        """
        instance("shape", shape, (Cylinder, Ball), "Region.on is for boxes, Region(pose, bounds) for everything else")
        place = at if isinstance(at, Pose) else Pose(vector("at", at, 3))
        away = number("distance", distance, 0.0)
        across = _across(closing)
        if isinstance(shape, Ball):
            bounds = [[0.0, 0.0]] * 3 + [[-np.inf, np.inf]] * 3
            return cls(place, bounds, tip=_towards_axis(away, across), name=name)
        half = 0.5 * shape.length - number("margin", margin, 0.0)
        if half < 0.0:
            raise InputError(f"margin: {margin:g} m at both ends leave nothing of a cylinder of {shape.length:g} m")
        bounds = [[0.0, 0.0], [0.0, 0.0], [-half, half], [0.0, 0.0], [0.0, 0.0], [-np.inf, np.inf]]
        return cls.union(cls(place, bounds, tip=_towards_axis(away, side * across), name=name) for side in (1.0, -1.0))

    @classmethod
    def on(
        cls,
        shape: Box | Cylinder,
        at: Pose | ArrayLike,
        *,
        height: float = 0.0,
        margin: float = 0.0,
        upright: bool = False,
        name: str = "",
    ) -> Region:
        """The places on top of a box or a cylinder, such as a table, with the tip's z axis down and turned as it likes.

        Args:
            shape: An armctl.Box or armctl.Cylinder; its top is the side to which its z axis points.
            at: T_world_shape, or (3,) m, its centre.
            height: m, of the tip above the top.
            margin: m, that the tip stays away from the edges. On a cylinder it stays in the square within its circle.
            upright: Whether the z axis points up instead, as that of a body that `place` puts there; `height` is then that of
                the middle of the body.
            name: What it is called in results.

        Raises:
            InputError: Another shape, or margins that leave nothing.
        """
        instance("shape", shape, (Box, Cylinder), "Region(pose, bounds) is any other region")
        place = at if isinstance(at, Pose) else Pose(vector("at", at, 3))
        if isinstance(shape, Box):
            extent = 0.5 * shape.size
        else:
            extent = np.array([shape.radius, shape.radius, 0.0]) / math.sqrt(2.0)
            extent[2] = 0.5 * shape.length
        half = extent[:2] - number("margin", margin, 0.0)
        if (half < 0.0).any():
            raise InputError(f"margin: {margin:g} m at the edges leave nothing of a top of {2 * extent.min():g} m")
        top = place @ Pose([0.0, 0.0, extent[2] + number("height", height)])
        bounds = [[-half[0], half[0]], [-half[1], half[1]], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [-np.inf, np.inf]]
        return cls(top, bounds, tip=_IDENTITY if flag("upright", upright) else _DOWN, name=name)

    @classmethod
    def upright(cls, tip: Pose, axis: str = "z", *, cone: float = 0.1, name: str = "") -> Region:
        """All poses in which an axis of the tip has the direction that it has in one pose, as for a glass that is carried.

        Args:
            tip: T_world_tip with this direction, such as `arm.fk(q)`; its position does not matter.
            axis: "x", "y" or "z": the axis of the tip. The tip turns freely about it.
            cone: rad, by which the axis may tilt.
            name: What it is called in results.

        Raises:
            InputError: There is no such axis, or a cone of more than half a turn.
        """
        instance("tip", tip, Pose, "arm.fk returns one")
        bounds = [[-np.inf, np.inf]] * 3 + [[0.0, 0.0]] * 3
        return cls(tip, bounds, free=choice("axis", axis, "xyz"), cone=cone, name=name)

    def __array__(self, dtype: object = None, copy: object = None) -> Array:
        """Refused, where one pose is taken and not a set of them."""
        raise InputError(
            "a Region is a set of poses, for solve_ik, move_to, move_free, move_path, DifferentialIk, Gate and Stream; "
            "region.nearest(arm.fk(q)).pose is one of them"
        )

    def __or__(self, other: Region) -> Region:
        if not isinstance(other, Region):
            return NotImplemented
        return _region_of(self.parts + other.parts)

    def __len__(self) -> int:
        return len(self.parts)

    def __iter__(self) -> Iterator[Region]:
        for part in self.parts:
            yield _region_of((part,))

    def __getitem__(self, index: int) -> Region:
        return _region_of((self.parts[index],))

    def __repr__(self) -> str:
        names = [part.name for part in self.parts if part.name]
        return face(self, **({"names": names} if names else {}), parts=len(self.parts))

    def named(self, name: str) -> Region:
        """The same region, whose parts are all called so.

        Args:
            name: What they are called in results.
        """
        instance("name", name, str, "give a text")
        return _region_of(tuple(replace(part, name=name) for part in self.parts))

    def nearest(self, tip: Pose) -> RegionMember:
        """The member whose coordinates are nearest to those of a pose, of the nearest part; a radian counts like a metre there.

        Args:
            tip: T_world_tip.
        """
        instance("tip", tip, Pose, "arm.fk returns one")
        members = [part.nearest(tip) for part in self.parts]
        index = int(np.argmin([sum(member.distance(tip)) for member in members]))
        return RegionMember(index=index, pose=members[index], name=self.parts[index].name)

    def contains(self, tip: Pose, *, position_tolerance: float = 1e-9, orientation_tolerance: float = 1e-9) -> bool:
        """Whether a pose is in it.

        Args:
            tip: T_world_tip.
            position_tolerance: m.
            orientation_tolerance: rad.
        """
        distance, angle = self.nearest(tip).pose.distance(tip)
        return distance <= number("position_tolerance", position_tolerance, 0.0) and angle <= number(
            "orientation_tolerance", orientation_tolerance, 0.0
        )

    def sample(self, count: int, *, seed: int = 0) -> list[Pose]:
        """Random members, evenly spread over the parts and over the bounds of each.

        Args:
            count: How many.
            seed: Of the random numbers.

        Returns:
            The poses of the tip.

        Raises:
            InputError: A length has infinite bounds.
        """
        rng = np.random.default_rng(integer("seed", seed, 0))
        chosen = rng.integers(len(self.parts), size=integer("count", count, 0))
        return [_sample(self.parts[k], rng) for k in chosen]


def _across(closing: str) -> Array:
    """Where a tip has the vertical axis of a shape, (3,), if it grasps across it: the axis that is not the closing one."""
    return np.array([1.0, 0.0, 0.0]) if choice("closing", closing, "xy") == "y" else np.array([0.0, 1.0, 0.0])


def _towards_axis(distance: float, upright: Array) -> Pose:
    """T_shape_tip on a shape's x axis, with its z axis towards the shape, and its axis `upright` along the shape's z axis."""
    inwards = np.array([-1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, upright.sum()])
    side = np.cross(inwards, up)
    columns = [up, side, inwards] if upright[0] else [-side, up, inwards]
    return Pose.from_rotation([distance, 0.0, 0.0], np.column_stack(columns))


def cone_parts(poses: Iterable[Pose], free: str | None, cone: float) -> list[RegionPart]:
    """The parts of regions at poses with the same freedom, checked once."""
    middle = Region(_IDENTITY, free=free, cone=cone).parts[0]
    return [
        RegionPart(frame=pose, bounds=middle.bounds, tip=middle.tip, free=free, cone=middle.cone, name="") for pose in poses
    ]


def _region_of(parts: tuple[RegionPart, ...]) -> Region:
    region = Region.__new__(Region)
    object.__setattr__(region, "parts", parts)
    return region


def _read_bounds(bounds: ArrayLike) -> Array:
    rows = np.array(array("bounds", bounds, 2, finite=False))
    if rows.shape != (6, 2):
        raise InputError(f"bounds: expected (6, 2), the least and the greatest {', '.join(_COORDINATES)}, got {rows.shape}")
    for name, (low, high) in zip(_COORDINATES, rows.tolist(), strict=True):
        if math.isnan(low) or math.isnan(high):
            raise InputError(f"bounds: those of {name} are [{low}, {high}], expected numbers")
        if low > high:
            raise InputError(f"bounds: those of {name} are reversed, [{low:g}, {high:g}]; the smaller one comes first")
    endless = rows[:, 1] - rows[:, 0] >= 2 * np.pi
    endless[:3] = False
    rows[endless] = [-np.pi, np.pi]
    low, high = rows[4]
    if endless[4]:
        rows[4] = [-0.5 * np.pi, 0.5 * np.pi]
    elif low < -0.5 * np.pi or high > 0.5 * np.pi:
        raise InputError(
            f"bounds: those of the pitch are [{low:g}, {high:g}] rad, expected them in a quarter turn to each side"
        )
    return rows


def read_surface(points: ArrayLike, normals: ArrayLike) -> tuple[Array, Array]:
    """Points (N, 3) m and unit normals (N, 3). InputError if they do not fit together."""
    positions = matrix("points", np.atleast_2d(array("points", points, np.ndim(points))), 3)
    directions = matrix("normals", np.atleast_2d(array("normals", normals, np.ndim(normals))), 3)
    if not len(positions):
        raise InputError("points: there is none; give at least one point")
    if len(directions) not in (1, len(positions)):
        raise InputError(f"normals: {len(directions)} given for {len(positions)} points; give one for each, or one for all")
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if (lengths < _MIN_NORMAL).any():
        raise InputError(f"normals: that of point {int(lengths.argmin())} has no length")
    return positions, np.broadcast_to(directions / lengths, positions.shape)


def frames_along(directions: Array, axis: str) -> Array:
    """Rotations (N, 3, 3) whose axis "x", "y" or "z" has unit directions (N, 3); the next one is as level as it can be.

    From one direction to the next the frame turns as little as possible, so that it does not jump along a path.
    """
    first = "xyz".index(axis)
    rotations = np.empty((len(directions), 3, 3))
    x, y, z = directions[0].tolist()
    across = [-y, x, 0.0] if math.hypot(x, y) > _VERTICAL else [1.0, 0.0, 0.0]
    for rotation, direction in zip(rotations, directions.tolist(), strict=True):
        x, y, z = direction
        along = across[0] * x + across[1] * y + across[2] * z
        rest = [across[0] - along * x, across[1] - along * y, across[2] - along * z]
        length = math.hypot(*rest)
        if length < _VERTICAL:  # of a sharp turn: any direction across
            rest = [-y, x, 0.0] if math.hypot(x, y) > _VERTICAL else [1.0, 0.0, 0.0]
            length = math.hypot(*rest)
        across = [each / length for each in rest]
        u, v, w = across
        rotation[:, first] = direction
        rotation[:, (first + 1) % 3] = across
        rotation[:, (first + 2) % 3] = y * w - z * v, z * u - x * w, x * v - y * u
    return rotations


def _sample(part: RegionPart, rng: np.random.Generator) -> Pose:
    if not np.isfinite(part.bounds).all():
        raise InputError("region: a length has infinite bounds, of which nothing can be sampled; give finite ones")
    drawn = rng.uniform(part.bounds[:, 0], part.bounds[:, 1])
    if part.free is None:
        return part.frame @ Pose(drawn[:3], rpy=drawn[3:]) @ part.tip
    axis = np.eye(3)["xyz".index(part.free)]
    across = rng.normal(size=3)
    across -= (across @ axis) * axis
    across /= np.linalg.norm(across)
    # Directions are even on the cap of the sphere: its area grows with 1 - cos(tilt).
    tilt = math.acos(1.0 - rng.uniform() * (1.0 - math.cos(part.cone)))
    turn = _about(across, tilt) @ _about(axis, rng.uniform(-math.pi, math.pi))
    base = part.frame @ Pose(drawn[:3]) @ part.tip
    return computed_pose(base.position.copy(), base.rotation @ turn)


def _about(axis: Array, angle: float) -> Array:
    return Pose([0.0, 0.0, 0.0], [math.cos(0.5 * angle), *(math.sin(0.5 * angle) * axis)]).rotation
