"""What a gate makes of one question: the fastest motion that is proved, or the longest beginning of one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice

import numpy as np

from armctl.core.errors import LimitError, PlanError
from armctl.core.pose import Pose
from armctl.core.result import Verdict
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.motion.checks import limits_from
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.timing.end_limits import room_to_stop
from armctl.plan.motion.timing.otg import JointState
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import POSITION_TOLERANCE, is_inside, stretch_needed
from armctl.plan.motion.trajectory.path_stop import resting_at_end, stopped
from armctl.plan.motion.trajectory.piecewise import Pieces, hermite, sample, standing, time_scaled
from armctl.plan.stream.committed_motion import CommittedMotion, end_state
from armctl.plan.stream.nearest_safe import nearest_safe
from armctl.plan.stream.refusal import Refusal, quick_refusal, rest_refusal
from armctl.plan.stream.timed_targets import Knots, TimedTargets

# Paces that are tried one after another; they are shares of what the limits allow.
_PACES = (1.0, 0.7, 0.5, 0.25)
_SHOWN_PACE = 0.995  # a higher one is not worth a word
_HALVINGS = 5  # of the time at which a motion that is refused begins to brake
_LINE_SHARES = (0.995, 0.98, 0.9, 0.75, 0.5, 0.25)  # of the free part of a line, at whose end an arm may come to rest


@dataclass(frozen=True, eq=False)
class GateAnswer(Verdict):
    """What a gate makes of what was asked for. `bool(answer)` is `answer.ok`.

    Attributes:
        ok: Whether `motion` is what was asked for, at the pace that is possible.
        motion: What may be sent to the motors. It begins at the state that was given, keeps all limits, and ends at rest. If
            not ok, it is the longest beginning that was found, at worst a stop.
        proved: Whether the motion is proved to touch nothing. False only where the arm moves so fast, or is so near to a body
            when it is seen, that no stop was proved; the motion then is the fastest stop.
        pace: The share of the speed that was asked for: 1, or less where the limits or the clearance need a slower motion.
        reason: Why it is not ok, in one sentence; empty if it is.
        bodies: The two bodies that would touch; empty if something else is in the way.
        time: s into the motion that was asked for, when they would; infinite if no contact is the reason.
        distance: m between them at that time, zero or less if they overlap; NaN if no contact is the reason.
        asked: (n,) rad, where the motion that was asked for ends.
    """

    ok: bool
    motion: JointTrajectory
    proved: bool
    pace: float
    reason: str
    bodies: tuple[str, ...]
    time: float
    distance: float
    asked: Array
    _search: Callable[[], Array | None] = field(repr=False)
    _arm: Arm = field(repr=False)

    @cached_property
    def nearest(self) -> Array | None:
        """(n,) rad, the nearest configuration to `asked` that is inside the limits and touches nothing; it takes milliseconds.

        Nearest by the Euclidean norm over the joints. The way to it may be blocked; `move_free` finds one. None if none was
        found.
        """
        return self._search()

    @property
    def nearest_pose(self) -> Pose | None:
        """T_world_tip of `nearest`, of several tips that of the first; None if none was found."""
        return None if self.nearest is None else self._arm.fk(self.nearest, self._arm.tip)

    def __str__(self) -> str:
        if self.ok:
            slower = f", at {100.0 * self.pace:.0f} % of the pace" if self.pace < _SHOWN_PACE else ""
            return f"a motion of {self.motion.duration:.2f} s{slower}"
        if self.nearest_pose is None:
            return f"{self.reason}; no safe configuration was found"
        position = ", ".join(f"{x:.3f}" for x in self.nearest_pose.position)
        return f"{self.reason}; the nearest safe pose has the tip at ({position}) m"


class Admission:
    """One question to a gate."""

    def __init__(self, arm: Arm, checker: CollisionChecker, clearance: float, start: Setpoint, running: Pieces | None = None):
        """From a start, which may be that of a motion that is running."""
        self.start = start
        self._running = running
        self._arm = arm
        self._checker = checker
        _, distance = checker.nearest(start.q)
        self._required = clearance
        # An arm that is nearer to something already must be able to leave it.
        self._clearance = clearance if distance > clearance else 0.5 * max(distance, 0.0)
        # Why no motion from the state can be proved: it touches something already.
        self.blocked = rest_refusal(checker, start.q, 0.0) if distance <= 0.0 else None
        self._planner = CommittedMotion(arm, checker, clearance=self._clearance, finds_first=True)
        self._state = JointState(start.q, start.v, start.a)
        self._moves = bool(np.any(start.v) or np.any(start.a))

    def targets(self, times: Array | None, q: Array) -> GateAnswer:
        """Through targets (K, n) at times (K,), or as fast as possible to a single one."""
        outside = self._outside(q)
        if outside is not None:
            return self.refused(outside, q[-1])
        q = room_to_stop(self._arm.limits).clamp(q)
        return self._single(q[0]) if times is None else self.chunk(times, q)

    def chunk(self, times: Array, q: Array) -> GateAnswer:
        """Through targets (K, n) inside the limits, at times (K,) from now."""
        if not self._moves and (q == self.start.q).all():
            return self._answer(standing(self.start.q), None, 1.0, q[-1])
        first: Pieces | None = None
        refused: Refusal | None = None
        for pace, pieces in self._ways(times, q):
            if not self._planner.is_refused(pieces):
                return self._answer(pieces, None, pace, q[-1])
            if first is None:
                first = pieces
                refused = self._planner.refusal_of(pieces)
                if self._checker.hit(q[-1], self._clearance) >= 0:
                    break  # no pace helps
        if first is None or refused is None:
            return self._single(q[-1])
        return self._answer(self._shortened(first, refused.time), refused, 1.0, q[-1])

    def motion(self, pieces: Pieces) -> GateAnswer:
        """A whole motion, as fast as it is or as fast as the limits allow."""
        asked = np.asarray(end_state(pieces).q)
        limits = self._arm.limits
        outside = self._outside(sample(pieces, np.linspace(0.0, pieces.knots[-1], 200)).q)
        if outside is not None:
            return self.refused(outside, np.asarray(asked))
        fitting = 1.0 / stretch_needed(pieces, (limits.v_max, limits.a_max, limits.j_max))
        pace = 1.0 if fitting > 1.0 - 1e-6 else fitting
        for share in (1.0,) if self._moves else _PACES:
            slower = pieces if pace * share == 1.0 or self._moves else time_scaled(pieces, pace * share)
            if not self._keeps_limits(slower):
                continue
            refused = self._planner.refusal_of(slower)
            if refused is None:
                return self._answer(slower, None, pace * share, asked)
            return self._answer(self._shortened(slower, refused.time), refused, pace * share, asked)
        return self.refused(Refusal("the motion breaks a limit of speed, acceleration, jerk or torque"), asked)

    def refused(self, refusal: Refusal, asked: Array) -> GateAnswer:
        """A refusal of something to which no motion leads: the arm stops."""
        return self._answer(None, refusal, 1.0, asked)

    def _single(self, goal: Array) -> GateAnswer:
        """As fast as possible to a place (n,) inside the limits, straight from rest."""
        if not self._moves:
            return self._straight(goal)
        pieces = self._planner.to_rest(self._state, goal)
        if pieces is not None:
            return self._answer(pieces, None, 1.0, goal)
        refused = self._planner.refused
        limits = self._arm.limits
        for pace in _PACES[1:]:
            # Only the speed is less: an arm that brakes as hard as before turns sooner to the straight way.
            slower = CommittedMotion(
                self._arm.with_limits(replace(limits, v_max=pace * limits.v_max)),
                self._checker,
                clearance=self._clearance,
                finds_first=True,
            )
            pieces = slower.to_rest(self._state, goal)
            if pieces is not None:
                return self._answer(pieces, None, pace, goal)
            refused = refused or slower.refused
        refused = refused or Refusal("no motion inside the limits leads there from this state")
        return self._answer(self._planner.plan(self._state, 0.0, Knots.resting(goal)), refused, 1.0, goal)

    def _straight(self, goal: Array) -> GateAnswer:
        """From rest on a straight line of the joints to a place (n,)."""
        start = self.start.q
        try:
            whole = move_j(self._arm, start, goal).pieces
        except PlanError as error:
            return self._answer(None, Refusal(str(error)), 1.0, goal)
        refused = self._planner.refusal_of(whole)
        if refused is None:
            return self._answer(whole, None, 1.0, goal)
        way = goal - start
        longest = int(np.abs(way).argmax())
        there = sample(whole, np.array([refused.time])).q[0]
        for share in _LINE_SHARES:
            free = share * float((there - start)[longest] / way[longest])
            try:
                shorter = move_j(self._arm, start, start + free * (goal - start)).pieces
            except PlanError:
                break
            if not self._planner.is_refused(shorter):
                return self._answer(shorter, refused, 1.0, goal)
        return self._answer(None, refused, 1.0, goal)

    def _ways(self, times: Array, q: Array) -> Iterator[tuple[float, Pieces]]:
        """Motions inside the limits to or through all targets, with their paces, the fastest first."""
        limits = self._arm.limits
        source = TimedTargets(self.start.q, limits.v_max, limits.a_max)
        source.push_chunk(times, q)
        knots = source.knots(0.0)
        yield from ((1.0, pieces) for pieces in islice(self._planner.through(self._state, knots), 1))
        # An arm that cannot be in time at the first targets catches up with them.
        late = self._planner.wanted(self._state, knots)
        if late is not None:
            yield min(1.0, float(times[-1] / late.knots[-1])), late
        yield from self._braking_ways(knots)
        for pace in self._possible_paces(knots):
            slower = self._planner.through(self._state, knots.slowed(pace, 0.0))
            yield from ((pace, pieces) for pieces in islice(slower, 1))

    def _braking_ways(self, knots: Knots) -> Iterator[tuple[float, Pieces]]:
        """Through all targets without a turn back: the arm brakes on the way to the last one, however suddenly a chunk ends."""
        if len(knots.t) < 2:
            return
        limits = self._arm.limits
        v = knots.v.copy()
        v[-1] = (knots.q[-1] - knots.q[-2]) / (knots.t[-1] - knots.t[-2])
        for pace in _PACES:
            for way in islice(self._planner.ways(self._state, knots._replace(v=v).slowed(pace, 0.0)), 1):
                motion = resting_at_end(way, limits)
                if motion is not None and self._keeps_limits(motion):
                    yield min(pace, float(knots.t[-1] / motion.knots[-1])), motion

    def _possible_paces(self, knots: Knots) -> Iterator[float]:
        """Paces below 1 at which the way through wanted states keeps the limits on speed, acceleration and jerk."""
        limits = self._arm.limits
        states = [np.vstack([first, rest]) for first, rest in zip(self._state, knots[1:4], strict=True)]
        way = hermite(np.append(0.0, knots.t), *states)
        fitting = min(1.0, 1.0 / stretch_needed(way, (limits.v_max, limits.a_max, limits.j_max)))
        return (share * fitting for share in _PACES if share * fitting < 1.0)

    def _shortened(self, pieces: Pieces, time: float) -> Pieces | None:
        """The motion up to a stop on its path as late as it is proved; None if none is."""
        best: Pieces | None = None
        low = 0.0
        high = min(time, float(pieces.knots[-1]))
        moment = 0.0 if self._moves else 0.5 * high
        for _ in range(_HALVINGS):
            stop = self._stopped(pieces, moment)
            if stop is not None and not self._planner.is_refused(stop):
                best = stop
                low = moment
            elif moment == 0.0:
                break
            else:
                high = moment
            moment = 0.5 * (low + high)
        return best

    def _stopped(self, pieces: Pieces, moment: float) -> Pieces | None:
        """The motion with a stop on its path from a time on; None if none keeps the limits."""
        try:
            stop = stopped(pieces, limits_from(self._arm.limits, self.start), moment)
        except PlanError:
            return None
        return stop if self._keeps_limits(stop) else None

    def _last_resort(self) -> tuple[Pieces, bool]:
        """The fastest stop or that on the path, whichever keeps the clearance, or else touches nothing; whether one does."""
        if not self._moves:
            return standing(self.start.q), rest_refusal(self._checker, self.start.q, 0.0) is None
        fastest = self._planner.stop(self._state)
        on_path = None if self._running is None else self._stopped(self._running, 0.0)
        stops = [stop for stop in (fastest, on_path) if stop is not None]
        if not stops:
            raise LimitError("state: the arm cannot stop inside its limits from this state; start slower")
        for clearance in (self._clearance, 0.0):
            for stop in stops:
                if quick_refusal(self._checker, stop, clearance) is None:
                    return stop, True
        return stops[0], False

    def _keeps_limits(self, pieces: Pieces) -> bool:
        arm = self._arm
        if not is_inside(pieces, limits_from(arm.limits, self.start)):
            return False
        return check_torque(arm, JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)).ok

    def _outside(self, q: Array) -> Refusal | None:
        """Why positions (K, n) cannot be reached: the first one outside its limits."""
        limits = self._arm.limits
        below = limits.q_min - q
        above = q - limits.q_max
        beyond = np.maximum(below, above) > POSITION_TOLERANCE
        if not beyond.any():
            return None
        k, joint = np.argwhere(beyond)[0].tolist()
        bound = limits.q_min[joint] if below[k, joint] > 0 else limits.q_max[joint]
        side = "least" if below[k, joint] > 0 else "most"
        name = self._arm.joint_names[joint]
        return Refusal(f"{name} would be at {q[k, joint]:.4g} {self._arm.units[joint]}, at {side} {bound:.4g} is allowed")

    def _answer(self, pieces: Pieces | None, refused: Refusal | None, pace: float, asked: Array) -> GateAnswer:
        """The answer: the motion, or if there is none a stop."""
        arm = self._arm
        proved = True
        if pieces is None and self._running is not None and not self._planner.is_refused(self._running):
            pieces = self._running
        elif pieces is None:
            pieces, proved = self._last_resort()
        known = [self.start.q, np.asarray(end_state(pieces).q)]
        checker = self._checker
        clearance = self._required
        why = Refusal("") if refused is None else refused
        return GateAnswer(
            ok=refused is None,
            motion=JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units),
            proved=proved,
            pace=pace,
            reason=why.reason,
            bodies=why.bodies,
            time=why.time,
            distance=why.distance,
            asked=asked,
            _search=lambda: nearest_safe(checker, arm.limits, asked, [*known, arm.home], clearance),
            _arm=arm,
        )
