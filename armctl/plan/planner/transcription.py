"""Direct transcription: a motion from rest to rest as numbers, and the derivatives of what is bounded and weighed by them.

The unknowns are the accelerations at the knots and the durations of the pieces between them; the acceleration is linear in each
piece, so that its jerk is constant. Position and velocity are splines, which lie between the extremes of their control points:
with these inside a limit, they are inside it at all times. Torques and distances are sampled. Source: J. T. Betts, Practical
Methods for Optimal Control and Estimation Using Nonlinear Programming (2010), chapter 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.plan.motion.torque_limits import InverseDynamics
from armctl.plan.motion.trajectory.piecewise import Pieces

SAMPLES = 4  # of each piece
_SHORTEST = 0.05  # of a piece, relative to its duration in the first motion
_LONGEST = 3.0
_Q_STEP = 1e-5  # rad, of the differences of torques
_V_STEP = 1e-3  # rad/s; torques but those of nonlinear damping are quadratic in v, so that a central difference is exact
_CREEP = 0.01  # of the greatest speed: below it, dry friction changes its sign smoothly


class Derived(NamedTuple):
    """Something of each joint at R times, and its derivatives by the unknowns."""

    values: Array  # (R, n)
    by_a: Array  # (R, N - 1) by the accelerations of the same joint at the inner knots
    by_h: Array  # (R, n, N) by the durations


class States(NamedTuple):
    """Position, velocity and acceleration at R times."""

    q: Derived
    v: Derived
    a: Derived

    def rows(self, which: slice) -> States:
        return States(*(Derived(*(part[which] for part in each)) for each in self))


class Values(NamedTuple):
    """Numbers and their derivatives."""

    values: Array  # (...)
    slopes: Array  # (..., x) by the unknowns


def joined_values(parts: Sequence[Values]) -> Values:
    return Values(*(np.concatenate(each) for each in zip(*parts, strict=True)))


class Transcription:
    """Motions of n joints from rest at `start` to rest at `goal` (n,), in N pieces.

    The unknowns are the accelerations at the inner knots relative to their limits, knot by knot, then the durations of the
    pieces relative to those of an even division of `duration`.
    """

    def __init__(
        self, limits: Limits, inverse_dynamics: InverseDynamics, start: Array, goal: Array, duration: float, pieces: int
    ):
        self.limits = limits
        self.start = start
        self.goal = goal
        self.pieces = pieces
        self._n = len(start)
        self._h = duration / pieces
        self._inverse_dynamics = inverse_dynamics
        inner = (pieces - 1) * self._n
        self.bounds = np.repeat([[-1.0, 1.0], [_SHORTEST, _LONGEST]], [inner, pieces], axis=0)

    def accelerations(self, x: Array) -> Array:
        """(N + 1, n), zero at the ends."""
        a = np.zeros((self.pieces + 1, self._n))
        a[1:-1] = x[: -self.pieces].reshape(-1, self._n) * self.limits.a_max
        return a

    def steps(self, x: Array) -> Values:
        """(N,) s, the durations of the pieces."""
        slopes = np.zeros((self.pieces, len(x)))
        slopes[:, -self.pieces :] = self._h * np.eye(self.pieces)
        return Values(x[-self.pieces :] * self._h, slopes)

    def unknowns(self, q: Array) -> Array:
        """Those of the motion in evenly timed pieces that is nearest to positions q at the samples."""
        x = np.concatenate([np.zeros((self.pieces - 1) * self._n), np.ones(self.pieces)])
        at = self.samples(x)
        rows = at.q.by_a[1:-1]
        a = np.linalg.lstsq(rows, q[1:-1] - self.start, rcond=None)[0]
        x[: -self.pieces] = (a / self.limits.a_max).ravel()
        return self.at_goal(x)

    def at_goal(self, x: Array) -> Array:
        """The unknowns of the motion that ends at rest at the goal, with the nearest accelerations and the same durations."""
        at = self.samples(x).rows(slice(-1, None))
        rows = np.concatenate([at.q.by_a, at.v.by_a])
        gaps = np.concatenate([self.goal - at.q.values, -at.v.values])
        change = np.linalg.lstsq(rows, gaps, rcond=None)[0]
        return np.concatenate([x[: -self.pieces] + (change / self.limits.a_max).ravel(), x[-self.pieces :]])

    def motion(self, x: Array) -> Pieces:
        a = self.accelerations(x)
        h = self.steps(x).values
        at = self.samples(x).rows(slice(0, -1, SAMPLES))
        coefficients = np.zeros((self.pieces, 6, self._n))
        coefficients[:, 0] = at.q.values
        coefficients[:, 1] = at.v.values
        coefficients[:, 2] = 0.5 * a[:-1]
        coefficients[:, 3] = np.diff(a, axis=0) / (6.0 * h[:, None])
        return Pieces(np.concatenate([[0.0], np.cumsum(h)]), coefficients)

    def samples(self, x: Array) -> States:
        """The states at the knots and at even distances between them: `SAMPLES` N + 1."""
        N = self.pieces
        hat = np.array([np.interp(np.arange(SAMPLES * N + 1) / SAMPLES, np.arange(N + 1), row) for row in np.eye(N + 1)]).T
        a = hat @ self.accelerations(x)
        q = np.zeros_like(a)
        v = np.zeros_like(a)
        q[0] = self.start
        q_a = np.zeros_like(hat)
        v_a = np.zeros_like(hat)
        q_h = np.zeros((SAMPLES * N + 1, self._n, N))
        v_h = np.zeros_like(q_h)
        for k, h in enumerate(np.repeat(self.steps(x).values / SAMPLES, SAMPLES)):
            v[k + 1] = v[k] + h / 2 * (a[k] + a[k + 1])
            v_a[k + 1] = v_a[k] + h / 2 * (hat[k] + hat[k + 1])
            v_h[k + 1] = v_h[k]
            v_h[k + 1, :, k // SAMPLES] += (a[k] + a[k + 1]) / (2 * SAMPLES)
            q[k + 1] = q[k] + h * v[k] + h * h / 6 * (2 * a[k] + a[k + 1])
            q_a[k + 1] = q_a[k] + h * v_a[k] + h * h / 6 * (2 * hat[k] + hat[k + 1])
            q_h[k + 1] = q_h[k] + h * v_h[k]
            q_h[k + 1, :, k // SAMPLES] += (v[k] + h / 3 * (2 * a[k] + a[k + 1])) / SAMPLES
        inner = slice(1, -1)
        return States(Derived(q, q_a[:, inner], q_h), Derived(v, v_a[:, inner], v_h), Derived(a, hat[:, inner], 0.0 * v_h))

    def slopes(self, derived: Derived) -> Array:
        """(R, n, x) derivatives by the unknowns."""
        slopes = np.zeros((*derived.values.shape, len(self.bounds)))
        for i in range(self._n):
            slopes[:, i, i : -self.pieces : self._n] = derived.by_a * self.limits.a_max[i]
        slopes[:, :, -self.pieces :] = derived.by_h * self._h
        return slopes

    def end_gaps(self, at: States) -> Values:
        """(2 n,) what is zero at rest at the goal, relative to the greatest acceleration."""
        last = at.rows(slice(-1, None))
        time = self.pieces * self._h
        speed = self.limits.a_max * time
        values = np.stack([(last.q.values[0] - self.goal) / (speed * time), last.v.values[0] / speed])
        slopes = np.stack([self.slopes(last.q)[0] / (speed * time)[:, None], self.slopes(last.v)[0] / speed[:, None]])
        return Values(values.ravel(), slopes.reshape(2 * self._n, -1))

    def limit_rows(self, at: States, x: Array) -> Values:
        """What is not negative inside the limits of position, velocity and jerk; the unknowns bound the acceleration."""
        limits = self.limits
        h = self.steps(x).values
        steps = h[:, None]
        piece = np.arange(self.pieces)
        knots = at.rows(slice(None, None, SAMPLES))
        before = knots.rows(slice(0, -1))
        # The control points of the velocity: one in each piece, of which the first and the last are at rest.
        speed = Derived(
            before.v.values + steps / 2 * before.a.values,
            before.v.by_a + steps / 2 * before.a.by_a,
            before.v.by_h.copy(),
        )
        speed.by_h[piece, :, piece] += before.a.values / 2
        shares = speed.values / limits.v_max
        slopes = self.slopes(speed) / limits.v_max[:, None]
        rows = [(1.0 - shares, -slopes), (1.0 + shares, slopes)]
        change = Derived(*(np.diff(part, axis=0) for part in knots.a))
        most = limits.j_max * self._h
        shares = change.values / most
        slopes = self.slopes(change) / most[:, None]
        allowed = np.zeros_like(slopes)
        allowed[piece, :, len(x) - self.pieces + piece] = 1.0
        rows += [(steps / self._h - shares, allowed - slopes), (steps / self._h + shares, allowed + slopes)]
        rows += self._position_rows(knots.rows(slice(1, -1)), h)
        return joined_values([Values(values.ravel(), slopes.reshape(-1, len(x))) for values, slopes in rows])

    def _position_rows(self, at: States, h: Array) -> list[tuple[Array, Array]]:
        """Of the control points of the position: one at each inner knot, of which the first and the last are at the ends."""
        first = h[:-1, None]
        second = h[1:, None]
        lever = (second - first) / 3
        bend = first * second / 6
        control = Derived(
            at.q.values + at.v.values * lever - at.a.values * bend,
            at.q.by_a + at.v.by_a * lever - at.a.by_a * bend,
            at.q.by_h + at.v.by_h * lever[:, :, None],
        )
        k = np.arange(self.pieces - 1)
        control.by_h[k, :, k] -= at.v.values / 3 + at.a.values * second / 6
        control.by_h[k, :, k + 1] += at.v.values / 3 - at.a.values * first / 6
        slopes = self.slopes(control)[1:-1]
        values = control.values[1:-1]
        rows = []
        for bound, sign in ((self.limits.q_max, 1.0), (self.limits.q_min, -1.0)):
            limited = np.isfinite(bound)
            rows.append((sign * (bound - values)[:, limited], -sign * slopes[:, limited]))
        return rows

    def torques(self, at: States) -> tuple[Array, Array]:
        """(R, n) N m, and their derivatives (R, n, x)."""
        q = at.q.values
        v = at.v.values
        a = at.a.values
        n = self._n
        smooth = self._inverse_dynamics.smooth

        def moved(values: Array, step: float) -> Array:
            return values + step * np.eye(n)[:, None, :]

        def torque(q: Array, v: Array, a: Array) -> Array:
            states = np.broadcast_arrays(q, v, a)
            return smooth(*(state.reshape(-1, n) for state in states)).reshape(states[0].shape)

        tau = torque(q, v, a)
        by_q = (torque(moved(q, _Q_STEP), v, a) - torque(moved(q, -_Q_STEP), v, a)) / (2 * _Q_STEP)
        by_v = (torque(q, moved(v, _V_STEP), a) - torque(q, moved(v, -_V_STEP), a)) / (2 * _V_STEP)
        by_a = torque(q, v, moved(a, 1.0)) - tau
        loss = self._inverse_dynamics.friction_loss
        creep = _CREEP * self.limits.v_max
        root = np.sqrt(v * v + creep * creep)
        joint = np.arange(n)
        by_v[joint, :, joint] += (loss * creep**2 / root**3).T
        jacobians = [np.moveaxis(each, 0, 2) for each in (by_q, by_v, by_a)]  # (R, n, n): of a torque by a joint
        by_accelerations = sum(
            jacobian[:, :, None, :] * state.by_a[:, None, :, None] for jacobian, state in zip(jacobians, at, strict=True)
        )
        by_durations = sum(jacobian @ state.by_h for jacobian, state in zip(jacobians, at, strict=True))
        slopes = np.concatenate([(by_accelerations * self.limits.a_max).reshape(*q.shape, -1), by_durations * self._h], axis=2)
        return tau + loss * v / root, slopes
