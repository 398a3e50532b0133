"""optimize: a planned motion made better in time, torque, vibration or distance, within all limits and proved free again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple

import numpy as np

from armctl._core import Hit
from armctl.core.errors import InputError, PlanError
from armctl.core.limits import torque_shares
from armctl.core.result import Verdict
from armctl.core.trajectory import check_motion
from armctl.core.validation import Array, instance, integer, number
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.clearance import ClearanceCheck, clearance_of
from armctl.model.collision.world_snapshot import WorldLike, read_world
from armctl.plan.motion.checks import planning_arm
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.torque_limits import InverseDynamics, check_torque, stretch_for
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import QUANTITIES
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.plan.planner.descent import TINY, Descent
from armctl.plan.planner.free_space import CLEARANCE_M, FreeSpace
from armctl.plan.planner.transcription import SAMPLES, Transcription

_PIECES = (12, 16, 24, 32, 48)  # of constant jerk: as few as follow a path so nearly that the motion is proved
_FINE = 24  # pieces, of the second descent
_LONGEST = 5.0  # of a motion, relative to the given one
_FIRST_RADIUS = 0.5  # of a descent, in greatest accelerations and in first durations of a piece
_LEAST_RADIUS = 0.05
_SHRINKAGE = 0.7
_BEND = 0.5  # of random starts, relative to the way of each joint
_BENDS = (1.0, 0.5, 0.25, 0.125)  # the first one that is proved
_LEAST_WAY = 0.1  # of a joint, relative to the longest
_IDLE_STARTS = 3  # in a row without a gain, after which the search ends
_STRETCHES = 20  # to the torque limits
_LIMIT_SHARE_ROUNDING = 1e-9
_MEASURE_SAMPLES = 200  # of the measures of a motion
_MIN_COST_GAIN = 1e-3  # of the cost: less is no gain


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
        evaluations: How many motions were computed with their derivatives.
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
    world: WorldLike | None = None,
) -> OptimizedMotion:
    """A better motion between the ends of a planned one, such as one of `move_free`.

    Path and timing change at once, by sequential quadratic programming with derivatives of the dynamics and of the distances
    (`Transcription`, `Descent`). It starts from the given motion, from a straight line, and from the best motion with random
    bends. A result is slowed down to the limits of position, velocity, acceleration, jerk and torque, which takes less than
    0.1 % as a rule, and kept if it costs less and `check_clearance` proves it. It is a local optimum: one on another side of an
    obstacle is not looked for. Nothing depends on a clock: the same seed gives the same bits.

    Args:
        arm: The arm, in its scene.
        motion: A motion from rest to rest, proved free.
        time: The weight of the duration, relative to that of the given motion. A motion may last up to five times as long.
        torque: The weight of the torque.
        vibration: The weight of the jerk.
        distance: The weight of the path length of the joints.
        clearance: m, that the motion keeps: by default that of a motion of `move_free`.
        allow: Pairs of names of bodies or geoms that may touch.
        evaluations: How many motions are computed with their derivatives, at most; each takes 5 to 100 ms.
        seed: Of the random bends.
        world: What is around the arm besides its scene: a World, or a snapshot of one.

    Raises:
        InputError: An argument of a wrong kind or value, or a motion that starts or ends moving.
        ModelError: The scene has a height field or signed distance field that the arm could touch.
        PlanError: The given motion is not proved to keep the clearance.
        UnknownNameError: The model has no body or geom of a name in `allow`.
    """
    snapshot = read_world(world)
    arm = planning_arm(arm if snapshot is None else snapshot.loaded_arm(arm), 1.0)
    instance("motion", motion, JointTrajectory, "armctl.move_free returns one")
    check_motion(motion, arm.joint_names, what="motion")
    given = zip(MotionMeasures._fields, (time, torque, vibration, distance), strict=True)
    weights = np.array([number(name, value, 0.0) for name, value in given])
    if not weights.any():
        raise InputError("time, torque, vibration, distance: all weights are 0; give one above 0")
    for t in (0.0, motion.duration):
        if np.abs(motion(t).v).max() > 1e-9:
            raise InputError("motion: it starts or ends moving; expected one from rest to rest")
    space = FreeSpace(collision_checker(arm, None, allow, world=snapshot), number("clearance", clearance, 0.0))
    space.checker.require_provable()
    given_clearance = clearance_of(space.checker, motion, space.clearance)
    if not given_clearance.ok:
        raise PlanError(f"motion: {given_clearance.reason}; plan it with move_free, or take a smaller clearance")
    search = _MotionSearch(arm, motion, weights, space)
    search.run(integer("evaluations", evaluations, 1), np.random.default_rng(seed))
    gained = search.cost < 1.0 - _MIN_COST_GAIN
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


class _SpentError(Exception):
    """All evaluations are made."""


class _MotionSearch:
    """The search of `optimize`, and the best motion that it found."""

    def __init__(self, arm: Arm, motion: JointTrajectory, weights: Array, space: FreeSpace):
        self.arm = arm
        self.space = space
        self.motion = motion
        self.cost = 1.0
        self.evaluations = 0
        self._given = motion
        self._most_pieces = _PIECES[-1]  # later no more than the given motion needs: many take long
        self._inverse_dynamics = InverseDynamics(arm)
        self.before = self.measures(motion)
        self._weights = weights / weights.sum() / np.maximum(self.before, TINY)

    def measures(self, motion: JointTrajectory) -> MotionMeasures:
        times = np.linspace(0.0, motion.duration, _MEASURE_SAMPLES)
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
        """Descends from the given motion, from a straight line, and from the best motion with random bends."""
        if self._given.duration == 0.0:
            return

        def spend() -> None:
            if self.evaluations == evaluations:
                raise _SpentError
            self.evaluations += 1

        idle = 0
        for start in count():
            before = self.cost
            found = self._start(start, spend, rng)
            if found is not None:
                descent, x = found
                try:
                    self._descend(descent, x)
                except _SpentError:
                    self._consider_last(descent)
                    return
            idle = 0 if self.cost < before - _MIN_COST_GAIN else idle + 1
            if idle == _IDLE_STARTS:
                return

    def _start(self, number: int, spend: Callable[[], None], rng: np.random.Generator) -> tuple[Descent, Array] | None:
        """A proved motion as unknowns, and the problem that they are of."""
        if number == 0:
            found = self._transcribed(self._given, spend)
            self._most_pieces = max(_FINE, found[0].transcription.pieces) if found is not None else self._most_pieces
            return found
        if number == 1:
            return self._transcribed(self.motion, spend, least=_FINE)
        if number == 2:
            straight = move_j(self.arm, self._given(0.0).q, self._given(self._given.duration).q)
            return self._transcribed(straight, spend)
        way = np.ptp(self.motion.sample(np.linspace(0.0, self.motion.duration, _MEASURE_SAMPLES)).q, axis=0)
        bend = _BEND * np.maximum(way, _LEAST_WAY * way.max()) * rng.normal(size=self.arm.n)
        for size in _BENDS:
            found = self._transcribed(self.motion, spend, size * bend)
            if found is not None:
                return found
        return None

    def _transcribed(
        self, motion: JointTrajectory, spend: Callable[[], None], bend: Array | float = 0.0, least: int = 0
    ) -> tuple[Descent, Array] | None:
        """A motion with a bend, in as few pieces as follow it so nearly that the result is proved, at least so many."""
        arm = self.arm
        for pieces in _PIECES:
            if not least <= pieces <= self._most_pieces:
                continue
            share = np.linspace(0.0, 1.0, SAMPLES * pieces + 1)[:, None]
            path = motion.sample(share[:, 0] * motion.duration).q
            path = arm.limits.clamp(path + (4.0 * share * (1.0 - share)) ** 3 * bend)
            nearest = Transcription(arm.limits, self._inverse_dynamics, path[0], path[-1], motion.duration, pieces)
            timed = self._timed(nearest.motion(nearest.unknowns(path)))
            if timed is None or self.space.motion_hit(timed) is not None:
                continue
            transcription = Transcription(arm.limits, self._inverse_dynamics, path[0], path[-1], timed.duration, pieces)
            longest = _LONGEST * self.before.time
            return Descent(transcription, self.space, self._weights, longest, spend), transcription.unknowns(path)
        return None

    def _descend(self, descent: Descent, x: Array) -> None:
        """Goes on from proved motions only; from one that is too near to something not so far, and with larger distances."""
        radius = _FIRST_RADIUS
        least = np.inf
        lower = x
        while radius > _LEAST_RADIUS:
            lower = descent.minimum(lower, x, radius)
            motion = self._timed(descent.transcription.motion(descent.transcription.at_goal(lower)))
            if motion is None:
                radius *= _SHRINKAGE
                continue
            cost = self._cost_of(motion)
            if cost > least - _MIN_COST_GAIN:
                return
            hit = self._consider(motion)
            if hit is not None:
                descent.keep_away(motion, hit)
                radius *= _SHRINKAGE
                continue
            least = cost
            x = lower
            radius *= 2.0

    def _consider_last(self, descent: Descent) -> None:
        """What an unfinished descent has reached."""
        if descent.last is None:
            return
        motion = self._timed(descent.transcription.motion(descent.transcription.at_goal(descent.last.x)))
        if motion is not None:
            self._consider(motion)

    def _cost_of(self, motion: JointTrajectory) -> float:
        return float(self._weights @ np.array(self.measures(motion)))

    def _consider(self, motion: JointTrajectory) -> Hit | None:
        """Keeps a proved motion if it costs less; where it is not proved otherwise."""
        hit = self.space.motion_hit(motion)
        cost = self._cost_of(motion)
        if hit is None and cost < self.cost:
            self.cost = cost
            self.motion = motion
        return hit

    def _timed(self, pieces: Pieces) -> JointTrajectory | None:
        """A motion slowed down to its limits; None if that does not suffice."""
        arm = self.arm
        motion = JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)
        orders = dict(zip(QUANTITIES[1:], (1, 2, 3), strict=True))
        shares = [peak.ratio ** (1 / orders[peak.quantity]) for peak in motion.check_limits().peaks if peak.quantity in orders]
        motion = motion.scaled(1.0 / ((1.0 + _LIMIT_SHARE_ROUNDING) * max(1.0, *shares)))
        if not motion.check_limits().ok:
            return None
        for _ in range(_STRETCHES):
            check = check_torque(arm, motion)
            if check.ok:
                return motion
            motion = motion.scaled(1.0 / stretch_for(check.ratio))
        return None
