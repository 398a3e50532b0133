"""Dynamics of an arm: mass matrix, bias, and the torque that a motion takes, all of what MuJoCo simulates included.

    tau = M(q) a + bias(q, v) + passive(q, v, a) + friction(q, v, a)

M and bias are Pinocchio's; armature is in M. Passive forces are joint damping and springs and gravity compensation.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.errors import ModelError
from armctl.core.validation import Array, IntArray
from armctl.robot.arm import Arm, check_arm


class Dynamics:
    """The equations of motion of an arm, with everything outside its chain held still.

    Attributes:
        arm: The arm.
        damping: (n,) N m s/rad, viscous damping of the joints.
        friction_loss: (n,) N m, dry friction of the joints.
        has_friction: Whether any joint has dry friction.
        is_discrete: Whether the model's integrator makes a step that `inverse` inverts exactly; RK4 does not.
    """

    def __init__(self, arm: Arm):
        """The dynamics of an arm.

        Args:
            arm: The arm.

        Raises:
            InputError: It is no arm.
        """
        check_arm(arm)
        model, joint_map = arm.model, arm.joint_map
        dofs, share = joint_map.dof_adr, np.abs(joint_map.ratio.T)
        joints = model.dof_jntid[dofs]
        self.arm, self._joint_map = arm, joint_map
        self.damping = share**2 @ model.dof_damping[dofs] * _acts(model, mujoco.mjtDisableBit.mjDSBL_DAMPER)
        dry = _acts(model, mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) * _acts(model, mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
        self.friction_loss = share @ model.dof_frictionloss[dofs] * dry
        self._model, self._data = arm.pinocchio_model.pin_model, arm.pinocchio_model.pin_model.createData()
        # In LOCAL, the faster one, Pinocchio adds mimic joints to what an earlier call left behind.
        self._convention = pin.Convention.LOCAL if joint_map.is_plain else pin.Convention.WORLD
        self._support = arm.pinocchio_model.gravity_support
        self._support_data = self._support.createData() if self._support is not None else None
        quadratic, cubic = model.dof_dampingpoly[dofs].T * _acts(model, mujoco.mjtDisableBit.mjDSBL_DAMPER)
        self._damping_poly = np.column_stack([share**3 @ quadratic, share**4 @ cubic])
        self._stiffness = np.column_stack([model.jnt_stiffness[joints], model.jnt_stiffnesspoly[joints]])
        self._stiffness *= _acts(model, mujoco.mjtDisableBit.mjDSBL_SPRING)
        self._rest = model.qpos_spring[joint_map.qpos_adr].copy()
        self._is_damped = bool(self.damping.any() or self._damping_poly.any())
        self._has_poly_damping = bool(self._damping_poly.any())
        self._has_springs = bool(self._stiffness.any())
        self._has_static = self._has_springs or self._support is not None
        self.has_friction = bool(self.friction_loss.any())
        self._friction_gain, self._friction_rate = _friction_constants(model, arm.dof_adr)
        integrator = mujoco.mjtIntegrator(model.opt.integrator)
        explicit = not _acts(model, mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        self.is_discrete = integrator != mujoco.mjtIntegrator.mjINT_RK4
        self._damps_at_end = self.is_discrete and not (integrator == mujoco.mjtIntegrator.mjINT_EULER and explicit)
        self._turns_at_end = integrator == mujoco.mjtIntegrator.mjINT_IMPLICIT and joint_map.is_plain
        self._changes_late = self._turns_at_end or (self._damps_at_end and self._is_damped)
        self._curves_late = self._turns_at_end or (self._damps_at_end and self._has_poly_damping)
        self._stepping = self._model.copy()
        self._set_step(0.0)
        self._payload_basis = _payload_basis(arm.pinocchio_model.T_last_tip)

    def mass_matrix(self, q: Array) -> Array:
        """M(q), armature included.

        Args:
            q: (n,) rad.

        Returns:
            (n, n) kg m^2, symmetric.
        """
        M = pin.crba(self._model, self._data, q, self._convention)  # promises the upper triangle only
        return np.triu(M) + np.triu(M, 1).T

    def bias(self, q: Array, v: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, as MuJoCo's `qfrc_bias`.

        Args:
            q: (n,) rad.
            v: (n,) rad/s.

        Returns:
            (n,) N m.
        """
        return pin.nonLinearEffects(self._model, self._data, q, v).copy()

    def gravity(self, q: Array) -> Array:
        """The torque that holds the arm still at q: gravity less gravity compensation, and springs.

        Args:
            q: (n,) rad.

        Returns:
            (n,) N m.
        """
        tau = pin.computeGeneralizedGravity(self._model, self._data, q).copy()
        return self._with_static(tau, q)

    def inverse(self, q: Array, v: Array, a: Array, dt: float = 0.0) -> Array:
        """Inverse dynamics without dry friction: the torque that makes the arm accelerate.

        With a time step it is the inverse of MuJoCo's discrete step: the a that is asked for is then exactly (v_next - v) / dt.
        The integrators Euler and implicitfast take damping at the end of the step, implicit also Coriolis forces. This is what
        `mj_inverse` computes with `mjENBL_INVDISCRETE`.

        Args:
            q: (n,) rad.
            v: (n,) rad/s.
            a: (n,) rad/s^2.
            dt: The step, s; 0 for continuous time.

        Returns:
            (n,) N m.
        """
        if dt != self._dt:
            self._set_step(dt)
        tau = pin.rnea(self._stepping, self._data, q, v, a)
        if self._is_damped:
            tau = tau + (self._damping_force(v) if self._has_poly_damping else self.damping * v)
        if self._curves_late and dt:
            tau = tau + dt * self._curvature(q, v, a)
        return self._with_static(tau, q) if self._has_static else tau

    def held(self, q: Array, v: Array, a: Array, dt: float) -> Array:
        """The torque that, held for a while, makes an arm in continuous time accelerate: inverse dynamics half-way there.

        Args:
            q: (n,) rad, at the beginning.
            v: (n,) rad/s, at the beginning.
            a: (n,) rad/s^2, the change of v over the while by dt.
            dt: How long it is held, s.

        Returns:
            (n,) N m; off by terms of dt^2.
        """
        half = 0.5 * dt
        return self.inverse(q + half * v, v + half * a, a)

    def coriolis(self, q: Array, v: Array, w: Array) -> Array:
        """C(q, v) w with the C of Christoffel's symbols, for which M_dot - 2 C is skew-symmetric.

        C(q, v) w is symmetric in v and w, so it follows from C(q, v) v by polarisation.

        Args:
            q: (n,) rad.
            v: (n,) rad/s.
            w: (n,) rad/s.

        Returns:
            (n,) N m.
        """
        nle, model, data = pin.nonLinearEffects, self._model, self._data
        return 0.25 * (nle(model, data, q, v + w) - nle(model, data, q, v - w))

    def payload_regressor(self, q: Array, v: Array, a: Array) -> Array:
        """The torques that a point mass at the tip takes, by its mass m and first moment m c in the tip's frame.

        The inertia m c c^T about the tip, which is not linear in these four, is left out: it is small where c is.

        Args:
            q: (n,) rad.
            v: (n,) rad/s.
            a: (n,) rad/s^2.

        Returns:
            (n, 4), N m per kg and per kg m: `regressor @ [m, m cx, m cy, m cz]` is a torque.

        Raises:
            ModelError: A joint of the arm follows another: Pinocchio has no regressor for that.
        """
        if not self._joint_map.is_plain:
            raise ModelError(f"{self.arm.name}: no payload can be identified where one joint follows another")
        regressor = pin.computeJointTorqueRegressor(self._model, self._data, q, v, a)
        return regressor.reshape(len(q), -1)[:, -10:] @ self._payload_basis

    def friction(self, q: Array, v: Array, a: Array, dt: float = 0.0) -> Array:
        """The torque that overcomes dry friction, by MuJoCo's own law: a stiff damper that yields at the friction loss.

        From MuJoCo's documentation, Computation, "Constraint model": the friction force of a joint is
        -clip((a + b v) / R, +-friction_loss), where b and R come from the joint's `solreffriction` and `solimpfriction`, and a
        is the acceleration before damping is taken at the end of the step.

        Args:
            q: (n,) rad.
            v: (n,) rad/s.
            a: (n,) rad/s^2.
            dt: The step, s, as in `inverse`; 0 for continuous time.

        Returns:
            (n,) N m.
        """
        if not self.has_friction:
            return np.zeros_like(self.friction_loss)
        if dt and self._changes_late:
            if dt != self._dt:
                self._set_step(dt)
            late = self._late_damping * a
            if self._curves_late:
                late = late + dt * self._curvature(q, v, a)
            a = a + self._solve_mass(q, late)
        force = self._friction_gain * (a + self._friction_rate * v)
        return np.minimum(np.maximum(force, -self.friction_loss), self.friction_loss)  # faster than clip

    def _set_step(self, dt: float) -> None:
        """Damping that is taken at the end of a step acts like an armature of dt x damping besides."""
        self._dt, self._late_damping = dt, dt * self.damping * self._damps_at_end
        self._stepping.armature = self._model.armature + self._late_damping

    def _solve_mass(self, q: Array, tau: Array) -> Array:
        """M(q)^-1 tau."""
        if not self._joint_map.is_plain:  # Pinocchio does not factorise M with mimic joints
            return np.linalg.inv(self.mass_matrix(q)) @ tau
        pin.crba(self._model, self._data, q)
        pin.cholesky.decompose(self._model, self._data)
        return pin.cholesky.solve(self._model, self._data, tau)

    def _with_static(self, tau: Array, q: Array) -> Array:
        if self._has_springs:
            x = self._joint_map.positions(q) - self._rest
            k = self._stiffness
            force = x * (k[:, 0] + x * k[:, 1] + x * x * k[:, 2])
            tau = tau + (force if self._joint_map.is_plain else force @ self._joint_map.ratio)
        if self._support is not None:
            tau = tau - pin.computeGeneralizedGravity(self._support, self._support_data, q)
        return tau

    def _damping_force(self, v: Array) -> Array:
        quadratic, cubic = self._damping_poly.T
        return v * (self.damping + quadratic * np.abs(v) + cubic * v * v)

    def _curvature(self, q: Array, v: Array, a: Array) -> Array:
        """What changes over a step, by its length, in the forces that its integrator takes at its end: d(force)/dv a.

        Constant damping is not among it.
        """
        quadratic, cubic = self._damping_poly.T
        change = (2 * quadratic * np.abs(v) + 3 * cubic * v * v) * a
        if self._turns_at_end:
            change = change + pin.computeRNEADerivatives(self._model, self._data, q, v, np.zeros_like(a))[1] @ a
        return change


def _acts(model: mujoco.MjModel, bit: mujoco.mjtDisableBit) -> bool:
    """Whether a part of the physics is not switched off by the model's options."""
    return not model.opt.disableflags & int(bit)


def _friction_constants(model: mujoco.MjModel, dofs: IntArray) -> tuple[Array, Array]:
    """1/R and b of each joint's friction constraint, after MuJoCo's `solref` and `solimp` rules at zero violation."""
    solref, solimp = model.dof_solref[dofs], np.clip(model.dof_solimp[dofs], 1e-4, 0.9999)
    impedance, impedance_max = solimp[:, 0], solimp[:, 1]
    time_constant = np.maximum(solref[:, 0], 2 * model.opt.timestep)
    rate = np.where(solref[:, 0] > 0, 2 / (impedance_max * time_constant), -solref[:, 1] / impedance_max)
    regularisation = (1 - impedance) / impedance * np.maximum(model.dof_invweight0[dofs], 1e-15)
    return 1 / regularisation, rate


def _payload_basis(T_last_tip: Array) -> Array:
    """(10, 4): Pinocchio's ten inertial parameters in the last joint's frame from m and m c in the tip's.

    With p = r + R c, a point mass has first moment m p and second moment S = m p p^T, of which I = tr(S) 1 - S.
    """
    R, r = T_last_tip[:3, :3], T_last_tip[:3, 3]
    basis = np.zeros((10, 4))
    for k in range(4):
        m, h = (1.0, np.zeros(3)) if k == 0 else (0.0, R[:, k - 1])
        S = m * np.outer(r, r) + np.outer(r, h) + np.outer(h, r)
        inertia = np.trace(S) * np.eye(3) - S
        basis[:, k] = [m, *(m * r + h), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]
    return basis
