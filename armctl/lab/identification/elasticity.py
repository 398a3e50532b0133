"""identify_elasticity: the stiffness of the springs between motors and links, from a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.filtering import choose_cutoff, derivatives, low_pass
from armctl.core.log import Log
from armctl.core.result import Verdict
from armctl.core.validation import Array, frozen, instance, matrix
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.passive_forces import PassiveForces

_MIN_SIGNIFICANCE = 5.0  # standard errors: a compliance below it is not shown
_SAMPLES_PER_PERIOD = 12.0  # of the cut-off
_TRIMMED_PERIODS = 4.0  # at both ends, where derivatives of a filtered signal are wrong
_LOWER_CUTOFF = 0.7
_MAX_RESONANCE = 5.0  # of the cut-off: above, a spring changes torques by less than 4 %, which other faults of a model do, too
_MAX_EVALUATIONS = 20
_RANK_TOLERANCE = 1e-10
_STICTION_SPEED = 0.02  # rad/s, over which dry friction turns


@dataclass(frozen=True, slots=True, eq=False)
class ElasticityEstimate(Verdict):
    """The springs of elastic joints, identified from a recording. True if it shows those of all joints.

    Attributes:
        ok: Whether the recording shows the elasticity of every joint.
        reason: The joints whose elasticity it does not show; empty if there are none.
        elasticity: (n,) N m/rad; infinite where the recording shows none.
        compliance: (n,) rad/(N m), as it was fitted.
        compliance_error: (n,) standard errors.
    """

    ok: bool
    reason: str
    elasticity: Array
    compliance: Array
    compliance_error: Array


def identify_elasticity(arm: Arm, log: Log, motor_positions: ArrayLike | None = None) -> ElasticityEstimate:
    """Identifies the springs between motors and links of an arm whose links and rotors are known.

    With positions of both sides, deflections are fitted to the torques of the links. With those of the motors only, torques of
    the motors are: a spring changes them by (frequency / resonance)^2, so only a fast motion shows it. Rotor inertia, friction
    and offset of each motor are fitted, too.

    Args:
        log: A recording: positions of the links if those of the motors are given, or else positions and torques of the motors.
        motor_positions: (T, n) rad, beside those of the links in the log.

    Returns:
        The estimate. It is not ok, with a reason, if the motion does not show the spring of each joint.

    Raises:
        InputError: An argument is of another kind or shape, or too short.
    """
    check_arm(arm)
    instance("log", log, Log, "armctl.simulate and armctl.Log.from_csv give one")
    motors = log.q if motor_positions is None else matrix("motor_positions", motor_positions, arm.n)
    if log.q.shape[1] != arm.n or motors.shape != log.q.shape:
        raise InputError(f"motor_positions: expected finite numbers, {len(log)} x {arm.n}, as the log's, got {motors.shape}")
    cutoff = choose_cutoff(log.q, log.dt)
    found, errors = _fitted(arm, log, motors, cutoff, motor_positions is None)
    if motor_positions is None:
        # Noise of positions biases this fit, most at high frequencies: the errors are at least what a lower cut-off changes.
        lower, _ = _fitted(arm, log, motors, _LOWER_CUTOFF * cutoff, True)
        inertia = arm.mass_matrix(arm.limits.clamp(arm.home)).diagonal()
        shown = 1 / (inertia * (2 * np.pi * _MAX_RESONANCE * cutoff) ** 2)
        errors = np.maximum(errors, np.maximum(np.abs(found - lower), shown / _MIN_SIGNIFICANCE))
    hidden = found < _MIN_SIGNIFICANCE * errors
    names = ", ".join(name for name, is_hidden in zip(arm.joint_names, hidden, strict=True) if is_hidden)
    reason = f"the motion does not show the elasticity of {names:.200}; record a faster one, or both sides" if names else ""
    stiffness = np.divide(1.0, found, out=np.full(arm.n, np.inf), where=~hidden)
    return ElasticityEstimate(
        ok=not reason, reason=reason, elasticity=frozen(stiffness), compliance=frozen(found), compliance_error=frozen(errors)
    )


def _fitted(arm: Arm, log: Log, motors: Array, cutoff: float, from_torques: bool) -> tuple[Array, Array]:
    """Compliances and their standard errors, from signals up to a cut-off."""
    trimmed = round(_TRIMMED_PERIODS / cutoff / log.dt)
    stride = max(1, int(1 / (_SAMPLES_PER_PERIOD * cutoff * log.dt)))
    rows = slice(trimmed // stride, (len(log) - trimmed) // stride)
    if rows.stop - rows.start < _SAMPLES_PER_PERIOD * _TRIMMED_PERIODS:
        raise InputError(f"log: {len(log) * log.dt:.3g} s are too short for {cutoff:.3g} Hz; record a longer motion")
    springs = _Springs(arm, cutoff, log.dt * stride, rows)
    q = low_pass(log.q, cutoff, log.dt)[::stride]
    if from_torques:
        return springs.by_torques(q, low_pass(log.tau, cutoff, log.dt)[::stride])
    return springs.by_deflections(q, low_pass(motors, cutoff, log.dt)[::stride] - q)


class _Springs:
    def __init__(self, arm: Arm, cutoff: float, dt: float, rows: slice):
        self.arm = arm
        arm.joint_map.require_no_loops()
        self.armature = np.array(arm.pinocchio_model.pin_model.armature)
        self.passive = PassiveForces(arm.model, arm.joint_map)
        self.cutoff = cutoff
        self.dt = dt
        self.rows = rows
        # Filtered signals are independent over half a period of the cut-off.
        self.inflation = np.sqrt(0.5 / (cutoff * dt))

    def load(self, q: Array) -> Array:
        """(T, n) N m, torques of the springs that move the links along q."""
        v, a = derivatives(q, self.dt)
        rigid = [self.arm.inverse_dynamics(*row) for row in zip(q, v, a, strict=True)]
        damping = [self.passive.damping_torque(row) for row in v]
        return np.array(rigid) - self.armature * a - np.array(damping)

    def by_deflections(self, q: Array, deflection: Array) -> tuple[Array, Array]:
        load = low_pass(self.load(q), self.cutoff, self.dt)[self.rows]
        load = load - load.mean(axis=0)
        moved = deflection[self.rows] - deflection[self.rows].mean(axis=0)
        power = (load**2).sum(axis=0)
        found = (load * moved).sum(axis=0) / power
        noise = np.sqrt(((moved - found * load) ** 2).mean(axis=0))
        return found, self.inflation * noise / np.sqrt(power)

    def by_torques(self, motors: Array, tau: Array) -> tuple[Array, Array]:
        from scipy.optimize import least_squares

        n = self.arm.n
        v, a = derivatives(motors, self.dt)
        own = np.stack([a, v, np.clip(v / _STICTION_SPEED, -1.0, 1.0), np.ones_like(v)])
        rate = derivatives(tau, self.dt)[0]

        def residual(z: Array) -> Array:
            load = tau + z[-1] * rate - np.einsum("ktn,kn->tn", own, z[n:-1].reshape(4, n))
            return low_pass(load - self.load(motors - z[:n] * load), self.cutoff, self.dt)[self.rows].ravel()

        start = np.concatenate([np.zeros(n), self.armature, np.zeros(3 * n + 1)])
        lowest = np.where(np.arange(5 * n + 1) // n % 4 == 0, -np.inf, 0.0)  # of compliances and offsets
        lowest[-1] = -np.inf
        solve: Any = least_squares
        found = solve(residual, start, bounds=(lowest, np.inf), x_scale="jac", max_nfev=_MAX_EVALUATIONS, ftol=1e-6)
        scale = np.maximum(np.linalg.norm(found.jac, axis=0), np.finfo(float).tiny)
        inverse = np.linalg.pinv((found.jac / scale).T @ (found.jac / scale), rcond=_RANK_TOLERANCE)
        noise = np.sqrt(np.mean(found.fun**2))
        return found.x[:n], self.inflation * noise * np.sqrt(np.diag(inverse)[:n]) / scale[:n]
