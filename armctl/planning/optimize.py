"""optimize: a planned motion made better in time, torque, vibration or distance, within all limits and proved free again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from armctl.collision.checkers import collision_checker
from armctl.collision.clearance import ClearanceCheck, clearance_of
from armctl.core.errors import InputError, PlanError
from armctl.core.limits import torque_shares
from armctl.core.result import Verdict
from armctl.core.trajectory import check_motion
from armctl.core.validation import Array, instance, integer, number
from armctl.motion.checks import planning_arm
from armctl.motion.move_through import through_waypoints
from armctl.motion.torque_limits import InverseDynamics, within_torque
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.planning.move_free import CLEARANCE_M, FreeSpace
from armctl.robot.arm import Arm

_WAYPOINTS = (0, 1, 2, 3, 5, 8, 12, 20)  # between start and goal, of the first candidates; many stay on the given path
_REMOVAL_SHARE = 0.2  # of the changes, which leave out a waypoint
_SAMPLES = 200  # of the measures of a motion
_MIN_GAIN = 1e-3  # of the cost: less is no gain
_MIN_SPEED = 0.2
_TINY = 1e-12
# The steps of the search, as shares of the way of each joint. Rechenberg's rule (1973): larger after a success, smaller after a
# failure, so that one of five succeeds.
_FIRST_STEP = 0.1
_LEAST_STEP = 1e-3
_GROWTH = 1.5
_SHRINKAGE = _GROWTH**-0.25


class MotionMeasures(NamedTuple):
    """What `optimize` weighs.

    Attributes:
        time: s, the duration.
        torque: The root mean square share of the torque limits, over time and joints.
        vibration: The root mean square share of the jerk limits, over time and joints: what excites springs.
        distance: rad, the length of the path of the joints.
    """

    time: float
    torque: float
    vibration: float
    distance: float


@dataclass(frozen=True)
class OptimizedMotion(Verdict):
    """What `optimize` found. True if it is better than the given motion.

    Attributes:
        ok: Whether the motion has a smaller cost than the given one.
        reason: Why not; empty if it has.
        motion: The best proved motion: the given one if no better one was found.
        before: What the given motion has.
        after: What the best one has.
        cost: The weighted mean of the measures, relative to those of the given motion; 1 without a gain.
        clearance: The proof of the best motion.
        evaluations: How many motions were timed.
    """

    ok: bool
    reason: str
    motion: JointTrajectory
    before: MotionMeasures
    after: MotionMeasures
    cost: float
    clearance: ClearanceCheck
    evaluations: int

    def __str__(self) -> str:
        changes = ", ".join(
            f"{name} {old:.3g} -> {new:.3g}"
            for name, old, new in zip(MotionMeasures._fields, self.before, self.after, strict=True)
        )
        return f"cost {100 * (self.cost - 1):+.1f} %: {changes}"


def optimize(
    arm: Arm,
    motion: JointTrajectory,
    *,
    time: float = 1.0,
    torque: float = 0.0,
    vibration: float = 0.0,
    distance: float = 0.0,
    clearance: float = 0.5 * CLEARANCE_M,
    allow: Iterable[tuple[str, str]] = (),
    evaluations: int = 300,
    seed: int = 0,
) -> OptimizedMotion:
    """A better motion between the ends of a planned one, such as one of `move_free`.

    Waypoints of the motion move at random, and the speed if it costs torque or vibration; every change that lowers the cost is
    kept if `check_clearance` proves the new motion. Each motion is timed by `move_through`: within position, velocity,
    acceleration, jerk and torque limits. Nothing depends on a clock: the same seed gives the same bits.

    Args:
        arm: The arm, in its scene.
        motion: A motion from rest to rest, proved free.
        time: The weight of the duration, relative to that of the given motion.
        torque: The weight of the torque.
        vibration: The weight of the jerk.
        distance: The weight of the path length of the joints.
        clearance: m, that the motion keeps: by default that of a motion of `move_free`.
        allow: Pairs of names of bodies or geoms that may touch.
        evaluations: How many motions are timed.
        seed: Of the changes.

    Raises:
        InputError: An argument of a wrong kind or value, or a motion that starts or ends moving.
        ModelError: The scene has a height field or signed distance field that the arm could touch.
        PlanError: The given motion is not proved to keep the clearance.
        UnknownNameError: The model has no body or geom of a name in `allow`.
    """
    arm = planning_arm(arm, 1.0)
    instance("motion", motion, JointTrajectory, "armctl.move_free returns one")
    check_motion(motion, arm.joint_names, what="motion")
    given = zip(MotionMeasures._fields, (time, torque, vibration, distance), strict=True)
    weights = np.array([number(name, value, 0.0) for name, value in given])
    if not weights.any():
        raise InputError("time, torque, vibration, distance: all weights are 0; give one above 0")
    for t in (0.0, motion.duration):
        if np.abs(motion(t).v).max() > 1e-9:
            raise InputError("motion: it starts or ends moving; expected one from rest to rest")
    space = FreeSpace(collision_checker(arm, None, allow), number("clearance", clearance, 0.0))
    space.checker.require_provable()
    given_clearance = clearance_of(space.checker, motion, space.clearance)
    if not given_clearance.ok:
        raise PlanError(f"motion: {given_clearance.reason}; plan it with move_free, or take a smaller clearance")
    search = _Search(arm, motion, weights, space, bool(torque or vibration))
    search.run(integer("evaluations", evaluations, 1), np.random.default_rng(seed))
    gained = search.cost < 1.0 - _MIN_GAIN
    best = search.motion if gained else motion
    return OptimizedMotion(
        ok=gained,
        reason="" if gained else f"none of {search.evaluations} motions was better and proved free",
        motion=best,
        before=search.before,
        after=search.measures(best),
        cost=search.cost if gained else 1.0,
        clearance=clearance_of(space.checker, best, space.clearance) if gained else given_clearance,
        evaluations=search.evaluations,
    )


class _Search:
    """The search of `optimize`, and the best motion that it found."""

    def __init__(self, arm: Arm, motion: JointTrajectory, weights: Array, space: FreeSpace, varies_speed: bool):
        self.arm = arm
        self.space = space
        self.motion = motion
        self.cost = 1.0
        self.evaluations = 0
        self._weights = weights / weights.sum()
        self._inverse_dynamics = InverseDynamics(arm)
        self._varies_speed = varies_speed
        self.before = self.measures(motion)

    def measures(self, motion: JointTrajectory) -> MotionMeasures:
        times = np.linspace(0.0, motion.duration, _SAMPLES)
        q, v, a = motion.sample(times)[:3]
        torque = torque_shares(self.arm.limits, self._inverse_dynamics.total(q, v, a), v)
        jerk = motion.jerk(times) / self.arm.limits.j_max
        return MotionMeasures(
            time=motion.duration,
            torque=float(np.sqrt(np.mean(torque**2))),
            vibration=float(np.sqrt(np.mean(jerk**2))),
            distance=float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum()),
        )

    def run(self, evaluations: int, rng: np.random.Generator) -> None:
        """Improves the waypoints, from the best number of them."""
        q = self.motion.sample(np.linspace(0.0, self.motion.duration, _SAMPLES)).q
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
        way = np.maximum(np.ptp(q, axis=0), _LEAST_STEP * lengths[-1])
        places = [np.linspace(0.0, lengths[-1], count + 2) for count in _WAYPOINTS]
        starts = [q[np.round(np.interp(place, lengths, np.arange(_SAMPLES))).astype(int)] for place in places]
        costs = [self._evaluate(points, 1.0, np.inf) for points in starts]
        points = starts[int(np.argmin(costs))]
        least = min(costs)
        speed = 1.0
        step = _FIRST_STEP
        while self.evaluations < evaluations and np.isfinite(least):
            moved = self._moved(points, step * way, rng)
            slower = float(np.clip(speed * np.exp(step * rng.normal()), _MIN_SPEED, 1.0)) if self._varies_speed else 1.0
            cost = self._evaluate(moved, slower, least)
            if cost < least:
                points = moved
                speed = slower
                least = cost
            step *= _GROWTH if np.isfinite(cost) else _SHRINKAGE
            if step < _LEAST_STEP:
                step = _FIRST_STEP

    def _moved(self, points: Array, step: Array, rng: np.random.Generator) -> Array:
        """Other waypoints: without one of them, or with random changes of some coordinates."""
        if len(points) > 3 and rng.uniform() < _REMOVAL_SHARE:
            return np.delete(points, rng.integers(1, len(points) - 1), axis=0)
        inside = points[1:-1]
        changed = rng.uniform(size=inside.shape) < rng.uniform()
        return np.vstack(
            [points[:1], self.arm.limits.clamp(inside + step * changed * rng.normal(size=inside.shape)), points[-1:]]
        )

    def _evaluate(self, points: Array, speed: float, bound: float) -> float:
        """The cost of the motion through points; inf if it is above the bound or not proved."""
        self.evaluations += 1
        try:
            motion = within_torque(self.arm, through_waypoints(planning_arm(self.arm, speed), points))
        except PlanError:
            return np.inf
        motion = replace(motion, limits=self.arm.limits)
        cost = float(self._weights @ (np.array(self.measures(motion)) / np.maximum(self.before, _TINY)))
        if cost >= bound or self.space.motion_hit(motion) is not None:
            return np.inf
        if cost < self.cost:
            self.cost = cost
            self.motion = motion
        return cost
