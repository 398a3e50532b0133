"""Plans what a stream commits to: through the wanted states as far as limits allow, and then to rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.motion.checks import limits_from
from armctl.plan.motion.timing.end_limits import END_SHARES
from armctl.plan.motion.timing.otg import JointState, Profile, ProfileSolver
from armctl.plan.motion.torque_limits import InverseDynamics
from armctl.plan.motion.trajectory.limit_check import POSITION_TOLERANCE, RATIO_TOLERANCE, each_inside, is_inside
from armctl.plan.motion.trajectory.piecewise import JointSamples, Pieces, basis, hermite, joined, quintics, sample
from armctl.plan.stream.refusal import Refusal, contact_refusal, quick_refusal
from armctl.plan.stream.timed_targets import Knots

# Paces of the wanted states that are tried where a motion through them is refused, before it is made shorter.
_PACES = (0.5, 0.25)
# Factors on acceleration limits that are tried one after another where motors are too weak; squared for jerk.
_SLOWER = (1.0, 0.5, 0.25)
_TORQUE_STEP_S = 0.01  # between samples of the torques
_TORQUE_MARGIN = 0.02  # of the limits, for what is between the samples
LIVE_CLEARANCE_M = 1e-3  # of a reference that follows live: half of what a planned path keeps
_MIN_SEGMENT_S = 1e-3
_WAY_SHARES = (0.5, 0.25, 0.12, 0.0)  # of the way to a place that is refused; shorter motions are slower


class CommittedMotion:
    """Plans motions of an arm that keep all limits and end at rest, and that nobody refuses."""

    def __init__(
        self,
        arm: Arm,
        checker: CollisionChecker | None = None,
        refusal: Callable[[Pieces], str] | None = None,
        clearance: float = LIVE_CLEARANCE_M,
        *,
        finds_first: bool = False,
    ):
        """Motions of an arm; with `finds_first` a refusal has the first time of a contact, which takes longer."""
        self._limits = arm.limits
        limits = arm.limits
        self._solvers = [ProfileSolver(limits.v_max, s * limits.a_max, s**2 * limits.j_max) for s in _SLOWER]
        if limits.depends_on_position:
            gentle = [np.minimum(limits.a_max, share * limits.deceleration_limit) for share in END_SHARES]
            self._solvers[1:] = [ProfileSolver(limits.v_max, a_max, limits.j_max) for a_max in gentle] + [
                ProfileSolver(limits.v_max, s * gentle[-1], s**2 * limits.j_max) for s in _SLOWER[1:]
            ]
        self._zero = [0.0] * arm.n
        self._q_min = (limits.q_min - POSITION_TOLERANCE).tolist()
        self._q_max = (limits.q_max + POSITION_TOLERANCE).tolist()
        self._dynamics = InverseDynamics(arm)
        self._tau_max = (1 - _TORQUE_MARGIN) * limits.tau_max
        self.checker = checker  # proves motions free of contact; None if contacts are allowed
        self.clearance = clearance  # m, that is proved
        self._contact_refusal = contact_refusal if finds_first else quick_refusal
        self.refusal = refusal  # why a motion, as polynomials from now on, may not be made; empty if it may. None if all may
        self.refused: Refusal | None = None  # why the last motion that was wanted was refused; None if it was not

    @property
    def obstacle(self) -> str:
        """Why the last motion that was wanted was refused; empty if it was not."""
        return "" if self.refused is None else self.refused.what

    def plan(self, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """A motion through the wanted states, over times from 0, that stops before an `obstacle`; None if none was found.

        Where the motion is refused, slower ones through the same states are tried first.
        """
        self.refused = None
        for solver in self._solvers:
            pieces = self._motion(solver, start, now, knots)
            if pieces is None or not self._is_feasible(pieces):
                continue
            refused = self.refusal_of(pieces)
            if refused is None:
                return pieces
            slower = self._slower(solver, start, now, knots)
            return slower if slower is not None else self._before(refused, solver, start, now, knots)
        return None

    def ways(self, start: JointState, knots: Knots) -> Iterator[Pieces]:
        """Motions inside the limits through all wanted states but the first ones, up to the last one; now is the time 0."""
        for followed, after in self._followed(start, 0.0, knots):
            if after == len(knots.t):
                yield followed

    def through(self, start: JointState, knots: Knots) -> Iterator[Pieces]:
        """As `ways`, and then to rest."""
        for way in self.ways(start, knots):
            motion = self._rejoining(self._solvers[0], start, 0.0, knots, [way], len(knots.t))
            if motion is not None and self._is_feasible(motion):
                yield motion

    def wanted(self, start: JointState, knots: Knots) -> Pieces | None:
        """As `plan`, but the motion is not proved; now is the time 0."""
        pieces = self._motion(self._solvers[0], start, 0.0, knots)
        return pieces if pieces is not None and self._is_feasible(pieces) else None

    def to_rest(self, start: JointState, goal: Array) -> Pieces | None:
        """The fastest motion to rest at a place (n,); None if it breaks a limit, or is refused for an `obstacle`."""
        self.refused = None
        state = _lists(start)
        for solver in self._solvers:
            profile = solver.to_rest(state, goal.tolist(), self._q_min, self._q_max)
            if profile is not None and self._is_feasible(profile.pieces(state)):
                pieces = profile.pieces(state)
                self.refused = self.refusal_of(pieces)
                return pieces if self.refused is None else None
        return None

    def stop(self, start: JointState) -> Pieces | None:
        """A stop from a state, as fast as the limits allow; None if none was found."""
        state = _lists(start)
        for solver in self._solvers:
            profile = self._inside(solver.stop(state))
            if profile is not None and self._is_feasible(profile.pieces(state)):
                return profile.pieces(state)
        return None

    def _motion(self, solver: ProfileSolver, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """Through the wanted states in time as far as that is inside the limits; then the fastest motion that rejoins them."""
        if solver is self._solvers[0]:
            for followed, after in self._followed(start, now, knots):
                motion = self._rejoining(solver, start, now, knots, [followed], after)
                if motion is not None:
                    return motion
        return self._rejoining(solver, start, now, knots, [], 0)

    def _followed(self, start: JointState, now: float, knots: Knots) -> Iterator[tuple[Pieces, int]]:
        """Smooth ways to and along the wanted states, as far as they keep the limits, each with the number of the next one."""
        t = knots.t - now
        states = JointSamples(*knots[1:4])
        first = np.array([join.start for join in knots.joins], dtype=np.int64)
        starts = JointSamples(*(np.tile(x, (len(first), 1)) for x in start))
        joining = quintics(t[first], starts, JointSamples(*(x[first] for x in states)))
        gentle = np.abs(6.0 * joining[:, 3]) <= (1 + RATIO_TOLERANCE) * self._limits.j_max  # the jerk at the start
        possible = np.flatnonzero(gentle.all(axis=1))
        if not len(possible):
            return
        # All ways share what follows, and many pieces are checked in hardly more time than one.
        following = hermite(t, *states).coefficients
        steps = np.concatenate([t[first[possible]], np.diff(t)])
        inside = each_inside(np.concatenate([joining[possible], following]), steps, self._limits)
        for k in possible[inside[: len(possible)]]:
            join = knots.joins[k]
            last = int(first[k]) + 1
            end = len(t) if join.stop is None else min(join.stop, len(t))
            while last < end and inside[len(possible) + last - 1]:
                last += 1
            if join.stop is None or last == end:
                coefficients = np.concatenate([joining[k : k + 1], following[first[k] : last - 1]])
                followed = Pieces(np.append(0.0, t[first[k] : last]), coefficients)
                yield followed, last if join.stop is None else len(t)

    def _rejoining(
        self, solver: ProfileSolver, start: JointState, now: float, knots: Knots, parts: list[Pieces], first: int
    ) -> Pieces | None:
        """Some parts, then each wanted state from one on that can be reached in time, one after another, and then rest."""
        state = end_state(parts[-1]) if parts else start
        t = now + sum(float(part.knots[-1]) for part in parts)
        for k in range(first, len(knots.t)):
            time = float(knots.t[k]) - t
            if time < _MIN_SEGMENT_S:
                continue
            goal = JointState(knots.q[k].tolist(), knots.v[k].tolist(), self._zero)
            profile = self._inside(solver.solve(_lists(state), goal, shortest=time))
            if profile is None or profile.duration > time * (1 + 1e-9):
                continue
            part = profile.pieces(_lists(state))
            parts.append(part)
            state = end_state(part)
            t += float(part.knots[-1])
        # The fastest motion to rest, or if that leaves the limits the fastest stop.
        state = _lists(state)
        profile = solver.to_rest(state, knots.rest.tolist(), self._q_min, self._q_max) or self._inside(solver.stop(state))
        return None if profile is None else joined([*parts, profile.pieces(state)])

    def _inside(self, profile: Profile | None) -> Profile | None:
        """The profile, if it stays inside the position limits."""
        return profile if profile is not None and profile.stays_inside(self._q_min, self._q_max) else None

    def _is_feasible(self, pieces: Pieces) -> bool:
        """Whether a motion keeps all limits that its start allows. A slower stop may come too late for those of a fast arm."""
        start = Setpoint(*(x[0] for x in sample(pieces, np.zeros(1))))
        return is_inside(pieces, limits_from(self._limits, start)) and self._has_torque(pieces)

    def _has_torque(self, pieces: Pieces) -> bool:
        """Whether the motors can follow, at the knots, where accelerations are extreme, and between them."""
        duration = float(pieces.knots[-1])
        times = np.union1d(pieces.knots, np.linspace(0.0, duration, 2 + int(duration / _TORQUE_STEP_S)))
        torques = np.abs(self._dynamics.total(*sample(pieces, times)))
        # A motor that cannot even hold its joint here must not keep the arm from moving to where it can.
        return bool((torques <= np.maximum(self._tau_max, torques[0])).all())

    def is_refused(self, pieces: Pieces) -> bool:
        """Whether a motion may not be made."""
        if quick_refusal(self.checker, pieces, self.clearance) is not None:
            return True
        return self.refusal is not None and pieces.knots[-1] != 0.0 and bool(self.refusal(pieces))

    def refusal_of(self, pieces: Pieces) -> Refusal | None:
        """Why a motion may not be made; None if it may."""
        refused = self._contact_refusal(self.checker, pieces, self.clearance)
        if refused is not None or self.refusal is None or pieces.knots[-1] == 0.0:
            return refused
        reason = self.refusal(pieces)
        return Refusal(reason) if reason else None

    def _slower(self, solver: ProfileSolver, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """The motion through the wanted states at a slower pace, if it is not refused; None if it is."""
        if not len(knots.t) or not (np.any(start.v) or np.any(start.a)):
            return None  # from rest, the way is the same at any pace
        if self.checker is not None and self.checker.hit(knots.rest, self.clearance) >= 0:
            return None  # no pace helps
        for pace in _PACES:
            pieces = self._motion(solver, start, now, knots.slowed(pace, now))
            if pieces is not None and self._is_feasible(pieces) and not self.is_refused(pieces):
                return pieces
        return None

    def _before(self, refused: Refusal, solver: ProfileSolver, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """The longest of some beginnings of the motion that end at rest and are not refused; None if there is none."""
        self.refused = refused
        for shorter in _shorter(knots, start, int(np.searchsorted(knots.t - now, refused.time))):
            # Contact first, because it takes a hundredth of the time.
            moves = (shorter.rest != start.q).any()
            if moves and self.checker is not None and self.checker.hit(shorter.rest, self.clearance) >= 0:
                continue
            pieces = self._motion(solver, start, now, shorter)
            if pieces is not None and not self.is_refused(pieces) and self._is_feasible(pieces):
                return pieces
        return None


def _shorter(knots: Knots, start: JointState, count: int) -> Iterator[Knots]:
    """Beginnings of the wanted motion before one of its states, and then places on the way to its rest."""
    for keep in (count - 1, count // 2):
        if keep > 0 and (knots.q[keep - 1] != knots.rest).any():
            joins = tuple(each for each in knots.joins if each.start < keep)
            yield Knots(knots.t[:keep], knots.q[:keep], knots.v[:keep], knots.a[:keep], knots.q[keep - 1], joins)
    q = np.asarray(start.q)
    for share in _WAY_SHARES:
        yield Knots.resting(q + share * (knots.rest - q))


def end_state(pieces: Pieces) -> JointState:
    q, v, a = np.array(basis(float(pieces.knots[-1] - pieces.knots[-2]))) @ pieces.coefficients[-1]
    return JointState(q, v, a)


def _lists(state: JointState | None) -> JointState:
    assert state is not None
    return JointState(*(np.asarray(x).tolist() for x in state))
