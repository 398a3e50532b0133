"""The velocities and accelerations at waypoints that make a motion through them fast.

The compiled search finds them. Ruckig then times each section. If a joint leaves its position limits between two waypoints, the
bounds on its velocity and acceleration at both are lowered, and the search is repeated.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from armctl import _core
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.plan.motion.timing.otg import JointState, ProfileSolver, phase_nodes, phase_polynomials, solve_pieces
from armctl.plan.motion.timing.waypoint_path import Passage, passage_of
from armctl.plan.motion.trajectory.limit_check import polynomial_extremes
from armctl.plan.motion.trajectory.piecewise import Pieces, sample

_INITIAL_TIME_FACTOR = 2.0  # relative to stopping at each waypoint, where the search starts
_NEAR_TIME_FACTOR = 1.03  # relative to a fast motion, where the search starts near it
_INSIDE = 0.99  # of a bound, where the search starts
_AT_LIMIT = 1e-7  # rad (m); closer to a position limit, a waypoint is passed without acceleration
_POSITION_ROUNDING = 1e-12  # rad (m)
_MAX_REPAIRS = 20
_MAX_SECTION_EXCESS = 0.2  # over the limits, by rounding in very short sections; the whole motion is slowed down for it
_REPAIR_FACTOR = 0.8  # by which a repair lowers velocity and acceleration at a waypoint


class TimingCandidate(NamedTuple):
    """A motion through the waypoints."""

    v: Array  # (k, n) rad/s, the velocities there
    a: Array  # (k, n) rad/s^2, the accelerations there
    durations: Array  # (k - 1,) s, of each section
    excess: Array  # (k - 1, n) rad beyond the position limits in a section, negative inside


class WaypointSearch:
    """The search for one set of waypoints."""

    def __init__(self, q: Array, limits: Limits):
        """For waypoints q (k, n), no two neighbours equal."""
        self.q = np.ascontiguousarray(q)
        self.limits = limits
        self._solver = ProfileSolver.from_limits(limits)
        # A joint that passes a waypoint faster than this cannot stop before its position limit.
        room = np.minimum(q - limits.q_min, limits.q_max - q)
        self._v_bound = np.minimum(limits.v_max, np.sqrt(2 * limits.a_max * np.maximum(room, 0.0)))
        self._a_bound = np.where(room > _AT_LIMIT, limits.a_max, 0.0)
        for bound in (self._v_bound, self._a_bound):
            bound[[0, -1]] = 0.0

    def stopping(self) -> TimingCandidate:
        zero = np.zeros_like(self.q)
        candidate = self._evaluate(zero, zero)
        if candidate is not None:
            return candidate
        # Ruckig fails for a section; a straight line in closed form cannot.
        durations = [float(section.knots[-1]) for section in self._sections(zero, zero)]
        return TimingCandidate(zero, zero, np.array(durations), np.full((len(durations), self.q.shape[1]), -np.inf))

    def fastest(self, stopping: TimingCandidate, near: Passage | None = None) -> TimingCandidate:
        """The fastest motion that the search finds inside all limits; `stopping` if none is faster.

        The search starts from stopping at each waypoint, or near a motion that is fast already.
        """
        limits = self.limits
        v_bound = self._v_bound.copy()
        a_bound = self._a_bound.copy()
        for _ in range(_MAX_REPAIRS if near is None else 1):
            # Velocity and acceleration of each joint at a waypoint, then the time to the next one.
            motion = self._slow(stopping) if near is None else self._slowed(near, v_bound, a_bound)
            _core.make_fastest(
                motion.ravel()[:-1],
                near is not None,
                q=self.q,
                v_max=limits.v_max,
                a_max=limits.a_max,
                j_max=limits.j_max,
                v_bound=v_bound,
                a_bound=a_bound,
            )
            v = motion[:, :-1:2].copy()
            a = motion[:, 1:-1:2].copy()
            found = self._evaluate(v, a)
            if found is None or not found.durations.sum() < stopping.durations.sum():
                break
            leaves = found.excess > _POSITION_ROUNDING
            if not leaves.any():
                return found
            for k, i in np.argwhere(leaves):
                v_bound[k : k + 2, i] = _REPAIR_FACTOR * np.abs(v[k : k + 2, i])
                a_bound[k : k + 2, i] = _REPAIR_FACTOR * np.abs(a[k : k + 2, i])
        return stopping

    def _slow(self, stopping: TimingCandidate) -> Array:
        """(k, 2 n + 1) where the search starts, far inside all bounds."""
        motion = np.zeros((len(self.q), 2 * self.q.shape[1] + 1))
        motion[:-1, -1] = _INITIAL_TIME_FACTOR * stopping.durations
        return motion

    def _slowed(self, near: Passage, v_bound: Array, a_bound: Array) -> Array:
        """(k, 2 n + 1) where the search starts, a little slower than a motion and so inside its bounds."""
        _, v, a = sample(near.pieces, near.times)
        motion = np.zeros((len(self.q), 2 * self.q.shape[1] + 1))
        motion[:, :-1:2] = np.clip(v / _NEAR_TIME_FACTOR, -_INSIDE * v_bound, _INSIDE * v_bound)
        motion[:, 1:-1:2] = np.clip(a / _NEAR_TIME_FACTOR**2, -_INSIDE * a_bound, _INSIDE * a_bound)
        motion[:-1, -1] = _NEAR_TIME_FACTOR * np.diff(near.times)
        return motion

    def passage(self, candidate: TimingCandidate) -> Passage:
        """The motion of a candidate. Raises PlanError if a section cannot be computed accurately."""
        return passage_of(self._sections(candidate.v, candidate.a))

    def _sections(self, v: Array, a: Array) -> list[Pieces]:
        states = [JointState(*state) for state in zip(self.q, v, a, strict=True)]
        return [solve_pieces(self._solver, start, goal, _MAX_SECTION_EXCESS) for start, goal in pairwise(states)]

    def _evaluate(self, v: Array, a: Array) -> TimingCandidate | None:
        """The motion with these velocities and accelerations (k, n) at the waypoints; None if ruckig finds none."""
        durations = []
        phases = []
        for start, goal in pairwise(zip(self.q.tolist(), v.tolist(), a.tolist(), strict=True)):
            profile = self._solver.solve(JointState(*start), JointState(*goal))
            if profile is None:
                return None
            durations.append(profile.duration)
            phases.append(profile.phases())
        nodes = phase_nodes(phases, JointState(self.q[:-1], v[:-1], a[:-1]))
        swing = polynomial_extremes(phase_polynomials(nodes))[1].reshape(*nodes.q.shape, -1)
        high = swing.max(axis=(0, 3))
        low = swing.min(axis=(0, 3))
        return TimingCandidate(v, a, np.array(durations), np.maximum(high - self.limits.q_max, self.limits.q_min - low))
