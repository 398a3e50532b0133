"""Ruckig behind a checked door: what goes in is inside the limits, what comes out is pieces of constant jerk."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import ruckig

from armctl.core.errors import PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.motion.trajectory.piecewise import Pieces

_WORKING = {ruckig.Result.Working, ruckig.Result.Finished}
_TOGETHER, _ALONE = ruckig.Synchronization.Time, ruckig.Synchronization.No
_SAME_TIME = 1e-12
_HAIRS = (1e-9, 1e-7, 1e-5)


class Moving(NamedTuple):
    """A state of joints in motion, as arrays or, for ruckig, as lists.

    Attributes:
        q: (n,) rad.
        v: (n,) rad/s.
        a: (n,) rad/s^2.
    """

    q: Array | list[float]
    v: Array | list[float]
    a: Array | list[float]


def at_rest(q: Array) -> Moving:
    """The state of standing still.

    Args:
        q: (n,) rad.

    Returns:
        The state.
    """
    zero = np.zeros_like(q)
    return Moving(q, zero, zero)


class Profiles:
    """Time-optimal, jerk-limited profiles of n joints that start and arrive together; state to state."""

    def __init__(self, v_max: Array, a_max: Array, j_max: Array):
        """The profiles of joints with these limits.

        Args:
            v_max: (n,) rad/s.
            a_max: (n,) rad/s^2.
            j_max: (n,) rad/s^3.
        """
        n = len(v_max)
        self._otg, self._input, self._result = ruckig.Ruckig(n), ruckig.InputParameter(n), ruckig.Trajectory(n)
        self._bounds, self._v_max, self._a_max = (v_max, a_max, j_max), v_max.tolist(), a_max.tolist()
        self._limit(1.0)

    @classmethod
    def of(cls, limits: Limits) -> Profiles:
        """The profiles of an arm.

        Args:
            limits: Its limits.

        Returns:
            The profiles.
        """
        return cls(limits.v_max, limits.a_max, limits.j_max)

    def solve(self, start: Moving, goal: Moving) -> Pieces:
        """The fastest move from one state to another.

        Args:
            start: Where it starts.
            goal: Where it ends.

        Returns:
            Its pieces.

        Raises:
            PlanError: Ruckig finds none.
        """
        if not self.reach(start, goal):
            raise PlanError("no jerk-limited move joins the two states; start and end slower")
        return _pieces(*(x[:, 0] for x in phase_nodes([self.phases()], Moving(*(np.asarray(x)[None] for x in start)))))

    def reach(self, start: Moving, goal: Moving, together: bool = True) -> bool:
        """Finds the fastest move from one state to another; what follows then tells of it.

        Args:
            start: Where it starts, arrays or lists.
            goal: Where it ends, arrays or lists.
            together: Whether all joints arrive at the same time; otherwise each goes as fast as it can.

        Returns:
            Whether there is one.
        """
        inp = self._input
        inp.current_position, inp.current_velocity, inp.current_acceleration = start
        inp.target_position, inp.target_velocity, inp.target_acceleration = goal
        inp.synchronization = _TOGETHER if together else _ALONE
        return self._found()

    def stop(self, start: Moving) -> bool:
        """Finds the fastest stop, each joint by itself.

        Args:
            start: Where it starts, arrays or lists.

        Returns:
            Whether there is one.
        """
        inp = self._input
        inp.current_position, inp.current_velocity, inp.current_acceleration = start
        inp.target_velocity = inp.target_acceleration = [0.0] * len(start.q)
        inp.synchronization, inp.control_interface = _ALONE, ruckig.ControlInterface.Velocity
        found = self._found()
        inp.control_interface = ruckig.ControlInterface.Position
        return found

    def _found(self) -> bool:
        """Asks ruckig; where rounding leaves it without an answer, with limits a hair's breadth tighter."""
        try:
            return self._otg.calculate(self._input, self._result) in _WORKING
        except ruckig.RuckigError:
            found = any(self._found_within(1 - hair) for hair in _HAIRS)
            self._limit(1.0)
            return found

    def _found_within(self, share: float) -> bool:
        self._limit(share)
        try:
            return self._otg.calculate(self._input, self._result) in _WORKING
        except ruckig.RuckigError:
            return False

    def _limit(self, share: float) -> None:
        v_max, a_max, j_max = self._bounds
        self._input.max_velocity = (share * v_max).tolist()
        self._input.max_acceleration = (share * a_max).tolist()
        self._input.max_jerk = (share * j_max).tolist()

    def at(self, t: float) -> tuple[list[float], list[float], list[float]]:
        """The move at a time.

        Args:
            t: s, within its duration.

        Returns:
            Positions, velocities and accelerations.
        """
        return self._result.at_time(t)

    def stays_inside(self, q_min: list[float], q_max: list[float]) -> bool:
        """Whether the move keeps position limits, by the turning points of every phase.

        Plain Python, since it is called in real time and numpy takes longer for so little.

        Args:
            q_min: (n,) rad.
            q_max: (n,) rad.

        Returns:
            Whether it does.
        """
        time = self._result.duration
        for profile, low, high, v_max, a_max in zip(
            self._result.profiles[0], q_min, q_max, self._v_max, self._a_max, strict=True
        ):
            q = profile.p
            start, end = q[0], q[7]
            least, most = (start, end) if start < end else (end, start)
            spare = 0.5 * (v_max * time - (most - least))  # it cannot swing further beyond its ends, and back in time
            if low + spare <= least and most + spare <= high:
                continue
            least, most = min(q), max(q)
            if least < low or most > high:
                return False
            t, a = profile.t, profile.a
            longest = max(t[0], t[1], t[2], t[4], t[5], t[6], 0.0 if a[3] == 0.0 else t[3])
            bulge = a_max * longest * longest / 8  # how far a curve of this acceleration can leave its chord
            if (least - bulge < low or most + bulge > high) and not _turns_inside(profile, low, high):
                return False
        return True

    @property
    def duration(self) -> float:
        """How long the move takes, s."""
        return self._result.duration

    def phases(self) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]]:
        """The move as phases of constant jerk: for each joint their durations, s, and their jerks, rad/s^3."""
        profiles = self._result.profiles[0]
        return [(*p.brake.t, *p.t) for p in profiles], [(*p.brake.j, *p.j) for p in profiles]


def _turns_inside(profile: ruckig.Profile, low: float, high: float) -> bool:
    """Whether a joint turns round between two positions in every phase of its profile."""
    q, v, a, j, t = profile.p, profile.v, profile.a, profile.j, profile.t
    for k in range(7):
        if v[k] * v[k + 1] < 0 or a[k] * a[k + 1] < 0:
            for u in _turns(v[k], a[k], j[k]):
                if 0 < u < t[k] and not low <= q[k] + u * (v[k] + u * (a[k] / 2 + u * j[k] / 6)) <= high:
                    return False
    return True


def _turns(v: float, a: float, j: float) -> tuple[float, ...]:
    """When a joint with this velocity, acceleration and constant jerk stands still."""
    if j == 0.0:
        return (-v / a,) if a else ()
    root = a * a - 2 * j * v
    if root < 0:
        return ()
    half = -(a + math.copysign(math.sqrt(root), a))
    return (half / j, 2 * v / half) if half else ()


def phase_nodes(phases: list[tuple[list[tuple[float, ...]], list[tuple[float, ...]]]], start: Moving) -> tuple[Array, ...]:
    """What joints do at the start of each phase of several moves.

    Args:
        phases: `Profiles.phases` of K moves.
        start: (K, n) states they start from.

    Returns:
        Durations, positions, velocities, accelerations and jerks, each (P, K, n).
    """
    steps, jerks = (np.moveaxis(np.array(x), -1, 0) for x in zip(*phases, strict=True))
    q, v, a = (np.empty_like(steps) for _ in range(3))
    now = start
    for i, (h, j) in enumerate(zip(steps, jerks, strict=True)):
        q[i], v[i], a[i] = now
        now = Moving(q[i] + h * (v[i] + h * (a[i] / 2 + h * j / 6)), v[i] + h * (a[i] + h * j / 2), a[i] + h * j)
    return steps, q, v, a, jerks


def phase_polynomials(steps: Array, q: Array, v: Array, a: Array, jerks: Array) -> Array:
    """The positions during phases, as polynomials on [0, 1].

    Args:
        steps: (P, K, n) s, durations.
        q: (P, K, n) rad, positions at the start.
        v: (P, K, n) rad/s, likewise.
        a: (P, K, n) rad/s^2, likewise.
        jerks: (P, K, n) rad/s^3.

    Returns:
        (P, K, n, 4) coefficients.
    """
    return np.stack([q, v * steps, a * steps**2 / 2, jerks * steps**3 / 6], axis=-1)


def _pieces(steps: Array, q: Array, v: Array, a: Array, jerks: Array) -> Pieces:
    """Cubic pieces from phases (P, n), cut wherever the jerk of any joint changes."""
    starts = np.vstack([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)])
    knots = np.unique(starts)
    knots = np.append(knots[:-1][np.diff(knots) > _SAME_TIME], knots[-1])
    if len(knots) == 1:
        knots = np.zeros(2)
    joints = np.arange(steps.shape[1])
    middle = 0.5 * (knots[1:] + knots[:-1])
    phase = np.minimum((starts[1:, None] <= middle[:, None]).sum(axis=0), len(steps) - 1)
    u, j = knots[:-1, None] - starts[phase, joints], jerks[phase, joints]
    q, v, a = q[phase, joints], v[phase, joints], a[phase, joints]
    zero = np.zeros_like(u)
    rows = (q + u * (v + u * (a / 2 + u * j / 6)), v + u * (a + u * j / 2), (a + u * j) / 2, j / 6, zero, zero)
    return Pieces(knots, np.stack(rows, axis=1))
