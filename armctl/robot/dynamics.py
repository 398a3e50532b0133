"""Equations of motion of an arm: mass matrix, Coriolis and gravity torques, inverse and forward dynamics.

    tau = M(q) a + bias(q, v) + passive(q, v) + friction(q, v, a)

Pinocchio computes M and bias; M includes armature. Passive forces are joint springs, damping and gravity compensation.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.errors import ModelError
from armctl.core.validation import Array
from armctl.mjmodel.queries import joint_name
from armctl.robot.passive_forces import DryFriction, PassiveForces, is_enabled
from armctl.robot.pinocchio_model import PinocchioModel

rnea = pin.rnea  # the innermost call of a control period: a look-up in the module takes a noticeable share of it


@dataclass(frozen=True, slots=True, eq=False)
class Integrator:
    """Which forces MuJoCo's integrator evaluates at the velocity at the end of a step.

    Source: MuJoCo documentation, Computation, "Numerical integration".
    """

    implicit_damping: bool  # joint damping: Euler (unless `eulerdamp` is disabled), implicitfast and implicit
    implicit_coriolis: bool  # coriolis and centrifugal forces: implicit

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Integrator:
        kind = mujoco.mjtIntegrator(model.opt.integrator)
        euler_damp = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        explicit_euler = kind == mujoco.mjtIntegrator.mjINT_EULER and not euler_damp
        return cls(
            implicit_damping=kind != mujoco.mjtIntegrator.mjINT_RK4 and not explicit_euler,
            implicit_coriolis=kind == mujoco.mjtIntegrator.mjINT_IMPLICIT,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _StepModel:
    """A Pinocchio model for one step of dt: implicit damping D acts like an additional armature dt D, (n,) kg m^2."""

    dt: float
    pin_model: pin.Model
    damping_armature: Array


class Dynamics:
    """The equations of motion of an arm; everything outside its chain stands still.

    An object has its own scratch memory: use it in one thread at a time.
    """

    def __init__(self, model: mujoco.MjModel, pinocchio_model: PinocchioModel):
        joint_map = pinocchio_model.joint_map
        passive = PassiveForces(model, joint_map)
        integrator = Integrator.of(model)
        self._joint_map = joint_map
        self._passive = passive
        self._dry_friction = DryFriction.of(model, joint_map)
        self.damping = passive.damping  # (n,) N m s/rad, linear viscous damping of the joints
        self.friction_loss = self._dry_friction.loss  # (n,) N m, dry friction of the joints
        self.has_friction = bool(self.friction_loss.any())  # whether any joint has dry friction
        self._model = pinocchio_model.pin_model
        self._data = self._model.createData()
        # In LOCAL, the faster one, Pinocchio adds mimic joints to what an earlier call left behind.
        self._convention = pin.Convention.LOCAL if joint_map.is_plain else pin.Convention.WORLD
        self._gravity_support = pinocchio_model.gravity_support
        self._support_data = self._gravity_support.createData() if self._gravity_support is not None else None
        # Pinocchio has no derivatives of the inverse dynamics of mimic joints.
        self._implicit_coriolis = integrator.implicit_coriolis and joint_map.is_plain
        self._implicit_damping = passive.damping * integrator.implicit_damping
        self._implicit_nonlinear = self._implicit_coriolis or (integrator.implicit_damping and passive.has_nonlinear_damping)
        self._implicit_in_velocity = self._implicit_nonlinear or (integrator.implicit_damping and passive.is_damped)
        self._step = self._new_step_model(0.0)
        self._payload_basis = _payload_basis(pinocchio_model.T_last_tip)
        followers = np.setdiff1d(np.arange(len(joint_map.joints)), joint_map.leaders)
        self._is_upper = np.triu(np.ones((len(joint_map.leaders), len(joint_map.leaders)), bool))
        self._followers = tuple(joint_name(model, joint_map.joints[k]) for k in followers)

    def mass_matrix(self, q: Array) -> Array:
        """M(q) with armature, (n, n) kg m^2, symmetric."""
        M = pin.crba(self._model, self._data, q, self._convention)  # guarantees the upper triangle only
        return np.where(self._is_upper, M, M.T)

    def bias(self, q: Array, v: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, MuJoCo's `qfrc_bias`, (n,) N m."""
        return pin.nonLinearEffects(self._model, self._data, q, v).copy()

    def coriolis(self, q: Array, v: Array) -> Array:
        """Coriolis and centrifugal torques C(q, v) v, (n,) N m."""
        return self.bias(q, v) - self.bias(q, np.zeros_like(v))

    def gravity(self, q: Array) -> Array:
        """The torque that holds the arm at rest: gravity minus gravity compensation, plus springs; (n,) N m."""
        tau = pin.computeGeneralizedGravity(self._model, self._data, q).copy()
        return self._with_position_forces(tau, q)

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Torque for an acceleration in continuous time, without dry friction; (n,) N m."""
        tau = rnea(self._model, self._data, q, v, a)
        if self._passive.is_damped:
            tau = tau + self._passive.damping_torque(v)
        return self._with_position_forces(tau, q)

    def discrete_inverse_dynamics(self, q: Array, v: Array, a: Array, dt: float) -> Array:
        """Inverse of MuJoCo's discrete step: the torque for which (v_next - v) / dt is exactly a; no dry friction; (n,) N m.

        This is what `mj_inverse` computes with `mjENBL_INVDISCRETE`. RK4 has no such inverse: it gets the continuous one.
        With dt = 0 this is `inverse_dynamics`.
        """
        step = self._step if dt == self._step.dt else self._new_step_model(dt)  # dt rarely changes between calls
        tau = rnea(step.pin_model, self._data, q, v, a)
        if self._passive.is_damped:
            tau = tau + self._passive.damping_torque(v)
        if self._implicit_nonlinear and dt:
            tau = tau + dt * self._implicit_nonlinear_change(q, v, a)
        return self._with_position_forces(tau, q)

    def forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        """Acceleration in continuous time, without dry friction: the inverse of `inverse_dynamics`; (n,) rad/s^2."""
        return self._solve_mass_matrix(q, tau - self.inverse_dynamics(q, v, np.zeros_like(v)))

    def payload_regressor(self, q: Array, v: Array, a: Array) -> Array:
        """(n, 4): `regressor @ [m, m cx, m cy, m cz]` is the torque of a point mass m at c in the tip's frame.

        The inertia m c c^T about the tip is not linear in these four and is left out: it is small if c is. ModelError
        if a joint of the arm follows another: Pinocchio has no regressor for that.
        """
        if self._followers:
            raise ModelError(f"{self._followers[0]}: no payload can be identified where one joint follows another")
        regressor = pin.computeJointTorqueRegressor(self._model, self._data, q, v, a)
        return regressor.reshape(len(q), -1)[:, -10:] @ self._payload_basis

    def friction(self, v: Array, a: Array) -> Array:
        """The torque that overcomes dry friction in continuous time, by MuJoCo's law (`DryFriction`); (..., n) N m."""
        return self._dry_friction.torque(v, a)

    def discrete_friction(self, q: Array, v: Array, a: Array, dt: float) -> Array:
        """The torque that overcomes dry friction in MuJoCo's discrete step; (n,) N m."""
        if not self.has_friction:
            return np.zeros_like(self.friction_loss)
        return self._dry_friction.torque(v, self.explicit_acceleration(q, v, a, dt))

    def explicit_acceleration(self, q: Array, v: Array, a: Array, dt: float) -> Array:
        """The acceleration before forces that are implicit in velocity, on which dry friction acts; (n,) rad/s^2.

        Where damping is large and inertia small, it is many times the acceleration of the step.
        """
        if not (dt and self._implicit_in_velocity):
            return a
        step = self._step if dt == self._step.dt else self._new_step_model(dt)
        implicit = step.damping_armature * a
        if self._implicit_nonlinear:
            implicit = implicit + dt * self._implicit_nonlinear_change(q, v, a)
        return a + self._solve_mass_matrix(q, implicit)

    def _new_step_model(self, dt: float) -> _StepModel:
        """Makes the model for dt and keeps it for the next call."""
        pin_model = self._model.copy()
        damping_armature = dt * self._implicit_damping
        pin_model.armature = self._model.armature + damping_armature
        self._step = _StepModel(dt, pin_model, damping_armature)
        return self._step

    def _solve_mass_matrix(self, q: Array, tau: Array) -> Array:
        """M(q)^-1 tau."""
        if not self._joint_map.is_plain:  # Pinocchio does not factorize M with mimic joints
            return np.asarray(np.linalg.solve(self.mass_matrix(q), tau), dtype=np.float64)
        pin.crba(self._model, self._data, q)
        pin.cholesky.decompose(self._model, self._data)
        return pin.cholesky.solve(self._model, self._data, tau)

    def _with_position_forces(self, tau: Array, q: Array) -> Array:
        """A torque plus that of the springs, minus gravity compensation."""
        if self._passive.has_springs:
            tau = tau + self._passive.spring_torque(q)
        if self._gravity_support is not None:
            tau = tau - pin.computeGeneralizedGravity(self._gravity_support, self._support_data, q)
        return tau

    def _implicit_nonlinear_change(self, q: Array, v: Array, a: Array) -> Array:
        """Rate at which the implicit forces change during a step, d(force)/dv a; linear damping is in the armature instead."""
        change = self._passive.nonlinear_damping_slope(v) * a
        if self._implicit_coriolis:
            change = change + pin.computeRNEADerivatives(self._model, self._data, q, v, np.zeros_like(a))[1] @ a
        return change


def _payload_basis(T_last_tip: Array) -> Array:
    """(10, 4): Pinocchio's ten inertial parameters in the last joint's frame from m and m c in the tip's.

    With p = r + R c, a point mass has first moment m p and second moment S = m p p^T, of which I = tr(S) 1 - S.
    """
    R = T_last_tip[:3, :3]
    r = T_last_tip[:3, 3]
    basis = np.zeros((10, 4))
    for k in range(4):
        m = 1.0 if k == 0 else 0.0
        h = np.zeros(3) if k == 0 else R[:, k - 1]
        S = m * np.outer(r, r) + np.outer(r, h) + np.outer(h, r)
        inertia = np.trace(S) * np.eye(3) - S
        basis[:, k] = [m, *(m * r + h), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]
    return basis
