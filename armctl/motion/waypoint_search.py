"""The velocities and accelerations at waypoints that make a motion through them fast: sequential linear programming.

Ruckig is the oracle: it tells how long each joint alone needs from waypoint to waypoint, and differences of that tell how it
changes with the velocities and accelerations there. The slowest joint of a section sets its time, so the best small change is a
linear programme, solved inside a trust region (Fletcher and Sainz de la Maza, "Nonlinear programming and nonsmooth optimization
by successive linear programming", Math. Programming 43, 1989). Where a joint comes near its position limits between two
waypoints, the furthest it swings is linearised as well.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from armctl.arrays import Array, IntArray
from armctl.motion import polynomials
from armctl.motion.profiles import Moving, Profiles, phase_nodes, phase_polynomials
from armctl.trajectory import Limits

_ITERATIONS = 30
_TRUST = 0.2  # of v_max and a_max, for the first step
_LEAST_TRUST = 1e-3
_LEAST_GAIN = 1e-4  # of the duration
_DIFFERENCE = 1e-4  # of v_max and a_max
_INSIDE = 0.9999  # of v_max and a_max: what may be asked for at a waypoint
_NEAR = 0.05  # rad from a position limit, where it enters the programme
_MARGIN = 1e-7  # rad, by which it stays inside
_ROUNDING = 1e-12  # rad
_REPAIRS = 30
_PENALTY = 20.0  # s/rad beyond a limit


class Candidate(NamedTuple):
    """A motion through the waypoints.

    Attributes:
        q: (k, n) rad, the waypoints.
        v: (k, n) rad/s, the velocities there.
        a: (k, n) rad/s^2, the accelerations there.
        durations: (k - 1,) s, of each section.
        alone: (k - 1, n) s, what each joint would need by itself.
        excess: (k - 1, n) rad beyond the position limits in a section, negative inside.
    """

    q: Array
    v: Array
    a: Array
    durations: Array
    alone: Array
    excess: Array

    @property
    def cost(self) -> float:
        """Its duration, s, and a penalty for leaving the position limits."""
        return float(self.durations.sum() + _PENALTY * np.maximum(self.excess + _MARGIN, 0.0).sum())

    @property
    def is_inside(self) -> bool:
        """Whether it stays inside the position limits."""
        return bool((self.excess <= _ROUNDING).all())


class Slopes(NamedTuple):
    """How a motion changes with the velocity and acceleration at a section's start, then at its end: (k - 1, 4, n) each.

    Attributes:
        alone: Of `Candidate.alone`.
        excess: Of `Candidate.excess`.
    """

    alone: Array
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
        self._rows = q.tolist()
        # Faster than this at a waypoint no joint could stop before its position limit. At the limit it stands.
        room = np.minimum(q - limits.q_min, limits.q_max - q)
        self.v_most = np.minimum(_INSIDE * limits.v_max, np.sqrt(2 * limits.a_max * np.maximum(room, 0.0)))
        self.a_most = np.where(room > _MARGIN, _INSIDE * limits.a_max, 0.0)
        sections = len(q) - 1
        self._free = [(k, i) for k in range(sections) for i in range(4) if (k > 0 or i > 1) and (k < sections - 1 or i < 2)]
        self.v_most[[0, -1]] = self.a_most[[0, -1]] = 0.0

    def evaluate(self, v: Array, a: Array) -> Candidate | None:
        """A motion with these velocities and accelerations at the waypoints, brought inside the limits.

        Args:
            v: (k, n) rad/s.
            a: (k, n) rad/s^2.

        Returns:
            The motion, or None if there is none.
        """
        a = np.clip(a, -self.a_most, self.a_most)
        most = np.minimum(self.v_most, np.maximum(_INSIDE * self.limits.v_max - a * a / (2 * self.limits.j_max), 0.0))
        v = np.clip(v, -most, most)
        states = list(zip(self._rows, v.tolist(), a.tolist(), strict=True))
        durations, alone, phases = [], [], []
        for start, goal in pairwise(states):
            if not self._profiles.reach(Moving(*start), Moving(*goal)):
                return None
            durations.append(self._profiles.duration)
            alone.append(self._profiles.fastest)
            phases.append(self._profiles.phases())
        excess = self._excess(phases, Moving(self.q[:-1], v[:-1], a[:-1]))
        return Candidate(self.q, v, a, np.array(durations), np.array(alone), excess)

    def improve(self, candidate: Candidate) -> Candidate:
        """The best motion that small steps lead to.

        Args:
            candidate: Where to start.

        Returns:
            A motion of no greater cost.
        """
        trust, programme = _TRUST, None
        for _ in range(_ITERATIONS):
            if programme is None:
                programme = _Programme(self, candidate)
            dv, da, gain = programme.step(trust)
            if gain < _LEAST_GAIN * candidate.cost:
                break
            trial = self.evaluate(candidate.v + dv, candidate.a + da)
            gained = candidate.cost - trial.cost if trial is not None else -1.0
            if trial is not None and gained > 0:
                candidate, programme = trial, None
                trust *= 2.0 if gained > 0.5 * gain else 0.5 if gained < 0.2 * gain else 1.0
            else:
                trust *= 0.4
            if trust < _LEAST_TRUST:
                break
        return candidate

    def inside(self, candidate: Candidate) -> Candidate:
        """A motion that keeps the position limits: joints that leave them slow down at the waypoints on both sides.

        Args:
            candidate: A motion that may leave them.

        Returns:
            One that does not; at rest at every waypoint none can.
        """
        for _ in range(_REPAIRS):
            if candidate.is_inside:
                return candidate
            leaves = candidate.excess > 0
            factor = np.ones_like(candidate.q)
            factor[:-1][leaves] = factor[1:][leaves] = 0.9
            slower = self.evaluate(factor * candidate.v, factor * candidate.a)
            if slower is None:
                break
            candidate = slower
        return self.at_rest()

    def at_rest(self) -> Candidate:
        """The motion that stops at every waypoint."""
        zero = np.zeros_like(self.q)
        stopping = self.evaluate(zero, zero)
        assert stopping is not None  # from rest to rest there always is one
        return stopping

    def slopes(self, candidate: Candidate) -> Slopes:
        """How times and swings change with the velocities and accelerations at the waypoints, by differences.

        Args:
            candidate: A motion.

        Returns:
            The slopes there.
        """
        v, a = candidate.v, candidate.a
        dv = np.where(v > 0, -_DIFFERENCE, _DIFFERENCE) * self.limits.v_max
        da = np.where(a > 0, -_DIFFERENCE, _DIFFERENCE) * self.limits.a_max
        steps = np.stack([dv[:-1], da[:-1], dv[1:], da[1:]], axis=1)
        moving = (candidate.v[:-1] != 0) | (candidate.v[1:] != 0)
        near = np.any(candidate.excess > -_NEAR, axis=1) & np.any(moving, axis=1)
        rise, swing = np.zeros_like(steps), np.zeros_like(steps)
        now, moved = (
            list(zip(v.tolist(), a.tolist(), strict=True)),
            list(zip((v + dv).tolist(), (a + da).tolist(), strict=True)),
        )
        swung, phases = [], []
        for k, slot in self._free:
            states = [*now[k], *now[k + 1]]
            states[slot] = (*moved[k], *moved[k + 1])[slot]
            start, goal = Moving(self._rows[k], *states[:2]), Moving(self._rows[k + 1], *states[2:])
            if self._profiles.reach(start, goal):
                rise[k, slot] = self._profiles.fastest - candidate.alone[k]
            if near[k] and self._profiles.reach(start, goal, at_least=float(candidate.durations[k])):
                swung.append((k, slot))
                phases.append((start, self._profiles.phases()))
        if swung:
            starts, profiles = zip(*phases, strict=True)
            k, slot = np.array(swung).T
            excess = self._excess(list(profiles), Moving(*(np.array(x) for x in zip(*starts, strict=True))))
            swing[k, slot] = excess - candidate.excess[k]
        return Slopes(rise / steps, swing / steps)

    def _excess(self, phases: list, start: Moving) -> Array:
        """How far joints leave their position limits, (K, n) rad, negative inside."""
        _, q = polynomials.extremes(phase_polynomials(*phase_nodes(phases, start)))
        high, low = q.max(axis=(0, 3)), q.min(axis=(0, 3))
        return np.maximum(high - self.limits.q_max, self.limits.q_min - low)


class _Programme:
    """The linear programme around one motion: how to change the velocities and accelerations at the inner waypoints.

    Its variables are those changes, as shares of v_max and a_max, then each section's time, then how far each joint that comes
    near its position limits is left beyond them.
    """

    def __init__(self, search: WaypointSearch, candidate: Candidate):
        self._candidate = candidate
        slopes = search.slopes(candidate)
        sections, n = candidate.alone.shape
        self._inner = (sections - 1, n)
        self._scale = np.stack([search.limits.v_max, search.limits.a_max])
        near = np.argwhere((candidate.excess > -_NEAR) & slopes.excess.any(axis=1))
        every = np.argwhere(np.ones_like(candidate.alone))
        changes = 2 * (sections - 1) * n
        self._cost = np.concatenate([np.zeros(changes), np.ones(sections), np.full(len(near), _PENALTY)])
        time_rows = self._rows(every, slopes.alone, changes + every[:, 0])
        near_rows = self._rows(near, slopes.excess, changes + sections + np.arange(len(near)))
        self._matrix = np.concatenate([time_rows, near_rows])
        self._bound = -np.concatenate([candidate.alone.ravel(), candidate.excess[tuple(near.T)] + _MARGIN])
        now = np.stack([candidate.v[1:-1], candidate.a[1:-1]])
        most = np.stack([search.v_most[1:-1], search.a_most[1:-1]])
        scale = self._scale[:, None]
        self._low, self._high = ((-most - now) / scale).ravel(), ((most - now) / scale).ravel()

    def _rows(self, places: IntArray, slopes: Array, own: IntArray) -> Array:
        """Rows `slopes . changes - own variable`, for (section, joint) places."""
        rows = np.zeros((len(places), len(self._cost)))
        changes = rows[:, : 2 * self._inner[0] * self._inner[1]].reshape(len(places), 2, *self._inner)
        k, joint = places.T
        row = np.arange(len(places))
        for slot in range(4):
            waypoint, kind = k - 1 + slot // 2, slot % 2
            free = (waypoint >= 0) & (waypoint < self._inner[0])
            r, i = row[free], joint[free]
            changes[r, kind, waypoint[free], i] = slopes[k[free], slot, i] * self._scale[kind, i]
        rows[row, own] = -1.0
        return rows

    def step(self, trust: float) -> tuple[Array, Array, float]:
        """The best change of at most `trust`, as a share of v_max and a_max.

        Args:
            trust: The share.

        Returns:
            Changes of velocity and acceleration (k, n), and how much they should gain, s.
        """
        from scipy.optimize import linprog
        from scipy.sparse import csr_array

        rest = len(self._cost) - len(self._low)
        low = np.concatenate([np.maximum(self._low, -trust), np.zeros(rest)])
        high = np.concatenate([np.minimum(self._high, trust), np.full(rest, np.inf)])
        found = linprog(
            self._cost, csr_array(self._matrix), self._bound, bounds=np.stack([low, high], axis=1), method="highs-ds"
        )
        n = self._inner[1]
        if not found.success:
            return np.zeros_like(self._candidate.v), np.zeros_like(self._candidate.a), 0.0
        change = found.x[: len(self._low)].reshape(2, *self._inner) * self._scale[:, None]
        still = np.zeros((1, n))
        dv, da = (np.concatenate([still, x, still]) for x in change)
        return dv, da, self._candidate.cost - found.fun
