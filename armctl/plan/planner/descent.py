"""The problem of `optimize`: what a motion costs and what bounds it, with derivatives by the unknowns of a transcription."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from armctl._core import Hit
from armctl.core.validation import Array
from armctl.plan.motion.torque_limits import TORQUE_MARGIN
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.free_space import FreeSpace
from armctl.plan.planner.transcription import SAMPLES, Derived, States, Transcription, Values, joined_values

_ITERATIONS = 25
_TOLERANCE = 1e-5  # of the cost, which is 1 before
_TORQUE_SAMPLES = slice(SAMPLES // 2, -1, SAMPLES // 2)  # at knots and middles; the torques at the ends are given
_SIMPSON = np.array([1.0, 4.0, 2.0, 4.0, 1.0]) / 12.0
_PAIRS = 3  # the nearest ones, whose distances are bounded at each sample
_NEAR_M = 0.1  # a pair that is free by more has no gradient
_FIRST_MARGIN_M = 2e-4  # of the distances at samples, for what is between them
_GREATEST_MARGIN_M = 0.02  # by which it grows at once
TINY = 1e-12


class Evaluation(NamedTuple):
    """A motion."""

    x: Array  # its unknowns
    cost: Values  # (1,)
    free: Values  # (R,) not negative inside the limits and away from everything
    gaps: Values  # (2 n,) zero at rest at the goal


class Descent:
    """Minimizes the weighted measures of the motions of a transcription, within all limits and free at its samples.

    Sequential quadratic programming: D. Kraft, A software package for sequential quadratic programming (1988).
    """

    def __init__(
        self, transcription: Transcription, space: FreeSpace, weights: Array, longest: float, spend: Callable[[], None]
    ):
        """`weights` (4,) are those of time, torque, vibration and distance; a motion lasts at most `longest`, s.

        `spend` counts evaluations, and may raise.
        """
        self.transcription = transcription
        self.last: Evaluation | None = None
        self._limits = transcription.limits
        self._space = space
        self._weights = weights
        self._longest = longest
        self._spend = spend
        self._margins = np.full(len(space.checker.geometry.pairs), _FIRST_MARGIN_M)

    def minimum(self, x: Array, center: Array, radius: float) -> Array:
        """The unknowns of a motion that costs less than that of x, not farther than a radius from a center."""
        low, high = self.transcription.bounds.T
        low = np.maximum(low, center - radius)
        high = np.minimum(high, center + radius)

        result = minimize(
            lambda x: float(self.at(x).cost.values[0]),
            np.clip(x, low, high),
            jac=lambda x: self.at(x).cost.slopes[0],
            method="SLSQP",
            bounds=np.transpose([low, high]),
            constraints=[
                {"type": "ineq", "fun": lambda x: self.at(x).free.values, "jac": lambda x: self.at(x).free.slopes},
                {"type": "eq", "fun": lambda x: self.at(x).gaps.values, "jac": lambda x: self.at(x).gaps.slopes},
            ],
            options={"maxiter": _ITERATIONS, "ftol": _TOLERANCE},
        )
        return np.clip(result.x, low, high)

    def keep_away(self, motion: JointTrajectory, hit: Hit) -> None:
        """Bounds the samples of a pair more tightly, which comes too near between them."""
        if self._space.checker.opens(hit):  # no pair of bodies
            self.last = None
            return
        times = hit.time + np.linspace(-0.5, 0.5, 33) * motion.duration / self.transcription.pieces
        depth = max(self._space.checker.depth(q, hit.pair) for q in motion.sample(times).q)
        lacking = 1.5 * (self._space.clearance + depth)
        self._margins[hit.pair] += np.clip(lacking, self._margins[hit.pair], _GREATEST_MARGIN_M)
        self.last = None

    def at(self, x: Array) -> Evaluation:
        """A motion's cost and bounds; the last one is kept, since each is asked for in several parts."""
        if self.last is None or (x != self.last.x).any():
            self._spend()
            self.last = self._evaluated(x.copy())
        return self.last

    def _evaluated(self, x: Array) -> Evaluation:
        transcription = self.transcription
        at = transcription.samples(x)
        q_slopes = transcription.slopes(at.q)
        tau, tau_slopes = transcription.torques(at)
        by_torque = Values(tau / self._limits.tau_max, tau_slopes / self._limits.tau_max[:, None])
        rows = [transcription.limit_rows(at, x), *_inside(by_torque, self._limits.tau_max)]
        shares = by_torque
        damping = self._limits.voltage_damping
        if damping.any():
            stall = self._limits.stall_torque
            slopes = tau_slopes + damping[:, None] * transcription.slopes(at.v)
            by_voltage = Values((tau + damping * at.v.values) / stall, slopes / stall[:, None])
            rows += _inside(by_voltage, stall)
            larger = np.abs(by_voltage.values) > np.abs(shares.values)
            shares = Values(
                np.where(larger, by_voltage.values, shares.values),
                np.where(larger[:, :, None], by_voltage.slopes, shares.slopes),
            )
        if len(self._margins):
            rows.append(self._distances(at.q.values[1:-1], q_slopes[1:-1]))
        measures = joined_values([*self._time_measures(at, x, shares), _length(Values(at.q.values, q_slopes))])
        rows.append(Values(1.0 - measures.values[:1] / self._longest, -measures.slopes[:1] / self._longest))
        cost = Values(self._weights[None] @ measures.values, self._weights[None] @ measures.slopes)
        return Evaluation(x, cost, joined_values(rows), transcription.end_gaps(at))

    def _time_measures(self, at: States, x: Array, shares: Values) -> list[Values]:
        """The duration, and the root mean square shares of torque and jerk."""
        transcription = self.transcription
        steps = transcription.steps(x)
        duration = Values(steps.values.sum(keepdims=True), steps.slopes.sum(axis=0, keepdims=True))
        pieces = transcription.pieces
        simpson = np.zeros((SAMPLES * pieces + 1, pieces))
        for piece in range(pieces):
            simpson[SAMPLES * piece : SAMPLES * (piece + 1) + 1, piece] = _SIMPSON
        times = Values(simpson @ steps.values, simpson @ steps.slopes)
        change = Derived(*(np.diff(part[::SAMPLES], axis=0) for part in at.a))
        most = steps.values[:, None] * self._limits.j_max
        jerk = change.values / most
        relative = steps.slopes / steps.values[:, None]
        jerks = Values(jerk, transcription.slopes(change) / most[:, :, None] - jerk[:, :, None] * relative[:, None, :])
        return [duration, _root_mean_square(shares, times, duration), _root_mean_square(jerks, steps, duration)]

    def _distances(self, q: Array, slopes: Array) -> Values:
        """What the nearest pairs at positions q (R, n) have above what they must keep, relative to `_NEAR_M`."""
        checker = self._space.checker
        still = np.zeros(q.shape[1])
        clearance = self._space.clearance
        kept = clearance + self._margins
        for end in (self.transcription.start, self.transcription.goal):
            near = checker.near(end, still, 1.0, clearance + 2.0 * self._margins)
            kept[near.pairs] = np.minimum(kept[near.pairs], 0.5 * (clearance + near.distances))
        values = np.full((len(q), _PAIRS), _NEAR_M)
        gradients = np.zeros((len(q), _PAIRS, q.shape[1]))
        for row, configuration in enumerate(q):
            near = checker.near(configuration, still, 1.0, kept + _NEAR_M)
            free = near.distances - kept[near.pairs]
            nearest = np.argsort(free, kind="stable")[:_PAIRS]
            values[row, : len(nearest)] = free[nearest]
            gradients[row, : len(nearest)] = near.gradients[nearest]
        return Values(values.ravel() / _NEAR_M, (gradients @ slopes).reshape(values.size, -1) / _NEAR_M)


def _inside(shares: Values, limits: Array) -> list[Values]:
    """What is not negative where the shares (R, n) of finite limits are inside."""
    limited = np.isfinite(limits)
    values = shares.values[_TORQUE_SAMPLES, limited].ravel()
    slopes = shares.slopes[_TORQUE_SAMPLES, limited].reshape(len(values), -1)
    bound = 1.0 - TORQUE_MARGIN
    return [Values(bound - values, -slopes), Values(bound + values, slopes)]


def _root_mean_square(shares: Values, times: Values, duration: Values) -> Values:
    """(1,) over joints and time, of shares (R, n) that last for some times (R,)."""
    n = shares.values.shape[1]
    squares = np.mean(shares.values**2, axis=1)
    square_slopes = 2.0 / n * np.einsum("ri,rix->rx", shares.values, shares.slopes)
    mean = times.values @ squares / duration.values
    slopes = (times.values @ square_slopes + squares @ times.slopes - mean * duration.slopes) / duration.values
    root = np.sqrt(np.maximum(mean, TINY**2))
    return Values(root, 0.5 * slopes / root)


def _length(q: Values) -> Values:
    """(1,) of a path through positions (R, n)."""
    lines = np.diff(q.values, axis=0)
    lengths = np.sqrt(np.sum(lines**2, axis=1) + TINY)
    slopes = np.einsum("ri,rix->x", lines / lengths[:, None], np.diff(q.slopes, axis=0))
    return Values(lengths.sum(keepdims=True), slopes[None])
