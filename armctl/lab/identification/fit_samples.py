"""The rows of a fit of torques, the speeds at which torques act, and the costs of candidates for dry friction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from armctl.core.filtering import choose_cutoff, derivatives, low_pass, velocity_cutoff
from armctl.core.log import Log
from armctl.core.validation import Array
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.passive_forces import DryFriction

_VELOCITY_NOISE = 2e-3  # rad/s (m/s), RMS in the velocity that dry friction follows


@dataclass(frozen=True, slots=True, eq=False)
class FitSamples:
    t: Array  # (K,) s
    v: Array  # (K, n) rad/s
    tau: Array  # (K, n) N m, measured
    model: Array  # (K, n) N m, by the model
    W: Array  # (K, n, p), the regressor
    start: Array  # (K, n) N m, by the arm's own model, dry friction included
    by_shape: Array  # (K, n) N m, the derivative of the torques by the logarithm of the slope of dry friction
    used: Array  # (K, n), 1 for a torque that the fit uses, 0 close to a reversal of a joint, where dry friction is uncertain

    def __len__(self) -> int:
        return len(self.t)

    def part(self, rows: slice) -> FitSamples:
        return FitSamples(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


class Speeds(NamedTuple):
    """The speeds at which torques act, each (T, n) rad/s: Coriolis torques, damping, dry friction."""

    start: Array
    end: Array
    dry: Array


class LawFit(NamedTuple):
    """MuJoCo's law of dry friction, each (n,): slope N m s/rad, bound N m, and the cost of the fit."""

    slope: Array
    bound: Array
    cost: Array


def speeds_of_torques(law: DryFriction | None, dynamics: Dynamics, log: Log, q: Array, v: Array, a: Array) -> Speeds:
    """The speeds at which each kind of torque acts, from filtered velocities and accelerations.

    MuJoCo's step takes Coriolis torques at the velocity before, damping at the end, and dry friction at a velocity that the
    acceleration advances (`DryFriction`): here a fast one, in which short stops show. A real arm moves continuously.
    """
    fast = max(choose_cutoff(log.q, log.dt), velocity_cutoff(log.q, log.dt, _VELOCITY_NOISE))
    dry = derivatives(low_pass(log.q, fast, log.dt), log.dt)[0]
    if law is None:
        return Speeds(v, v, dry)
    half_step = 0.5 * log.dt * a
    start = v - half_step
    explicit = np.array([dynamics.explicit_acceleration(*row, log.dt) for row in zip(q, start, a, strict=True)])
    return Speeds(start, v + half_step, dry - half_step + explicit / law.rate)


def best_of(candidates: Array, costs: Callable[[Array], Array]) -> Array:
    """(n,) for each joint the candidate (k, n) of the least cost."""
    best = np.array([costs(candidate) for candidate in candidates]).argmin(axis=0)
    return candidates[best, np.arange(candidates.shape[1])]


def squared_residual(friction: Array, v: Array, torques: Array) -> float:
    """The squared residual of torques that columns of dry friction, viscous friction and an offset explain."""
    A = np.column_stack([friction, v, np.ones(len(v))])
    return float(((torques - A @ np.linalg.lstsq(A, torques)[0]) ** 2).sum())


def cost_of_damping(v: Array, error: float, torques: Array) -> float:
    """The squared residual of torques that damping, with a standard deviation before any data, and an offset explain."""
    v = v - v.mean()
    torques = torques - torques.mean()
    damping = float(v @ torques) / (float(v @ v) + error**-2)
    return float(torques @ torques) - damping * float(v @ torques)
