"""Plans what a stream commits to: through the wanted states as far as limits allow, and then to rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armctl.core.validation import Array
from armctl.motion.timing.otg import JointState, ProfileSolver
from armctl.motion.torque_limits import InverseDynamics
from armctl.motion.trajectory.limit_check import is_inside
from armctl.motion.trajectory.piecewise import Pieces, basis, hermite, joined, sample
from armctl.robot.arm import Arm
from armctl.stream.timed_targets import Knots

if TYPE_CHECKING:
    from armctl._core import Hit
    from armctl.collision.checker import CollisionChecker

# Factors on acceleration limits that are tried one after another where motors are too weak; squared for jerk.
_SLOWER = (1.0, 0.5, 0.25)
_TORQUE_STEP_S = 0.01  # between samples of the torques
_TORQUE_MARGIN = 0.02  # of the limits, for what is between the samples
_CLEARANCE_M = 1e-3
_MIN_SEGMENT_S = 1e-3


class CommittedMotion:
    """Plans motions of an arm that keep all limits, end at rest, and are free of contact if a checker is given."""

    def __init__(self, arm: Arm, checker: CollisionChecker | None):
        self._limits = arm.limits
        limits = arm.limits
        self._solvers = [ProfileSolver(limits.v_max, s * limits.a_max, s**2 * limits.j_max) for s in _SLOWER]
        self._q_min = limits.q_min.tolist()
        self._q_max = limits.q_max.tolist()
        self._dynamics = InverseDynamics(arm)
        self._tau_max = (1 - _TORQUE_MARGIN) * limits.tau_max
        self.checker = checker
        self.obstacle = ""

    def plan(self, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """A motion from a state to the wanted ones, over times that begin at 0; None if none was found.

        `obstacle` then names what is in the way: the motion stops before it, or there is none.
        """
        self.obstacle = ""
        for solver in self._solvers:
            pieces = self._motion(solver, start, now, knots)
            if pieces is None or not self._is_feasible(pieces):
                continue
            hit = self._hit(pieces)
            return pieces if hit is None else self._before(hit, solver, start, now, knots)
        return None

    def stop(self, start: JointState) -> Pieces | None:
        """A stop from a state, as fast as the limits allow; None if none was found."""
        for solver in self._solvers:
            profile = solver.stop(_lists(start))
            if profile is not None and profile.stays_inside(self._q_min, self._q_max):
                pieces = profile.pieces(_lists(start))
                if self._is_feasible(pieces):
                    return pieces
        return None

    def _motion(self, solver: ProfileSolver, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """Through all wanted states in time if that is inside the limits, else the fastest motion that rejoins them."""
        if solver is self._solvers[0]:
            for followed in knots.joins:
                t = np.concatenate([[0.0], knots.t[followed] - now])
                smooth = hermite(t, *(np.vstack([x, rows[followed]]) for x, rows in zip(start, knots[1:4], strict=True)))
                if is_inside(smooth, self._limits):
                    return self._ended([smooth], solver, knots.rest)
        return self._rejoining(solver, start, now, knots)

    def _rejoining(self, solver: ProfileSolver, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """Each wanted state that can be reached in time, one after another."""
        parts: list[Pieces] = []
        state = start
        t = now
        for k in range(len(knots.t)):
            time = float(knots.t[k]) - t
            if time < _MIN_SEGMENT_S:
                continue
            goal = JointState(knots.q[k].tolist(), knots.v[k].tolist(), self._zero)
            profile = solver.solve(_lists(state), goal, shortest=time)
            if profile is None or profile.duration > time * (1 + 1e-9) or not profile.stays_inside(self._q_min, self._q_max):
                continue
            part = profile.pieces(_lists(state))
            parts.append(part)
            state = end_state(part)
            t += float(part.knots[-1])
        return self._ended(parts, solver, knots.rest, start)

    @property
    def _zero(self) -> list[float]:
        return [0.0] * len(self._q_min)

    def _ended(self, parts: list[Pieces], solver: ProfileSolver, rest: Array, start: JointState | None = None) -> Pieces | None:
        """The parts, and then the fastest motion to rest at a place, or if that leaves the limits the fastest stop."""
        state = _lists(end_state(parts[-1]) if parts else start)
        goal = JointState(rest.tolist(), self._zero, self._zero)
        for profile in (solver.solve(state, goal), solver.solve(state, goal, together=False), solver.stop(state)):
            if profile is not None and profile.stays_inside(self._q_min, self._q_max):
                last = profile.pieces(state)
                return joined([*parts, last]) if parts else last
        return None

    def _is_feasible(self, pieces: Pieces) -> bool:
        """Whether a motion keeps all limits. A slower stop may come too late for the velocity limits of a fast arm."""
        return is_inside(pieces, self._limits) and self._has_torque(pieces)

    def _has_torque(self, pieces: Pieces) -> bool:
        """Whether the motors can follow, at the knots, where accelerations are extreme, and between them."""
        duration = float(pieces.knots[-1])
        times = np.union1d(pieces.knots, np.linspace(0.0, duration, 2 + int(duration / _TORQUE_STEP_S)))
        return bool((np.abs(self._dynamics.total(*sample(pieces, times))) <= self._tau_max).all())

    def _hit(self, pieces: Pieces) -> Hit | None:
        if self.checker is None or pieces.knots[-1] == 0.0:
            return None
        return self.checker.motion_hit(pieces.knots, pieces.coefficients, _CLEARANCE_M)

    def _before(self, hit: Hit, solver: ProfileSolver, start: JointState, now: float, knots: Knots) -> Pieces | None:
        """The longest of some beginnings of the motion after which the arm can stop free of contact; None if there is none."""
        assert self.checker is not None
        first, second = self.checker.names(hit.pair)
        self.obstacle = f"{second} would touch {first}"
        count = int(np.searchsorted(knots.t - now, hit.time))
        for keep in dict.fromkeys((count - 1, count // 2, 0)):
            if keep < 0:
                continue
            rest = knots.q[keep - 1] if keep else np.asarray(start.q)
            joins = tuple(each for each in knots.joins if each.start < keep)
            shorter = Knots(knots.t[:keep], knots.q[:keep], knots.v[:keep], knots.a[:keep], rest, joins)
            pieces = self._motion(solver, start, now, shorter)
            if pieces is not None and self._is_feasible(pieces) and self._hit(pieces) is None:
                return pieces
        return None


def end_state(pieces: Pieces) -> JointState:
    """The state in which a motion ends."""
    q, v, a = np.array(basis(float(pieces.knots[-1] - pieces.knots[-2]))) @ pieces.coefficients[-1]
    return JointState(q, v, a)


def _lists(state: JointState | None) -> JointState:
    assert state is not None
    return JointState(*(np.asarray(x).tolist() for x in state))
