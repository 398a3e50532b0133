"""Forces of the joints themselves: springs, damping and dry friction, as MuJoCo computes them.

All torques here are the torques that a motor needs to overcome the force, so their sign is opposite to MuJoCo's `qfrc_passive`.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.model.arm.joint_map import JointMap

MIN_INVERSE_INERTIA = 1e-15  # 1/(kg m^2), MuJoCo's mjMINVAL: the lower bound of dof_invweight0 in a constraint
MIN_IMPEDANCE = 1e-4  # MuJoCo's mjMINIMP and mjMAXIMP: bounds of the values in solimp
MAX_IMPEDANCE = 0.9999


def is_enabled(model: mujoco.MjModel, bit: mujoco.mjtDisableBit) -> bool:
    """Whether the model's options leave a part of the physics enabled."""
    return not model.opt.disableflags & int(bit)


def set_dry_friction(model: mujoco.MjModel, joint_map: JointMap, loss: Array, slope: Array) -> None:
    """Gives joints without followers a dry friction, and the damper below it a slope, N m s/rad, or 0 to keep it; in place.

    The impedance of the constraint follows from the slope: R = (1 - d) / d / M, see `DryFriction`.
    """
    dofs = joint_map.dof_adr[joint_map.leaders]
    model.dof_frictionloss[dofs] = loss
    law = DryFriction.from_model(model, joint_map)
    ratio = slope / law.rate * np.maximum(model.dof_invweight0[dofs], MIN_INVERSE_INERTIA)
    known = slope > 0
    model.dof_solimp[dofs[known], 0] = (ratio / (1 + ratio))[known]


class PassiveForces:
    """Joint springs and viscous damping, both with MuJoCo's higher-order terms."""

    def __init__(self, model: mujoco.MjModel, joint_map: JointMap):
        dofs = joint_map.dof_adr
        joints = model.dof_jntid[dofs]
        # With closed loops these are the forces of the driven joints; `PassiveJoints` has those of the others.
        ratio = np.abs(joint_map.fixed_ratio.T)
        damper = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_DAMPER)
        spring = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_SPRING)
        # A joint that follows with |dq_i/dq| = r contributes r^(k + 1) of its term in v^k, by virtual work.
        self.damping = ratio**2 @ model.dof_damping[dofs] * damper  # (n,) N m s/rad, the linear part of the damping
        self.quadratic_damping = ratio**3 @ (model.dof_dampingpoly[dofs, 0] * damper)  # (n,) N m s^2/rad^2
        self.cubic_damping = ratio**4 @ (model.dof_dampingpoly[dofs, 1] * damper)  # (n,) N m s^3/rad^3
        # (m, 3) linear, quadratic and cubic stiffness of the spring of every joint that the arm moves
        self.stiffness = np.column_stack([model.jnt_stiffness[joints], model.jnt_stiffnesspoly[joints]]) * spring
        self.rest = model.qpos_spring[joint_map.qpos_adr].copy()  # (m,) rad, where the springs are at rest
        self._joint_map = joint_map
        # Whether the damping of any joint is not linear
        self.has_nonlinear_damping = bool(self.quadratic_damping.any() or self.cubic_damping.any())
        self.is_damped = self.has_nonlinear_damping or bool(self.damping.any())  # whether any joint has damping
        self.has_springs = bool(self.stiffness.any())  # whether any joint has a spring

    def damping_torque(self, v: Array) -> Array:
        """v (d0 + d1 |v| + d2 v^2), (n,) N m."""
        if not self.has_nonlinear_damping:
            return self.damping * v
        return v * (self.damping + self.quadratic_damping * np.abs(v) + self.cubic_damping * v * v)

    def spring_torque(self, q: Array) -> Array:
        """x (k0 + k1 x + k2 x^2) with x the distance from the spring's rest position, (n,) N m."""
        x = self._joint_map.positions(q) - self.rest
        k = self.stiffness
        force = x * (k[:, 0] + x * k[:, 1] + x * x * k[:, 2])
        return force if self._joint_map.is_plain else force @ self._joint_map.ratio_at(q)

    def spring_energy(self, q: Array) -> float:
        """J in the springs: the integral of `spring_torque` from where they are at rest."""
        x = self._joint_map.positions(q) - self.rest
        k = self.stiffness
        return float((x * x * (k[:, 0] / 2 + x * (k[:, 1] / 3 + x * k[:, 2] / 4))).sum())


class PassiveJoints:
    """Damping, dry friction and armature of the passive joints of closed loops, zero for all others."""

    def __init__(self, model: mujoco.MjModel, joint_map: JointMap):
        dofs = joint_map.dof_adr
        is_passive = np.zeros(len(dofs))
        if joint_map.closure is not None:
            is_passive[joint_map.closure.passive] = 1.0
        damper = is_passive * is_enabled(model, mujoco.mjtDisableBit.mjDSBL_DAMPER)
        # (m, 3) linear, quadratic and cubic
        self.damping = np.column_stack([model.dof_damping[dofs], model.dof_dampingpoly[dofs]]) * damper[:, None]
        self.armature = model.dof_armature[dofs] * is_passive  # (m,) kg m^2
        self.friction = DryFriction.of_passive(model, joint_map, is_passive)  # (m,)

    def damping_torque(self, v: Array) -> Array:
        """v (d0 + d1 |v| + d2 v^2), (m,) N m, at the speeds v (m,) of all joints."""
        d = self.damping
        return v * (d[:, 0] + d[:, 1] * np.abs(v) + d[:, 2] * v * v)


@dataclass(frozen=True, slots=True, eq=False)
class DryFriction:
    """Dry friction by MuJoCo's law: a stiff damper whose force is bounded by the friction loss.

    Source: MuJoCo documentation, Computation, "Constraint model". The constraint force of a joint is
    -clip((a + rate v) gain, +-loss), where gain and rate follow from `solreffriction` and `solimpfriction`.
    """

    loss: Array  # (n,) N m, the friction at any but very small speeds
    gain: Array  # (n,) kg m^2, the inverse of the constraint's regularization R
    rate: Array  # (n,) 1/s, the damping b of the constraint

    @classmethod
    def from_model(cls, model: mujoco.MjModel, joint_map: JointMap) -> DryFriction:
        """The dry friction of the joints that an arm moves; gain and rate are those at zero constraint violation."""
        enabled = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        enabled &= is_enabled(model, mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
        loss = np.abs(joint_map.fixed_ratio.T) @ model.dof_frictionloss[joint_map.dof_adr] * enabled
        return cls(loss, *_friction_law(model, joint_map.dof_adr[joint_map.leaders]))

    @classmethod
    def of_passive(cls, model: mujoco.MjModel, joint_map: JointMap, is_passive: Array) -> DryFriction:
        """That of all m joints, without a loss where `is_passive` (m,) is 0."""
        enabled = is_enabled(model, mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        enabled &= is_enabled(model, mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
        loss = model.dof_frictionloss[joint_map.dof_adr] * is_passive * enabled
        return cls(loss, *_friction_law(model, joint_map.dof_adr))

    @property
    def slope(self) -> Array:
        """(n,) N m s/rad, of the damper."""
        return self.gain * self.rate

    def torque(self, v: Array, a: Array) -> Array:
        """(n,) N m; a is the acceleration before implicit damping acts."""
        force = self.gain * (a + self.rate * v)
        return np.minimum(np.maximum(force, -self.loss), self.loss)  # faster than clip


def _friction_law(model: mujoco.MjModel, dofs: IntArray) -> tuple[Array, Array]:
    """The gain and rate of dry friction for some degrees of freedom; see `DryFriction`."""
    solref = model.dof_solref[dofs]
    solimp = np.clip(model.dof_solimp[dofs], MIN_IMPEDANCE, MAX_IMPEDANCE)
    impedance = solimp[:, 0]
    impedance_max = solimp[:, 1]
    time_constant = np.maximum(solref[:, 0], 2 * model.opt.timestep)
    rate = np.where(solref[:, 0] > 0, 2 / (impedance_max * time_constant), -solref[:, 1] / impedance_max)
    regularization = (1 - impedance) / impedance * np.maximum(model.dof_invweight0[dofs], MIN_INVERSE_INERTIA)
    return 1 / regularization, rate
