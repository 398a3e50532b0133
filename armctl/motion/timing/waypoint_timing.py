"""The velocities and accelerations at waypoints that make a motion through them fast, and what ruckig makes of them.

The compiled search finds them; ruckig then times each section, and where that swings a joint beyond its position limits between
two waypoints, the joint is held slower there.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.motion.timing.otg import Moving, Profiles, phase_nodes, phase_polynomials
from armctl.motion.trajectory import polynomials

_LOOSE = 2.0  # times the time with stops, where the search starts
_AT_LIMIT = 1e-7  # rad
_ROUNDING = 1e-12  # rad
_REPAIRS, _SLOWER = 20, 0.8


class Candidate(NamedTuple):
    """A motion through the waypoints.

    Attributes:
        v: (k, n) rad/s, the velocities there.
        a: (k, n) rad/s^2, the accelerations there.
        durations: (k - 1,) s, of each section.
        excess: (k - 1, n) rad beyond the position limits in a section, negative inside.
    """

    v: Array
    a: Array
    durations: Array
    excess: Array


class WaypointSearch:
    """The search for one set of waypoints."""

    def __init__(self, q: Array, limits: Limits):
        """The search.

        Args:
            q: (k, n) rad, the waypoints, no two neighbours equal.
            limits: What the joints can do.
        """
        self.q, self.limits = q, limits
        self._profiles = Profiles.of(limits)
        # Faster than this at a waypoint no joint could stop before its position limit. At the limit it stands.
        room = np.minimum(q - limits.q_min, limits.q_max - q)
        self._v_most = np.minimum(limits.v_max, np.sqrt(2 * limits.a_max * np.maximum(room, 0.0)))
        self._a_most = np.where(room > _AT_LIMIT, limits.a_max, 0.0)
        self._v_most[[0, -1]] = self._a_most[[0, -1]] = 0.0

    def at_rest(self) -> Candidate:
        """The motion that stops at every waypoint."""
        zero = np.zeros_like(self.q)
        stopping = self._evaluate(zero, zero)
        assert stopping is not None  # from rest to rest there always is one
        return stopping

    def fastest(self, stopping: Candidate) -> Candidate:
        """The fastest motion that the search finds.

        Args:
            stopping: The one that stops at every waypoint.

        Returns:
            One inside all limits, never slower than that.
        """
        from armctl.motion.timing import waypoint_timing_kernel as waypoint_kernel

        limits, most = self.limits, np.stack([self._v_most, self._a_most], axis=-1)
        for _ in range(_REPAIRS):
            x, times = np.zeros_like(most), _LOOSE * stopping.durations
            waypoint_kernel.solve(waypoint_kernel.Problem(self.q, limits.v_max, limits.a_max, limits.j_max, most), x, times)
            found = self._evaluate(x[..., 0], x[..., 1])
            if found is None or found.durations.sum() >= stopping.durations.sum():
                break
            leaves = found.excess > _ROUNDING
            if not leaves.any():
                return found
            for k, i in np.argwhere(leaves):
                most[k : k + 2, i] = _SLOWER * np.abs(x[k : k + 2, i])
        return stopping

    def _evaluate(self, v: Array, a: Array) -> Candidate | None:
        """The motion with these velocities and accelerations (k, n), brought inside the limits; None if there is none."""
        durations, phases = [], []
        for start, goal in pairwise(zip(self.q.tolist(), v.tolist(), a.tolist(), strict=True)):
            if not self._profiles.reach(Moving(*start), Moving(*goal)):
                return None
            durations.append(self._profiles.duration)
            phases.append(self._profiles.phases())
        _, swing = polynomials.extremes(phase_polynomials(*phase_nodes(phases, Moving(self.q[:-1], v[:-1], a[:-1]))))
        high, low = swing.max(axis=(0, 3)), swing.min(axis=(0, 3))
        return Candidate(v, a, np.array(durations), np.maximum(high - self.limits.q_max, self.limits.q_min - low))
