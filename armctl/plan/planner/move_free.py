"""move_free: from one configuration to a goal around all obstacles, proved over the whole motion.

The path has straight lines in joint space, each proved over its whole length. RRT-Connect: J. J. Kuffner, S. M. LaValle,
"RRT-Connect: an efficient approach to single-query path planning", ICRA 2000. Shortcuts: R. Geraerts, M. H. Overmars,
"Creating high-quality paths for motion planning", IJRR 26 (2007). Samples are counted and seeded; no clock decides.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl._core import RrtConnect
from armctl.core.errors import InputError, PlanError, UnknownNameError
from armctl.core.limits import Limits
from armctl.core.region import Region
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, integer, number, shown
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import KEEP_WITHIN_RAD, collision_checker, read_kept_region
from armctl.model.collision.clearance import clearance_of
from armctl.model.collision.moving_joints import MovingJoints
from armctl.model.collision.world_snapshot import WorldLike, WorldSnapshot, read_world
from armctl.model.mjmodel.queries import object_id
from armctl.plan.ik.resting_joints import resting_joints
from armctl.plan.motion.checks import planning_arm, read_duration, start_state
from armctl.plan.motion.given_duration import lasting
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.move_through import through_waypoints
from armctl.plan.motion.moving_start import begun_moving, begun_moving_lasting, stop_from
from armctl.plan.motion.torque_limits import within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.free_space import CLEARANCE_M, FreeSpace, spaces_between
from armctl.plan.planner.goals import FreeConfigurations, FreeGoal, FreeGoals, overlap_in_words
from armctl.plan.planner.region_motion import motion_in_region

_REPAIRS = 14  # points that are added where a smooth motion leaves the free path
_REPAIR_MARGIN = 0.25  # of a line: an added point keeps so far from its ends

MAX_SAMPLES = 20_000
_SAMPLES_PER_CALL = 256  # between two calls of the core the program can be interrupted
_SHORTCUTS = 100
_MIN_GAIN = 1e-3  # of the path's length: less is no gain
_MAX_IDLE_SHORTCUTS = 25  # in a row without a gain


class FreePath(NamedTuple):
    """A path."""

    points: Array  # (k, n) rad; every line between neighbors is proved free
    samples: int  # how many random configurations it took


def find_path(space: FreeSpace, start: Array, goals: Array, limits: Limits, rng: np.random.Generator) -> FreePath | None:
    """A path from a configuration (n,) to any of some others (g, n), all of them free; None after `MAX_SAMPLES` samples."""
    for goal in goals:
        if space.line_is_free(start, goal):
            return FreePath(np.array([start, goal]), 0)
    # Samples are drawn within the limits, and within half a turn around the ends where a joint has wide ones or none.
    ends = np.vstack([start, goals])
    low = np.maximum(limits.q_min, ends.min(axis=0) - np.pi)
    high = np.minimum(limits.q_max, ends.max(axis=0) + np.pi)
    if space.held is not None:
        low = np.where(space.held, start, low)
        high = np.where(space.held, start, high)
    capacity = len(goals) + 2 * MAX_SAMPLES + 2
    trees = RrtConnect(space.checker.proof(space.keep), space.clearance, start, goals, low, high, capacity)
    taken = 0
    while taken < MAX_SAMPLES:
        samples = rng.uniform(low, high, (min(_SAMPLES_PER_CALL, MAX_SAMPLES - taken), len(start)))
        taken += trees.grow(samples)
        path = trees.path()
        if path:
            return FreePath(np.array(path), taken)
    return None


def shorten(space: FreeSpace, path: Array, rng: np.random.Generator) -> Array:
    """The path (k, n) without the points that it does not need, and with random shortcuts: (l, n) with the same ends."""
    points = list(path)
    for point in itertools.count():
        if point + 2 >= len(points):
            break
        farthest = len(points) - 1
        while farthest > point + 1 and not space.line_is_free(points[point], points[farthest]):
            farthest -= 1
        del points[point + 1 : farthest]
    idle = 0
    for shares in np.sort(rng.uniform(size=(_SHORTCUTS, 2))):
        if len(points) < 3 or idle > _MAX_IDLE_SHORTCUTS:
            break
        idle = 0 if _take_shortcut(space, points, shares) else idle + 1
    return np.array(points)


def _take_shortcut(space: FreeSpace, points: list[Array], shares: Array) -> bool:
    """Goes straight between two places on a path, given by their shares of its length; returns whether it can."""
    lengths = [_distance(a, b) for a, b in itertools.pairwise(points)]
    total = sum(lengths)
    low, high = (shares * total).tolist()
    first, begin = _place_on(points, lengths, low)
    last, end = _place_on(points, lengths, high)
    gain = high - low - _distance(begin, end)
    if first == last or gain < _MIN_GAIN * total or not space.line_is_free(begin, end):
        return False
    points[first + 1 : last + 1] = [begin, end]
    point = max(first - 1, 0)
    while point < first + 4 and point + 2 < len(points):
        if space.line_is_free(points[point], points[point + 2]):
            del points[point + 1]
        else:
            point += 1
    return True


def _place_on(points: list[Array], lengths: list[float], distance: float) -> tuple[int, Array]:
    """The number of the line of a path at a distance from its start, and the configuration there."""
    starts = list(itertools.accumulate(lengths[:-1], initial=0.0))
    line = bisect_right(starts, distance) - 1
    share = (distance - starts[line]) / lengths[line] if lengths[line] > 0.0 else 0.0
    return line, points[line] + share * (points[line + 1] - points[line])


def _distance(first: Array, second: Array) -> float:
    """rad; not by BLAS, whose last bits depend on the machine."""
    return math.sqrt(sum(((second - first) ** 2).tolist()))


def move_free(
    arm: Arm,
    q_start: ArrayLike | Setpoint,
    goal: FreeGoal,
    *,
    clearance: float = CLEARANCE_M,
    allow: Iterable[tuple[str, str]] = (),
    holding: str | Iterable[str] | None = None,
    keep: str | Region | None = None,
    keep_within: float = KEEP_WITHIN_RAD,
    speed: float = 1.0,
    duration: float | None = None,
    seed: int = 0,
    world: WorldLike | None = None,
) -> JointTrajectory:
    """A motion around obstacles, at rest at its end: jerk-limited, torque-limited, and proved to touch nothing.

    The result is the straight move if it is proved free. Otherwise RRT-Connect finds a path of proved lines, which is
    shortened and timed by `move_through`; if the smooth motion is too near to a body, points of the path are added.
    The proof covers the whole continuous motion (`check_clearance`), with the geometry that MuJoCo collides and everything
    outside the chain at home. Nothing depends on a clock: the same seed gives the same bits.

    Args:
        arm: The arm, in its scene.
        q_start: (n,) rad, the start; or a setpoint, if it starts while the arm moves. The arm then slows down as fast as it
            can, and turns to the way around the obstacles meanwhile.
        goal: (n,) rad, a Pose, a Region, (3,) m where the orientation does not matter, or a list of these, of which one is
            reached; `region.nearest(arm.fk(q))` tells which member of a region it is. Or targets by tip, as for `solve_ik`. For
            an arm of three joints three numbers are a configuration; `Target.read(point)` is a point.
        clearance: m, of the path; the smooth motion keeps half of it. Two bodies that are nearer at the start or the goal may
            come as near during the motion, all bodies only if there is no other way.
        allow: Pairs of names of bodies or geoms that may touch, such as `[("cube", "table")]`.
        holding: A body, or several, that the tip carries from where they are at the start.
        keep: "x", "y" or "z": the axis of the tip that keeps the direction it has at the start, as for a glass; or a Region
            of one part in which the tip stays: on a plane, on an arc whose angle is free. This is proved, too.
        keep_within: rad that this axis may tilt.
        speed: Fraction of the full speed, in (0, 1].
        duration: s, how long it takes; as short as possible if left out.
        seed: Of the random samples.
        world: What is around the arm besides its scene: a World, or a snapshot of one.

    Raises:
        InputError: An argument of the wrong kind, a negative clearance, or an arm without finite limits.
        LimitError: A configuration outside the limits, or a start so fast that the arm cannot stop inside them.
        ModelError: The scene has a height field or signed distance field that the arm could touch.
        PlanError: Start or goal touches something, the goal cannot be reached, no path was found, the arm cannot stop before
            something that it moves towards, or the duration is too short; the reason names the bodies.
        UnknownNameError: The model has no body or geom of a name in `allow` or `holding`, or there is no such axis.
    """
    check_arm(arm)
    snapshot = read_world(world)
    state = start_state(arm, q_start)
    seconds = read_duration(duration)
    start = state.q
    kept = read_kept_region(arm, keep, keep_within, start)
    checker = _checker(arm, start, allow, holding, snapshot)
    if snapshot is not None:
        arm = snapshot.loaded_arm(arm)
    space = FreeSpace(checker, number("clearance", clearance, 0.0), kept)
    stop = stop_from(planning_arm(arm, 1.0), state)
    if stop is None:
        return lasting(arm, move_free_with(space, arm, start, goal, speed=speed, seed=seed), seconds)
    checker.require_provable()
    free = clearance_of(checker, stop, 0.0, kept)
    if not free.ok:
        raise PlanError(f"start: the arm cannot stop in time: {free.reason}; start slower or allow the contact")
    rest = arm.limits.clamp(stop(stop.duration).q)
    motion = move_free_with(space, arm, rest, goal, speed=speed, seed=seed)
    ends = [checker.nearest(q)[1] for q in (start, rest, motion(motion.duration).q)]
    space = space._replace(clearance=min(0.5 * clearance, 0.25 * min(ends), 0.5 * free.distance))
    if seconds is None:
        return begun_moving(arm, stop, motion, lambda whole: space.motion_hit(whole) is None)
    return begun_moving_lasting(arm, stop, motion, seconds, lambda whole: space.motion_hit(whole) is None)


def move_free_with(
    space: FreeSpace, arm: Arm, start: Array, goal: FreeGoal, *, speed: float = 1.0, seed: int = 0
) -> JointTrajectory:
    """As `move_free` from a configuration at rest, with a checker of the scene as it is."""
    arm = planning_arm(arm, speed)
    checker = space.checker
    checker.require_provable()
    rng = np.random.default_rng(integer("seed", seed, 0))
    require_free_start(checker, start)
    if space.keep is not None and (why := space.keep.why_outside(start)):
        raise PlanError(f"start: {why}")
    if isinstance(goal, Mapping):
        held = resting_joints(arm, goal).held
        space = space._replace(held=held if held.any() else None)
    goals = FreeGoals(checker, space.keep, arm, start, goal, rng)
    found: FreeConfigurations | None = goals.first()
    refusal = ""
    while found is not None:
        motion = _to_any(space, arm, start, found, rng)
        if not isinstance(motion, str):
            return motion
        refusal = motion
        found = goals.more()
    raise PlanError(refusal)


def _to_any(
    space: FreeSpace, arm: Arm, start: Array, goals: FreeConfigurations, rng: np.random.Generator
) -> JointTrajectory | str:
    """A motion to one of some free configurations; a sentence if none was found."""
    refusal = ""
    for path_space, motion_space in spaces_between(space, [start, goals.freest]):
        for configuration in goals.q:
            if not motion_space.line_is_free(start, configuration):
                continue
            motion = move_j(arm, start, configuration)
            if motion_space.motion_hit(motion) is None:
                return motion
        found = find_path(path_space, start, goals.q, arm.limits, rng)
        if found is None:
            where = "" if space.keep is None or space.keep.axis is not None else " in the region"
            refusal = (
                f"no collision-free path found{where} after {MAX_SAMPLES} samples with a clearance of "
                f"{1e3 * path_space.clearance:.2g} mm; another seed, a smaller clearance or a point on the way may help"
            )
            continue
        timed = _timed(motion_space, arm, shorten(path_space, found.points, rng), rng)
        if timed is not None:
            return timed
        refusal = "the path is free, but no motion along it could be proved; try another seed or a smaller clearance"
    return refusal


def _checker(
    arm: Arm,
    start: Array,
    allow: Iterable[tuple[str, str]],
    holding: str | Iterable[str] | None,
    world: WorldSnapshot | None,
) -> CollisionChecker:
    if holding is None:
        names = []
    elif isinstance(holding, str):
        names = [holding]
    elif isinstance(holding, Sequence) and all(isinstance(name, str) for name in holding):
        names = list(holding)
    else:
        raise InputError(f"holding: expected the name of a body or a list of names, got {shown(holding)}")
    held = {_body(arm, name): arm.tip_body for name in names}
    if world is not None:
        held |= world.carried_bodies(arm)
    return collision_checker(arm, arm.qpos(start) if held else None, allow, held, world)


def _body(arm: Arm, name: str) -> int:
    body = object_id(arm.model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 1:
        raise UnknownNameError.from_known("body to hold", name, [arm.model.body(i).name for i in range(1, arm.model.nbody)])
    return body


def require_free_start(checker: CollisionChecker, start: Array) -> None:
    """Raises PlanError if something touches at the start."""
    pair, distance = checker.nearest(start)
    if distance <= 0.0:
        raise PlanError(f"start: {overlap_in_words(checker, start, pair)}; move it apart or allow the contact")


def _timed(space: FreeSpace, arm: Arm, points: Array, rng: np.random.Generator) -> JointTrajectory | None:
    """The fastest smooth motion along a free path that is proved free, within the torques; at worst it stops at each point.

    None if even that one is not proved.
    """
    motion = None
    if space.keep is None or space.keep.only_tilts:
        motion = flowing_motion(space, arm, points)
    elif (along := motion_in_region(space, arm, points, rng)) is not None:
        return along
    if motion is not None:
        slowed = within_torque(arm, motion)
        if slowed is motion or space.motion_hit(slowed) is None:
            return slowed
    lines = [move_j(arm, a, b) for a, b in pairwise(points)]
    stopping = reduce(JointTrajectory.then, lines)
    return stopping if space.motion_hit(stopping) is None else None


def flowing_motion(space: FreeSpace, arm: MovingJoints, points: Array) -> JointTrajectory | None:
    """A smooth motion along a free path that is proved free, without regard to the torques; None if there is none.

    A smooth motion through the points of the path leaves its lines. Where it touches, a point of the line is added and the
    timing repeated; with enough points the motion follows the lines.
    """
    waypoints = list(points)
    for _ in range(_REPAIRS):
        motion = through_waypoints(arm, np.array(waypoints))
        hit = space.motion_hit(motion)
        if hit is None:
            return motion
        line, share = _nearest_line(waypoints, motion(hit.time).q)
        added = waypoints[line] + share * (waypoints[line + 1] - waypoints[line])
        waypoints.insert(line + 1, added)
    return None


def _nearest_line(points: list[Array], q: Array) -> tuple[int, float]:
    """Which line of a path is nearest to a configuration, and where on it, away from its ends."""
    least = np.inf
    nearest = (0, 0.5)
    for line, (begin, end) in enumerate(pairwise(points)):
        way = end - begin
        share = float(np.clip((q - begin) @ way / (way @ way), 0.0, 1.0))
        distance = float(np.linalg.norm(q - begin - share * way))
        if distance < least:
            least = distance
            nearest = (line, float(np.clip(share, _REPAIR_MARGIN, 1.0 - _REPAIR_MARGIN)))
    return nearest
