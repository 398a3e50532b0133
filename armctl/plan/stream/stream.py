"""Stream: setpoints within all limits from targets that arrive in time, late, never, or all at once."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.pose import Pose, computed_pose
from armctl.core.region import Region
from armctl.core.target import Target, TargetLike
from armctl.core.tip_targets import Stay, TipTargets, targets_by_tip
from armctl.core.trajectory import Setpoint, TickReference
from armctl.core.validation import Array, instance, integer, matrix, number, shown, vector
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.model.collision.checkers import avoided, checkable
from armctl.model.collision.world_snapshot import WorldLike
from armctl.plan.ik.differential import DifferentialIk
from armctl.plan.ik.ik_result import FAR_M
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.checks import planning_arm, start_state
from armctl.plan.motion.timing.end_limits import room_to_stop
from armctl.plan.motion.timing.otg import JointState
from armctl.plan.motion.trajectory.path_stop import remaining
from armctl.plan.motion.trajectory.piecewise import Pieces, basis, standing
from armctl.plan.stream.committed_motion import CommittedMotion, end_state
from armctl.plan.stream.timed_targets import Rates, TimedTargets
from armctl.plan.stream.twist import twist_targets

MAX_TARGETS = 1000  # of a chunk
MAX_AHEAD_S = 60.0  # of a target: a later one has a wrong clock
_MAX_TICKS = 1_000_000  # in one answer
_HISTORY_TICKS = 2000  # of past setpoints, with which late targets are compared
_AT_LIMIT = 0.999  # share of a limit
_TICKS_PER_LIMIT_CHECK = 8  # a tick takes a third longer with a check
# A joint that turns further for a smaller step of the target changes the posture of the arm.
_POSTURE_CHANGE = 0.5  # rad (m)
_STEPS_BY_TIP = 8  # of differential inverse kinematics, from target to target
_SMALL_STEP_M = 0.05
_SMALL_STEP_RAD = 0.2


@dataclass(frozen=True)
class StreamReport:
    """What a stream did so far.

    Attributes:
        lag_s: s by which the arm is behind its targets, at the times for which they were meant; negative if it is ahead.
        rms: rad (m for a slide joint), root mean square of the distance between arm and targets at those times, over joints.
        targets: How many targets were taken, those of chunks among them.
        late: How many of them were meant for a time that had passed already. Single targets usually are; their motion is
            predicted from there on.
        dropped: How many were not newer than the last one, or past when their chunk arrived.
        clamped: How many were outside the position limits, and were moved to the nearest position inside.
        refused: How many pushes did not change the motion, because no motion within the limits was found.
        at_velocity_limit: Share of the ticks at which a joint had its greatest speed.
        at_acceleration_limit: Share of the ticks at which a joint had its greatest acceleration.
        obstacle: What the arm stopped for at the last push, or why its motion was refused; empty if nothing was in the way.
    """

    lag_s: float
    rms: float
    targets: int
    late: int
    dropped: int
    clamped: int
    refused: int
    at_velocity_limit: float
    at_acceleration_limit: float
    obstacle: str


class _TakenMotion(NamedTuple):
    """The motion that a stream follows up to rest, in the form that its setpoints need."""

    begin: float  # s, in the stream's time
    duration: float  # s
    knots: list[float]  # s, of the pieces
    coefficients: Array
    pieces: Pieces
    rest: Array  # (n,) rad

    @classmethod
    def from_pieces(cls, pieces: Pieces, begin: float) -> _TakenMotion:
        knots = pieces.knots.tolist()
        return cls(begin, knots[-1], knots, pieces.coefficients, pieces, np.asarray(end_state(pieces).q))


class Stream:
    """Timed targets become setpoints within position, velocity, acceleration, jerk and torque limits.

    Each push plans a motion that ends at rest, and replaces the one that runs. So the arm comes to rest, within all limits, if
    nothing more arrives. A tick only evaluates that motion.

    ```python
    stream = armctl.Stream(arm, arm.home)
    stream.push(stream.t, q)
    setpoint = stream.step(0.001)
    ```
    """

    def __init__(
        self,
        arm: Arm,
        q_start: ArrayLike | Setpoint,
        *,
        speed: float = 1.0,
        avoid: bool = False,
        refusal: Callable[[Pieces], str] | None = None,
        world: WorldLike | None = None,
    ):
        """A stream whose time begins at 0.

        Args:
            q_start: (n,) rad, inside the limits; or a setpoint, from which the arm comes to rest. A velocity or acceleration
                beyond its limit is first reduced to the limit as fast as the others allow.
            speed: Factor on the limits, in (0, 1].
            avoid: Whether each motion is proved free of contact with the scene as it is at home before it is taken.
            refusal: Why a motion, given as polynomials from now on, may not be made; empty if it may. Where a motion is
                refused, the arm moves as far towards it as a shorter one may be made.
            world: What is around the arm besides its scene, with `avoid`: a World, of which each motion is proved in the newest
                state, or a snapshot of one.

        Raises:
            InputError: A wrong length or type, a number that is not finite, or an arm without limits on velocity,
                acceleration or jerk.
            LimitError: A start outside the position limits, or so fast that no stop inside them is possible.
            ModelError: `avoid`, and a link has no collision shape.
        """
        self._arm = planning_arm(arm, number("speed", speed, 1e-3, 1.0))
        start = start_state(self._arm, q_start)
        avoided(self._arm, avoid, world)
        self._world = world
        checker = checkable(self._arm, world) if avoid else None
        if refusal is not None and not callable(refusal):
            raise InputError(f"refusal: expected a function of a motion's pieces, got {shown(refusal)}")
        self._planner = CommittedMotion(self._arm, checker, refusal)
        self._targets = TimedTargets(start.q, self._arm.limits.v_max, self._arm.limits.a_max)
        self._limits = self._arm.limits
        self._rest_range = room_to_stop(self._arm.limits)  # where targets are moved to
        self._v_limit = _AT_LIMIT * self._limits.v_max
        self._a_limit = _AT_LIMIT * self._limits.a_max
        self._t = 0.0
        self._counts = dict.fromkeys(("targets", "late", "dropped", "clamped", "refused"), 0)
        self._ticks = 0
        self._at_limit = np.zeros(2)
        self._past: deque[tuple[float, Array, Array]] = deque(maxlen=_HISTORY_TICKS)
        self._sums = np.zeros(4)  # of v e, v v, e e, and their number
        self._obstacle = ""
        self._device: tuple[Pose, Pose] | None = None
        self._held: dict[str, Pose] = {}  # where tips stay
        self._previous: Array | None = None
        pieces = self._planner.stop(JointState(start.q, start.v, start.a))
        if pieces is None:
            raise LimitError("q_start: the arm cannot stop inside its limits from this start; start slower")
        self._motion = _TakenMotion.from_pieces(pieces, 0.0)

    @property
    def t(self) -> float:
        """The time of the stream, s: the sum of its steps."""
        return self._t

    @property
    def setpoint(self) -> Setpoint:
        """The current setpoint: q, v, a, each (n,)."""
        begin, duration, knots, coefficients, _, _ = self._motion
        u = min(self._t - begin, duration)
        k = min(bisect_right(knots, u), len(knots) - 1) - 1
        return Setpoint(*np.array(basis(u - knots[k])).dot(coefficients[k]))

    @property
    def time_left(self) -> float:
        """The time until the arm is at rest, s, if nothing more arrives."""
        return max(0.0, self._motion.begin + self._motion.duration - self._t)

    @property
    def pieces(self) -> Pieces:
        """The motion from now on, up to rest, as polynomials."""
        if self.time_left == 0.0:
            return standing(self._motion.rest)
        return remaining(self._motion.pieces, self._t - self._motion.begin)

    @property
    def report(self) -> StreamReport:
        """What the stream did so far."""
        ve, vv, ee, count = self._sums
        checks = max(self._ticks // _TICKS_PER_LIMIT_CHECK, 1)
        return StreamReport(
            lag_s=float(ve / vv) if vv > 0 else 0.0,
            rms=float(np.sqrt(ee / count)) if count else 0.0,
            **self._counts,
            at_velocity_limit=float(self._at_limit[0] / checks),
            at_acceleration_limit=float(self._at_limit[1] / checks),
            obstacle=self._obstacle,
        )

    def push(self, t: float, q: ArrayLike, v: ArrayLike | None = None, a: ArrayLike | None = None) -> None:
        """Takes a target, predicts how the targets go on, and follows them; if none follows, the arm rests at this one.

        A velocity, as of a conveyor that is measured, replaces the prediction from earlier targets: the arm then follows from
        the first target on.

        A target that is not newer than the last one changes nothing. One outside the position limits is moved inside; one that
        is half a turn (1 m) outside, as degrees are, is refused.

        Args:
            t: s, in the stream's time, when the arm should be there. Usually it has passed: the time of a measurement.
            q: (n,) rad.
            v: (n,) rad/s, how fast the target moves then; None if that is not known.
            a: (n,) rad/s^2, its acceleration; needs v.

        Raises:
            InputError: A wrong length, a number that is not finite, or a time more than a minute ahead; nothing changes.
            LimitError: A position far outside the limits; nothing changes.
        """
        time = self._time("t", t)
        target = vector("q", q, self._arm.n)
        rates = _rates(v, a, target.shape)
        target = self._clamped(target[None])[0]
        if time <= self._targets.newest:
            self._counts["dropped"] += 1
            return
        if time > self._t + self._targets.interval:
            self.push_chunk([time], [target], *(None if x is None else x[None] for x in rates or (None, None)))
            return
        self._counts["targets"] += 1
        self._counts["late"] += time < self._t
        self._compare(time, target)
        self._targets.push(time, target, self._t, rates)
        self._plan()

    def push_chunk(self, times: ArrayLike, q: ArrayLike, v: ArrayLike | None = None, a: ArrayLike | None = None) -> None:
        """Takes a list of targets, as policies emit them. It replaces the earlier ones from its first time on.

        The arm passes each target at its time if the limits allow, and rests at the last one. Those that are past already are
        left out.

        Args:
            times: (K,) s, increasing, in the stream's time.
            q: (K, n) rad, the targets.
            v: (K, n) rad/s, how fast the arm passes them; None for the parabolas through neighbors, and rest at the last one.
                An arm that passes the last one in motion turns back to it, if no other chunk comes.
            a: (K, n) rad/s^2, its accelerations there; needs v.

        Raises:
            InputError: Wrong shapes, more than 1000 targets, numbers that are not finite, times that do not increase or are
                more than a minute ahead; nothing changes.
            LimitError: A position far outside the limits; nothing changes.
        """
        t = vector("times", times)
        targets = matrix("q", q, self._arm.n)
        if len(targets) != len(t):
            raise InputError(f"q: {len(targets)} targets for {len(t)} times; each target needs one")
        if not 1 <= len(t) <= MAX_TARGETS:
            raise InputError(f"times: a chunk has 1 to {MAX_TARGETS} targets, got {len(t)}")
        if (np.diff(t) <= 0).any():
            raise InputError("times: they must increase from target to target")
        rates = _rates(v, a, targets.shape)
        self._time("times", float(t[-1]))
        clamped = self._clamped(targets)
        ahead = t > self._t
        self._counts["dropped"] += int((~ahead).sum())
        self._counts["targets"] += int(ahead.sum())
        if not ahead.any():
            return
        self._targets.push_chunk(t, clamped, rates)
        self._plan()

    def push_pose(self, t: float, target: TargetLike | Region | TipTargets) -> None:
        """Takes a target of the tip: inverse kinematics makes it a target of the joints, near the last one.

        The nearest point is used instead of one out of reach. Where the target moves on, but only another posture of the arm
        reaches it, such as behind a singular configuration, the arm keeps its posture and comes as near as it can.

        Args:
            t: s, in the stream's time; at most a minute ahead.
            target: T_world_tip, or (3,) m if any orientation is accepted; after `clutch`, in the frame of the device; or
                targets by tip, as for `solve_ik`, in the world.

        Raises:
            InputError: A wrong shape, a number that is not finite, or a time more than a minute ahead; nothing changes.
            LimitError: The target is more than 10 m out of reach, as one in millimetres; nothing changes.
        """
        time = self._time("t", t)
        if isinstance(target, Mapping):
            self.push(time, self._configuration_by_tip(target))
            return
        check_one_tip(self._arm)
        if isinstance(target, Region):
            target = target.nearest(self._arm.fk(self._targets.rest)).pose
        goal = Target.read(target)
        if self._device is not None and goal.pose is not None:
            goal = Target.read(self._reanchored(goal.pose), goal.tolerance, goal.angle_tolerance)
        last = self._targets.rest
        solution = solve_ik(self._arm, goal, last)
        if solution.position_error > FAR_M:
            raise LimitError(f"target: {solution.reason}")
        q = solution.q
        position_error, angle = goal.distance(self._arm.fk(last))
        if np.abs(q - last).max() > _POSTURE_CHANGE and position_error < _SMALL_STEP_M and angle < _SMALL_STEP_RAD:
            q = self._rest_range.clamp(last + self._targets.interval * self._ik.step(last, goal, self._targets.interval))
        self.push(time, q)

    def _configuration_by_tip(self, targets: TipTargets) -> Array:
        """(n,) rad, the configuration for targets by tip, near the last one."""
        arm = self._arm
        last = self._targets.rest
        staying = {tip for tip, target in targets.items() if isinstance(target, Stay)}
        held = {tip: self._held[tip] if tip in self._held else arm.fk(last, tip) for tip in staying}
        solution = solve_ik(arm, targets_by_tip(targets, held), last)
        if solution.position_error > FAR_M:
            raise LimitError(f"target: {solution.reason}")
        self._held = held
        if np.abs(solution.q - last).max() <= _POSTURE_CHANGE:
            return solution.q
        # As for a single target: a small step keeps the posture.
        moved = [np.linalg.norm(arm.fk(solution.q, tip).position - arm.fk(last, tip).position) for tip in targets]
        if max(moved) >= _SMALL_STEP_M:
            return solution.q
        self._ik.reset()
        q = last
        step = self._targets.interval / _STEPS_BY_TIP
        for _ in range(_STEPS_BY_TIP):
            q = q + step * self._ik.step(q, targets_by_tip(targets, held), step)
        return self._rest_range.clamp(q)

    def push_twist(self, linear: ArrayLike, angular: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Takes a velocity of the tip, as a joystick gives it. The arm comes to rest if it is not renewed within 0.2 s.

        Args:
            linear: (3,) m/s, world axes.
            angular: (3,) rad/s, world axes.

        Raises:
            InputError: A wrong length or a number that is not finite; nothing changes.
        """
        targets = twist_targets(
            self._arm, self._ik, self.setpoint.q, vector("linear", linear, 3), vector("angular", angular, 3)
        )
        self._targets.rest_at(targets.q[-1])
        self.push_chunk(self._t + targets.t, targets.q)

    def clutch(self, device: Pose) -> None:
        """Takes the pose that a hand-held device has now for the pose that the tip has now, so that neither has to move.

        From now on a pose that is given to `push_pose` moves the tip by as much as it differs from this one.

        Args:
            device: The device's pose, in any frame whose axes are those of the world.

        Raises:
            InputError: It is no Pose.
        """
        instance("device", device, Pose, "Pose([0, 0, 0]) is one")
        self._device = (device, self._arm.fk(self.setpoint.q))
        self._targets.rest_at(self._motion.rest)

    def _reanchored(self, pose: Pose) -> Pose:
        assert self._device is not None
        device, tip = self._device
        return computed_pose(tip.position + pose.position - device.position, pose.rotation @ device.rotation.T @ tip.rotation)

    @cached_property
    def _ik(self) -> DifferentialIk:
        """Made at its first use, because its imports take long."""
        return DifferentialIk(self._arm)

    def stop(self) -> None:
        """Stops as soon as the limits allow, and forgets all targets."""
        pieces = self._planner.stop(self._state())
        if pieces is not None:
            self._motion = _TakenMotion.from_pieces(pieces, self._t)
        self._targets.rest_at(self._motion.rest)

    def restart(self, t: float, q: ArrayLike) -> None:
        """Forgets all targets and rests from now on, as where a robot came to rest because a motion reached it too late.

        Args:
            t: s, the time of the stream now, at least the present one.
            q: (n,) rad, where the arm rests.

        Raises:
            InputError: A wrong length or an earlier time; nothing changes.
            LimitError: A position outside its limits; nothing changes.
        """
        rest = self._arm.checked("q", q)
        self._t = number("t", t, self._t)
        self._previous = None
        self._targets.rest_at(rest)
        self._motion = _TakenMotion.from_pieces(standing(rest), self._t)

    def step(self, dt: float) -> Setpoint:
        """Advances by one tick.

        Args:
            dt: s, the tick, at least 0.

        Returns:
            q, v, a at its end, each (n,).

        Raises:
            InputError: dt is no number, less than 0 or not finite.
        """
        self._t += number("dt", dt, 0.0)
        point = self.setpoint
        self._past.append((self._t, point.q, point.v))
        self._ticks += 1
        if self._ticks % _TICKS_PER_LIMIT_CHECK == 0:
            self._at_limit += ((np.abs(point.v) >= self._v_limit).any(), (np.abs(point.a) >= self._a_limit).any())
        return point

    def reference(self, ticks: int, dt: float, continuous: bool = False) -> TickReference:
        """Advances by some ticks, as references for the tick loop.

        Args:
            ticks: How many.
            dt: s, the tick.
            continuous: Whether the arm moves almost continuously between ticks, so that its velocity is no
                difference of positions.

        Returns:
            The setpoints from now on.

        Raises:
            InputError: The number of ticks is not from 1 to 1 million, or the tick not above 0.
        """
        points = [self.setpoint, *(self.step(dt) for _ in range(integer("ticks", ticks, 1, _MAX_TICKS)))]
        q = np.array([point.q for point in points])
        v = np.array([point.v for point in points])
        before = q[0] - dt * v[0] if self._previous is None else self._previous
        self._previous = q[-2]
        return TickReference.between(q, v, np.array([point.a for point in points]), before, dt, continuous)

    def _time(self, what: str, t: float) -> float:
        time = number(what, t)
        if time > self._t + MAX_AHEAD_S:
            raise InputError(f"{what}: {time:g} s is more than {MAX_AHEAD_S:g} s ahead of the stream's time, {self._t:g} s")
        return time

    def _clamped(self, targets: Array) -> Array:
        inside = np.clip(targets, self._rest_range.q_min, self._rest_range.q_max)
        outside = (inside != targets).any(axis=1)
        if outside.any():
            self._arm.check_units("q", targets)
        self._counts["clamped"] += int(outside.sum())
        return inside

    def _compare(self, t: float, target: Array) -> None:
        """Compares a target with where the arm was at its time."""
        k = len(self._past) - 1
        while k > 0 and self._past[k - 1][0] >= t:
            k -= 1
        if k < 0 or self._past[k][0] < t:
            return
        _, q, v = self._past[k]
        error = target - q
        self._sums += np.array([v @ error, v @ v, error @ error / len(q), 1.0])

    def _plan(self) -> None:
        if self._world is not None:
            self._planner.checker = checkable(self._arm, self._world)  # the newest one
        pieces = self._planner.plan(self._state(), self._t, self._targets.knots(self._t))
        self._obstacle = self._planner.obstacle
        if pieces is None:
            self._counts["refused"] += 1
        else:
            self._motion = _TakenMotion.from_pieces(pieces, self._t)

    def _state(self) -> JointState:
        point = self.setpoint
        return JointState(point.q, point.v, point.a)


def _rates(v: ArrayLike | None, a: ArrayLike | None, shape: tuple[int, ...]) -> Rates | None:
    """A caller's velocities and accelerations of targets of a shape (n,) or (K, n); None if they are not given."""
    if v is None:
        if a is not None:
            raise InputError("a: accelerations need the velocities, too; give v")
        return None
    return Rates(_rate("v", v, shape), None if a is None else _rate("a", a, shape))


def _rate(what: str, given: ArrayLike, shape: tuple[int, ...]) -> Array:
    values = vector(what, given, shape[0]) if len(shape) == 1 else matrix(what, given, shape[1])
    if values.shape != shape:
        raise InputError(f"{what}: {len(values)} rows for {shape[0]} targets; each target needs one")
    return values
