"""move_l, move_c, move_path: the tip on lines and arcs, its orientation turning along, as fast as the joints can."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, PlanError
from armctl.core.faces import with_options
from armctl.core.limits import Limits
from armctl.core.pose import Pose
from armctl.core.region import Region
from armctl.core.tip_targets import TipTargets
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number, shown, vector
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.plan.ik.all_solutions import solve_ik_all
from armctl.plan.motion.checks import planning_arm, read_duration
from armctl.plan.motion.moving_start import planned_from
from armctl.plan.motion.path.joint_path import joint_path_along
from armctl.plan.motion.path.path_segments import MIN_LENGTH, Blend, Circle, CompositePath, PathSegment, Straight, SubPath, Turn
from armctl.plan.motion.sections import Section, pause
from armctl.plan.motion.timed_along import timed_along
from armctl.plan.motion.timing.path_timing import times_at
from armctl.plan.motion.tip_lines import tip_lines
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory, joined
from armctl.plan.motion.trajectory.limit_check import check_limits, is_inside
from armctl.plan.motion.trajectory.piecewise import Pieces, standing

_BRANCH_SAMPLE = 64  # configurations in which branches are looked for
_MAX_BRANCHES = 16  # that are planned for an arm whose branches have no names
_MAX_ANGLE = 200 * np.pi  # rad, a hundred turns
_MAX_COORDINATE = 1e9  # m


@dataclass(frozen=True, eq=False)
class Line(Section):
    """A straight line of the tip, for `move_path`; `speed`, `acceleration`, `payload` and `dwell` are those of a `Via`.

    Attributes:
        target: T_world_tip at its end, or (3,) m with the orientation left free.
        blend: m, the radius in which the corner at its end may be rounded; None for that of the path.
    """

    target: Pose | ArrayLike
    blend: float | None = None


@dataclass(frozen=True, eq=False)
class Arc(Section):
    """An arc of the tip, for `move_path`; `speed`, `acceleration`, `payload` and `dwell` are those of a `Via`.

    Attributes:
        via: T_world_tip or (3,) m, a point that it goes through.
        target: T_world_tip at its end, or (3,) m with the orientation left free.
        angle: rad, the angle on the circle; None stops at the target. 2 pi is the full circle.
        blend: m, the radius in which the corner at its end may be rounded; None for that of the path.
    """

    via: Pose | ArrayLike
    target: Pose | ArrayLike
    angle: float | None = None
    blend: float | None = None


class PathOptions(TypedDict, total=False):
    """The speed of a motion along a path of the tip: options of `move_l`, `move_c` and `move_path`.

    Attributes:
        speed: Fraction of the full speed, in (0, 1], also of the limits of the tip's speed; 1 if left out.
        tip_speed: m/s, the maximum speed of the tip; no limit if left out.
        tip_angular_speed: rad/s, the maximum angular speed of the tip; no limit if left out.
        duration: s, how long it takes; as short as possible if left out.
    """

    speed: float
    tip_speed: float | None
    tip_angular_speed: float | None
    duration: float | None


PATH_DEFAULTS: dict[str, object] = {"speed": 1.0, "tip_speed": None, "tip_angular_speed": None, "duration": None}


@with_options(PathOptions, PATH_DEFAULTS)
def move_l(
    arm: Arm, q_start: Pose | Setpoint | ArrayLike, target: Pose | ArrayLike | TipTargets, **options: Unpack[PathOptions]
) -> JointTrajectory:
    """The fastest motion of the tip on a straight line, to rest at its end; its orientation rotates about one axis.

    Near a singularity, where the joints must move far, it slows down. If the arm moves at the start, the line begins where it
    would come to rest, and the arm turns onto it while it slows down.

    Args:
        q_start: (n,) rad, the start; or a setpoint, if it starts while the arm moves; or the pose of the tip at the start:
            then the branch with the shortest motion is chosen.
        target: T_world_tip at the end, or (3,) m with the orientation left free; or targets by tip, of an arm with several:
            each tip moves on a line of its own, all are on the way together, and the speeds of tips are limits of each.
        **options: `speed`, `tip_speed`, `tip_angular_speed` and `duration`, as in `PathOptions`.

    Raises:
        InputError: An argument of the wrong shape, kind or value.
        LimitError: q_start is outside the limits, or the start so fast that the arm cannot stop inside them.
        PlanError: The line leaves the reach or the joint limits, a motor cannot hold the arm on it, or the duration is
            too short.
    """
    if isinstance(target, Mapping):
        return _planned(arm, q_start, "move_l", partial(tip_lines, arm, targets=target, options=options), options)
    if isinstance(target, Region):
        raise InputError("target: a Region has many poses, and a line one end; solve_ik(arm, region).member.pose is one")
    return _along(arm, q_start, _Request("move_l", [Line(target)]), options)


@with_options(PathOptions, PATH_DEFAULTS)
def move_c(
    arm: Arm,
    q_start: Pose | Setpoint | ArrayLike,
    via: Pose | ArrayLike,
    target: Pose | ArrayLike,
    *,
    angle: float | None = None,
    **options: Unpack[PathOptions],
) -> JointTrajectory:
    """The fastest motion of the tip on an arc through one point to rest at another; its orientation rotates about one axis.

    Args:
        q_start: (n,) rad, the start; or a setpoint, if it starts while the arm moves; or the pose of the tip at the start.
        via: T_world_tip or (3,) m, an intermediate point; its orientation is ignored.
        target: T_world_tip, or (3,) m with the orientation left free.
        angle: rad, the angle on the circle; None stops at the target's point. 2 pi is the full circle, back to the start's.
            The target's orientation is reached at the end in any case.
        **options: `speed`, `tip_speed`, `tip_angular_speed` and `duration`, as in `PathOptions`.

    Raises:
        InputError: An argument of the wrong shape, kind or value, or three points on one line.
        LimitError: q_start is outside the limits, or the start so fast that the arm cannot stop inside them.
        PlanError: The path leaves the reach or the joint limits, a motor cannot hold the arm on it, or the duration is
            too short.
    """
    return _along(arm, q_start, _Request("move_c", [Arc(via, target, angle)]), options)


@with_options(PathOptions, PATH_DEFAULTS)
def move_path(
    arm: Arm,
    q_start: Pose | Setpoint | ArrayLike | None,
    path: Sequence[Line | Arc | Pose | ArrayLike] | Region | ArrayLike,
    *,
    normals: ArrayLike | None = None,
    free: str | None = None,
    cone: float = 0.0,
    blend: float = 0.0,
    **options: Unpack[PathOptions],
) -> JointTrajectory:
    """The fastest motion of the tip on lines and arcs, or through many points with a tool that may turn, to rest at its end.

    Inside the blend radius of a corner the path is rounded; outside it is exact. If the radius is 0, the tip stops. It also
    stops at a sharp corner where that is faster: a path with blends never takes longer than one without.

    With `free` or `normals` the path is a tool path: the tip passes all of its points without stopping, at each of them turned
    about the free axis as it likes, which is tilted by the cone at most. A joint path is found over all branches and turns, and
    shortened. Between points more than a centimetre apart it follows a line. Points close to each other make a smooth path.

    Args:
        q_start: (n,) rad, the start; or a setpoint, if it starts while the arm moves; or the pose of the tip at the start. Of a
            tool path (n,) rad, where the tip is at the first point, or None: then the best configuration there is the start.
        path: Its lines and arcs; a pose or a point alone is a line to it. All with orientation or all without. Of a tool path
            (N, 3) m with normals, N poses, or a Region whose parts are passed in turn.
        normals: (N, 3) or (3,), of a tool path, out of the surface: the free axis points against them.
        free: "x", "y" or "z": the axis of the tip about which the tool may turn; with normals "z" if left out.
        cone: rad, by which this axis may tilt.
        blend: m, the radius around each corner in which it is rounded, at most half of each neighbour; not of a tool path.
        **options: `speed`, `tip_speed`, `tip_angular_speed` and `duration`, as in `PathOptions`.

    Raises:
        InputError: An argument of the wrong shape, kind or value, or a tool path that crosses itself.
        LimitError: q_start is outside the limits, or the start so fast that the arm cannot stop inside them.
        PlanError: The path leaves the reach or the joint limits, a motor cannot hold the arm on it, or the duration is
            too short. Of a tool path the error names the first point that no joint path passes, and what limits it.
    """
    if is_tool_path(path, normals, free, cone):
        from armctl.plan.motion.tool_path import tool_path

        if blend:
            raise InputError("blend: a tool path passes all of its points; leave the blend out")
        if isinstance(q_start, (Pose, Setpoint)):
            raise InputError("q_start: a tool path starts at rest, at joint positions or at None; None takes the best")
        plan = partial(tool_path, arm, path=path, normals=normals, free=free, cone=cone, options=options)
        return _planned(arm, q_start, "move_path", plan, options)
    if q_start is None:
        raise InputError("q_start: only a tool path, with normals or a free axis, may start anywhere; give joint positions")
    return _along(arm, q_start, _Request("move_path", read_path(path), number("blend", blend, 0.0)), options)


def is_tool_path(path: object, normals: ArrayLike | None, free: str | None, cone: float) -> bool:
    """Whether the arguments of `move_path` are those of a tool path."""
    return normals is not None or free is not None or bool(cone) or isinstance(path, Region)


def read_path(path: Sequence[Line | Arc | Pose | ArrayLike] | Region | ArrayLike) -> list[Line | Arc]:
    """The lines and arcs of a path, at least one; a pose or a point becomes a line to it. InputError if it is no list."""
    if isinstance(path, (Pose, Region, str)) or not isinstance(path, Iterable) or getattr(path, "shape", None) == ():
        raise InputError(f"path: expected a list of lines, arcs, poses or points, got {shown(path)}")
    parts = [part if isinstance(part, (Line, Arc)) else Line(part) for part in path]
    if not parts:
        raise InputError("path: it is empty; give at least one line or arc")
    return parts


class _Request(NamedTuple):
    """A path that a caller asks for: the name of the function, lines and arcs, and the radius of corners without one."""

    function: str
    parts: list[Line | Arc]
    blend: float = 0.0


def _planned(
    arm: Arm, q_start: Any, function: str, plan: Callable[[Any], JointTrajectory], options: PathOptions
) -> JointTrajectory:
    """The motion that a function plans from its start. Raises TypeError for an option that there is not."""
    for name in options.keys() - PathOptions.__annotations__.keys():
        raise TypeError(f"{function}() got an unexpected keyword argument {name!r}")
    return planned_from(arm, q_start, plan, read_duration(options.get("duration")))


def _along(arm: Arm, q_start: Pose | Setpoint | ArrayLike, request: _Request, options: PathOptions) -> JointTrajectory:
    return _planned(arm, q_start, request.function, partial(_plan, arm, request=request, options=options), options)


def _plan(arm: Arm, q_start: Pose | ArrayLike, request: _Request, options: PathOptions) -> JointTrajectory:
    parts = request.parts
    check_one_tip(arm)
    planning = planning_arm(arm, options.get("speed", 1.0), is_signed=True)
    if isinstance(q_start, Pose):
        return _best_branch(arm, q_start, lambda q: _plan(arm, q, request, options))
    q = arm.checked("q_start", q_start)
    oriented = isinstance(parts[0].target, Pose)
    blends = [number("blend", request.blend if part.blend is None else part.blend, 0.0) for part in parts]
    shapes = _shapes(arm.fk(q), parts, oriented)
    legs = [
        _Leg(shape, 0.0 if part.dwell else blend, part)
        for shape, blend, part in zip(shapes, blends, parts, strict=True)
        if shape.length > MIN_LENGTH or part.dwell  # to where the tip is already is no leg
    ]
    motions = _fastest_motions(partial(_stretches, arm, planning.limits, q, request, options), legs)
    return joined(motions) if motions else JointTrajectory(*standing(q), arm.joint_names, arm.limits, units=arm.units)


class _Stretch(NamedTuple):
    """What is gone through without stopping, once it is planned; nothing is, where the tip stays."""

    chain: _Chain
    motions: list[JointTrajectory]  # the motion, and the pause after it
    free: Pieces | None  # the motion without torque limits and limits of sections; its last column is the length


def _fastest_motions(plan: Callable[[list[_Leg]], list[_Stretch]], legs: list[_Leg]) -> list[JointTrajectory]:
    """The motions along legs, with stops at those of the rounded corners where that is faster.

    Around a sharp corner the rounded path is strongly curved, and slower than two straight lines with a stop between.
    """
    rounded = plan(legs)
    candidates = [rounded]
    if len(rounded) < len(legs):
        with suppress(PlanError):  # the corner itself may be out of reach
            stopping = plan([leg._replace(blend=0.0) for leg in legs])
            candidates.append(stopping)
            slow = _slow_corners(rounded, stopping)
            if 0 < len(slow) < len(legs) - len(rounded):
                candidates.append(plan([leg._replace(blend=0.0) if i in slow else leg for i, leg in enumerate(legs)]))
    motions = [[motion for stretch in candidate for motion in stretch.motions] for candidate in candidates]
    return min(motions, key=lambda each: sum(motion.duration for motion in each))


def _slow_corners(rounded: list[_Stretch], stopping: list[_Stretch]) -> set[int]:
    """The legs at whose end a rounded corner takes longer, from the middle of the leg to that of the next one, than a stop."""
    slow = set()
    leg = 0
    for stretch in rounded:
        for corner in stretch.chain.ends[:-1]:
            before = stopping[leg]
            after = stopping[leg + 1]
            if stretch.free is not None and before.free is not None and after.free is not None:
                half = 0.5 * before.chain.path.length
                next_half = 0.5 * after.chain.path.length
                begin, end = times_at(stretch.free, np.array([corner - half, corner + next_half]))
                stop = before.free.knots[-1] - times_at(before.free, np.array([half]))[0]
                start = times_at(after.free, np.array([next_half]))[0]
                if end - begin > stop + start:
                    slow.add(leg)
            leg += 1
        leg += 1
    return slow


def _stretches(arm: Arm, limits: Limits, q: Array, request: _Request, options: PathOptions, legs: list[_Leg]) -> list[_Stretch]:
    """The motions along legs from q."""
    oriented = isinstance(request.parts[0].target, Pose)
    stretches = []
    for chain in _chains(legs):
        motions = []
        free = None
        if chain.path.length > 0.0:
            joint_path = joint_path_along(arm, request.function, chain.path, q, oriented)
            timed = timed_along(arm, limits, joint_path, options, sections=chain.sections, ends=chain.ends)
            free = timed.free
            motion = timed.motion
            _require_limits(arm, request.function, motion)
            motions.append(motion)
            q = motion(motion.duration).q
        if chain.dwell:
            motions.append(pause(arm, q, chain.dwell))
        stretches.append(_Stretch(chain, motions, free))
    return stretches


def _best_branch(arm: Arm, start: Pose, plan: Callable[[Array], JointTrajectory]) -> JointTrajectory:
    """The shortest of the motions that begin at a pose, of each branch in the configuration nearest to the arm's home."""
    found = solve_ik_all(arm, start, _BRANCH_SAMPLE)
    if not found:
        raise PlanError(f"q_start: the pose cannot be reached: {found.reason[0]:.200}")
    known = [name for name in found.branch if name is not None]
    rows = [found.branch.index(name) for name in dict.fromkeys(known)] if known else range(min(len(found), _MAX_BRANCHES))
    motions = []
    failures = []
    for k in rows:
        try:
            motions.append(plan(found.q[k]))
        except PlanError as error:
            failures.append(error)
    if not motions:
        raise failures[0]
    return min(motions, key=lambda motion: motion.duration)


def _require_limits(arm: Arm, what: str, motion: JointTrajectory) -> None:
    """Refuses a motion that leaves its limits between the places where the joint path was computed. Raises PlanError."""
    if is_inside(motion.pieces, arm.limits):
        return
    worst = check_limits(motion.pieces, arm.limits, arm.joint_names, arm.units).violations[0]
    x, y, z = arm.fk(motion(worst.time).q).position
    raise PlanError(
        f"{what}: with the tip at [{x:.3f}, {y:.3f}, {z:.3f}] m, the {worst.quantity} of {worst.joint} would exceed its limit "
        f"{worst.bound:.6g} {worst.unit} by {abs(worst.value - worst.bound):.2g} {worst.unit}; "
        "start from another joint position for the same tip pose"
    )


class _Leg(NamedTuple):
    """A shape, the radius of the corner at its end, and what holds on it."""

    shape: PathSegment
    blend: float
    section: Section


class _Chain(NamedTuple):
    """What is gone through without stopping: where its sections end, m, what holds in each, and the pause after it, s."""

    path: CompositePath
    ends: list[float]
    sections: list[Section]
    dwell: float


def _shapes(start: Pose, parts: list[Line | Arc], oriented: bool) -> list[PathSegment]:
    shapes: list[PathSegment] = []
    position = start.position
    rotation = start.rotation
    for part in parts:
        if isinstance(part.target, Pose) != oriented:
            raise InputError("path: some targets are poses and some are points; give all of one kind")
        end = _point("target", part.target)
        turn = Turn.between(rotation, part.target.rotation if isinstance(part.target, Pose) else rotation)
        if isinstance(part, Arc):
            via = _point("via", part.via)
            angle = None if part.angle is None else number("angle", part.angle, 1e-6, _MAX_ANGLE)
            shapes.append(Circle.through(position, via, end, angle, turn))
            end = shapes[-1].at(shapes[-1].length).position
        else:
            shapes.append(Straight(position, end, turn))
        position = end
        rotation = turn.at(1.0)
    return shapes


def _point(name: str, place: Pose | ArrayLike) -> Array:
    """The position of a pose or point, (3,) m. Raises InputError where the square of its distance could overflow."""
    point = place.position if isinstance(place, Pose) else vector(name, place, 3)
    farthest = float(np.abs(point).max())
    if farthest > _MAX_COORDINATE:
        raise InputError(f"{name}: a coordinate of {farthest:.3g} m; use at most {_MAX_COORDINATE:g} m in each direction")
    return point


def _chains(legs: list[_Leg]) -> list[_Chain]:
    """What is gone through without stopping: stretches of the shapes, and blends between them."""
    chains: list[_Chain] = []
    shapes: list[PathSegment] = []
    ends: list[float] = []
    sections: list[Section] = []
    begin = 0.0
    length = 0.0
    for i, (shape, radius, section) in enumerate(legs):
        after = legs[i + 1].shape if i + 1 < len(legs) else None
        sections.append(section)
        length += shape.length - begin
        if after is None or radius == 0.0 or after.length <= MIN_LENGTH:
            shapes.append(SubPath(shape, begin, shape.length))
            chains.append(_Chain(CompositePath(shapes), [*ends, length], sections, section.dwell))
            shapes = []
            ends = []
            sections = []
            begin = 0.0
            length = 0.0
            continue
        shorter = min(shape.length, after.length)
        if radius > 0.5 * shorter + 1e-12:
            raise InputError(
                f"blend: {radius:g} m at corner {i + 1} is more than half of the shorter side, {0.5 * shorter:.4g} m"
            )
        shapes += [SubPath(shape, begin, shape.length - radius), Blend(shape, after, radius)]
        ends.append(length)  # in the middle of the blend
        length += radius
        begin = radius
    return chains
