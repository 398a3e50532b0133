"""The smallest tracking error that any identification can reach with the data of `identification.py`.

The estimator behind the bound knows all positions, velocities and accelerations exactly, the shape of the friction, and how the
benchmark makes its models wrong. With dry friction, the amount of all friction is unknown. Only the noise of the torques limits
it. It is the linear estimator of least variance: with the information I of all ticks and the covariance S = L L^T of the
parameters before any data, the covariance of its error is C = L (1 + L^T I L)^-1 L^T. Parameter errors become tracking errors
by the linear equation of the controllers' error.
Source: Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), 10-12.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import armctl
from armctl.control.gains import extra_inertia
from armctl.control.observer_gains import observer_gains
from armctl.core.validation import Array
from armctl.design.regressor import ArmRegressor, FrictionShape
from armctl.robot.passive_forces import DryFriction

_MODELS = 300  # from which the covariance before any data follows
_FRICTION_SHARE = 0.1  # of the torque limits: standard deviation of unknown Coulomb friction, and of viscous at 1 rad/s
_MIN_SMOOTHING = 1e-6  # rad/s
_EVERY = 4  # ticks between the states of the regressor
_SIMILAR_SEEDS = 1000  # seeds of the models from which the covariance follows start here


@dataclass(frozen=True)
class Bound:
    """The least expected errors.

    Attributes:
        computed_torque: rad, RMS over time and joints.
        observer: rad, likewise with the observer.
        coulomb: (n,) share of the true Coulomb friction, standard deviation; NaN without.
    """

    computed_torque: float
    observer: float
    coulomb: Array


class BoundFinder:
    """Bounds for one arm on one motion of a controller's test."""

    def __init__(self, arm: armctl.Arm, test: armctl.JointTrajectory, tick: float, noise_share: float):
        self._arm = arm
        self._regressor = ArmRegressor(arm, "coulomb+viscous")
        self._test = test
        self._tick = tick
        self._noise = noise_share * arm.limits.tau_max

    def bound(self, real: armctl.Arm, log: armctl.Log, changed: Callable[[int], armctl.Arm]) -> Bound:
        """The bound for a recording of a real arm.

        Args:
            real: The real arm.
            log: A run of it without noise.
            changed: An arm of the same distribution as the real one, by its seed.
        """
        layout = self._regressor.layout
        acceleration = np.gradient(log.v, log.dt, axis=0)
        rows = self._rows(real, log.q[::_EVERY], log.v[::_EVERY], acceleration[::_EVERY]) / self._noise[:, None]
        W = rows.reshape(-1, layout.size)
        before = np.array([self._parameters(changed(_SIMILAR_SEEDS + seed)) for seed in range(_MODELS)])
        L = (before - before.mean(axis=0)).T / np.sqrt(_MODELS)
        true = real.model.dof_frictionloss[real.dof_adr]
        if (true != self._arm.model.dof_frictionloss[self._arm.dof_adr]).any():
            for part in (layout.coulomb, layout.viscous):
                friction = np.zeros((layout.size, layout.n))
                friction[part] = np.diag(_FRICTION_SHARE * self._arm.limits.tau_max)
                L = np.column_stack([L, friction])
        WL = W @ L
        C = L @ np.linalg.inv(np.eye(L.shape[1]) + _EVERY * WL.T @ WL) @ L.T
        deviation = np.sqrt(np.diag(C)[layout.coulomb])
        with np.errstate(divide="ignore", invalid="ignore"):
            coulomb = np.where(true > 0, deviation / true, np.nan)
        plain, observed = self._sensitivity(real)
        return Bound(_expected_rms(plain, C), _expected_rms(observed, C), coulomb)

    def _parameters(self, arm: armctl.Arm) -> Array:
        """All parameters of an arm as the regressor orders them."""
        layout = self._regressor.layout
        x = np.zeros(layout.size)
        for i in range(layout.n):
            x[layout.link(i)] = arm.pinocchio_model.pin_model.inertias[i + 1].toDynamicParameters()
        x[layout.rotor] = arm.model.dof_armature[arm.dof_adr]
        x[layout.viscous] = arm.model.dof_damping[arm.dof_adr]
        x[layout.coulomb] = arm.model.dof_frictionloss[arm.dof_adr]
        return x

    def _rows(self, real: armctl.Arm, q: Array, v: Array, a: Array) -> Array:
        """The regressor of states, with MuJoCo's dry friction of the real arm."""
        n = self._arm.n
        law = DryFriction.of(real.model, real.joint_map)
        smoothing = np.maximum(law.loss / (law.gain * law.rate), _MIN_SMOOTHING)
        shape = FrictionShape(smoothing, np.ones(n))
        W = self._regressor.rows(q, v, a, shape)
        self._regressor.set_friction(W, v, self._regressor.dry_friction(v + a / law.rate, shape))
        return W

    def _sensitivity(self, real: armctl.Arm) -> tuple[Array, Array]:
        """(T, n, p) rad for each parameter: the tracking errors of computed torque without and with the observer.

        Computed torque turns a torque error d into M e'' + (M + A) (kp e + kd e') = d, with the inertia A that it adds. The
        observer subtracts d after a low-pass filter, one tick later.
        """
        dt = self._tick
        states = self._test.sample(np.arange(0.0, self._test.duration, dt))
        W = self._rows(real, states.q[::_EVERY], states.v[::_EVERY], states.a[::_EVERY])
        law = armctl.ComputedTorque(self._arm)
        added = np.diag(extra_inertia(self._arm, law.bandwidth, law.damping_ratio, dt))
        gains = observer_gains(self._arm, dt)
        share = 1.0 - np.exp(-gains.disturbance * dt)
        plain = _Error(law.bandwidth, law.damping_ratio, W.shape[1:])
        observed = _Error(gains.feedback, gains.damping_ratio, W.shape[1:])
        estimate = np.zeros(W.shape[1:])
        errors = np.empty((2, *W.shape))
        for k in range(len(states.q)):
            row = k // _EVERY
            if k % _EVERY == 0:
                M = self._arm.mass_matrix(states.q[k])
                inverse = np.linalg.inv(M)
                feedback = inverse @ (M + added)
                errors[0, row] = plain.e
                errors[1, row] = observed.e
            plain.step(inverse @ W[row], feedback, dt)
            observed.step(inverse @ (W[row] - estimate), np.eye(len(M)), dt)
            estimate += share * (W[row] - estimate)
        return errors[0], errors[1]


class _Error:
    """A tracking error e (n, p) of each parameter, and its rate."""

    def __init__(self, bandwidth: float, damping_ratio: float, shape: tuple[int, ...]):
        self._stiffness = bandwidth**2
        self._damping = 2 * damping_ratio * bandwidth
        self.e = np.zeros(shape)
        self._rate = np.zeros(shape)

    def step(self, acceleration: Array, feedback: Array, dt: float) -> None:
        """One tick with an acceleration that is not known to the controller."""
        acceleration = acceleration - feedback @ (self._stiffness * self.e + self._damping * self._rate)
        self._rate = self._rate + dt * acceleration
        self.e = self.e + dt * self._rate


def _expected_rms(errors: Array, covariance: Array) -> float:
    """The root of the expected square of errors that are linear in the parameters."""
    return float(np.sqrt(np.einsum("tni,ij,tnj->", errors, covariance, errors) / (errors.shape[0] * errors.shape[1])))
