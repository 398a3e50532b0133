"""ExternalForce: torques and forces from outside, estimated from the momentum of an arm."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, array, number, vector
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.passive_forces import DryFriction, PassiveForces

_NOISE_SHARE = 0.01  # of the torque limits, until it is calibrated
_SPEED_NOISE = 0.014  # rad/s: of the difference of two positions with a noise of 1e-5 rad, over 1 ms
_NOISE_FACTOR = 5.0  # on the standard deviation: one tick in 2 million is above
_RESERVE = 2.0  # on the largest noise of a calibration: a few seconds do not show the largest of hours
_MODEL_RESERVE = 1.5  # links that are wrong in opposite directions
_FRICTION_SPEED = 0.02  # rad/s (m/s): friction turns below it
_RANK_TOLERANCE = 1e-3  # of the Jacobian: forces that only large torques would show are left out
_FRICTION_SHARE = 0.2  # of dry friction that is uncertain while a joint moves


class _Tick(NamedTuple):
    """What an update leaves to the next one."""

    momentum: Array  # (n,) N m s, by the known torques and the estimate
    inertia: Array  # (n, n) kg m^2
    bias: Array  # (n,) N m, of gravity, speeds and friction
    scale: Array  # (n,) N m, of the torques that an error of the model can explain


class ExternalForce:
    """A momentum observer: the torque of all forces on the arm that the model does not explain.

    The generalized momentum p = M v changes by the torques of motors, gravity, friction and whatever else acts. The residual
    r = K (p - integral of the known torques and r) follows the unknown ones with the bandwidth K, without accelerations.
    Source: De Luca, Albu-Schaeffer, Haddadin, Hirzinger, "Collision detection and safe reaction with the DLR-III lightweight
    manipulator arm" (2006).

    An alarm is a residual above its threshold: the noise, a share of the torques that an error of the model can explain, and
    dry friction where a joint may turn.

    Attributes:
        bandwidth: rad/s.
        model_error: The error of masses and inertias, as a share.
        noise: (n,) N m.
        torque: (n,) N m, the estimate.
        threshold: (n,) N m, of the last update.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = 50.0,
        model_error: float = 0.05,
        noise: ArrayLike | None = None,
        friction: Callable[[Array], Array] | None = None,
    ):
        """An observer at the start of a run.

        Args:
            arm: The model; that of `ArmEstimate.applied_to` if the arm was identified.
            bandwidth: rad/s: a force is seen after about its inverse. Noise grows with it.
            model_error: The error of masses and inertias, as a share, such as the relative error that `identify` reports.
            noise: (n,) N m, thresholds of an exact model; by default 1 % of the torque limits, and at least what encoders with
                a noise of 1e-5 rad cause at 1 ms. `calibrated` measures them.
            friction: Friction torques (n,) for speeds (n,), such as `ArmEstimate.friction_torque`; the model's by default.

        Raises:
            InputError: An argument is negative, not finite or of another length.
        """
        check_arm(arm)
        self.bandwidth = number("bandwidth", bandwidth, 1.0, 1e4)
        self.model_error = number("model_error", model_error, 0.0, 1.0)
        limits = np.where(np.isfinite(arm.limits.tau_max), arm.limits.tau_max, 100.0)
        of_speed = _NOISE_FACTOR * self.bandwidth * _SPEED_NOISE * np.linalg.norm(arm.mass_matrix(arm.home), axis=1)
        self.noise = np.maximum(_NOISE_SHARE * limits, of_speed) if noise is None else vector("noise", noise, arm.n)
        if (self.noise < 0.0).any():
            raise InputError("noise: every value must be at least 0")
        if friction is not None and not callable(friction):
            raise InputError("friction: expected a function of the speeds, such as ArmEstimate.friction_torque")
        self._arm = arm
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._passive = PassiveForces(arm.model, arm.joint_map)
        self._friction = friction
        self._loss = np.array(DryFriction.from_model(arm.model, arm.joint_map).loss)
        if friction is not None:
            fast = np.full(arm.n, 10 * _FRICTION_SPEED)
            self._loss = np.abs(vector("friction", friction(fast), arm.n))
        self._last: _Tick | None = None  # None before the first update
        self.torque = np.zeros(arm.n)
        self.threshold = np.array(self.noise)

    def reset(self) -> None:
        """Forgets the run."""
        self._last = None
        self.torque = np.zeros(self._arm.n)
        self.threshold = np.array(self.noise)

    def update(self, q: ArrayLike, v: ArrayLike, torque: ArrayLike, dt: float) -> Array:
        """Takes the measurements of a tick.

        Args:
            q: (n,) rad, now.
            v: (n,) rad/s, now.
            torque: (n,) N m of the motors since the last call; of no effect in the first one.
            dt: s since the last call.

        Returns:
            (n,) N m, the torque from outside.
        """
        n = self._arm.n
        q = vector("q", q, n)
        v = vector("v", v, n)
        tau = vector("torque", torque, n)
        dt = number("dt", dt, 1e-6, 1.0)
        inertia = self._dynamics.mass_matrix(q)
        last = self._last
        if last is None:
            momentum = inertia @ v
            scale = np.zeros(n)
        else:
            # d(M v) = M dv + dM v, and M dv is what the known torques do in a tick.
            known = tau - last.bias + self.torque
            momentum = last.momentum + dt * known + (inertia - last.inertia) @ v
            gain = (1 - np.exp(-self.bandwidth * dt)) / dt
            self.torque = gain * (inertia @ v - momentum)
            scale = last.scale
        gravity = self._dynamics.gravity(q)
        bias = self._dynamics.inverse_dynamics(q, v, np.zeros(n)) + self._dry_friction(v)
        share = 1 - np.exp(-self.bandwidth * dt)
        scale = scale + share * (np.abs(gravity) + np.abs(tau - bias) - scale)
        self._last = _Tick(momentum, inertia, bias, scale)
        uncertain = np.where(np.abs(v) > 2 * _FRICTION_SPEED, _FRICTION_SHARE, 1.0) * self._loss
        self.threshold = self.noise + _MODEL_RESERVE * self.model_error * scale + uncertain
        return self.torque

    @property
    def alarm(self) -> str:
        """The joint whose torque from outside is above its threshold, in words; empty if there is none."""
        share = np.abs(self.torque) / np.maximum(self.threshold, np.finfo(float).tiny)
        worst = int(share.argmax())
        if not share[worst] > 1.0:
            return ""
        unit = self._arm.torque_units[worst]
        return f"{self.torque[worst]:.3g} {unit} from outside at {self._arm.joint_names[worst]}"

    def wrench(self, q: ArrayLike) -> Array:
        """The smallest force and moment on the tip that explain the estimate.

        Args:
            q: (n,) rad.

        Returns:
            (6,) N and N m, world axes, at the tip. For an arm with less than six joints, what its joints do not feel is 0.
        """
        found = np.linalg.lstsq(self._arm.jacobian(q).T, self.torque, rcond=_RANK_TOLERANCE)[0]
        return np.asarray(found, dtype=np.float64)

    def calibrated(self, q: ArrayLike, v: ArrayLike, torque: ArrayLike, dt: float) -> ExternalForce:
        """An observer whose noise is that of a recording without contact.

        Args:
            q: (T, n) rad, measured.
            v: (T, n) rad/s, measured.
            torque: (T, n) N m, of the motors in the tick that begins at each row.
            dt: s, the tick.

        Returns:
            A new observer at the start of a run.

        Raises:
            InputError: The arrays have other shapes, or a number is not finite.
        """
        rows = [array(name, value, 2) for name, value in (("q", q), ("v", v), ("torque", torque))]
        if len({each.shape for each in rows}) > 1 or rows[0].shape[1] != self._arm.n or len(rows[0]) < 2:
            raise InputError(f"q, v and torque: expected the same rows of {self._arm.n} numbers, got {[x.shape for x in rows]}")
        found = copy.copy(self)
        found.noise = np.zeros(self._arm.n)
        found.reset()
        largest = np.zeros(self._arm.n)
        tau = rows[2][0]
        for q_now, v_now, tau_next in zip(*rows, strict=True):
            found.update(q_now, v_now, tau, dt)
            largest = np.maximum(largest, np.abs(found.torque) - found.threshold)
            tau = tau_next
        found.noise = _RESERVE * largest
        found.reset()
        return found

    def _dry_friction(self, v: Array) -> Array:
        """(n,) N m, friction without the model's damping."""
        if self._friction is None:
            return self._loss * np.clip(v / _FRICTION_SPEED, -1.0, 1.0)
        return self._friction(v) - self._passive.damping_torque(v)
