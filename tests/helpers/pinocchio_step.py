"""The torques of one of MuJoCo's discrete steps by Pinocchio, which judges those of the compiled core."""

import numpy as np
import pinocchio as pin

from armctl import Arm
from armctl.model.arm.core_model import Integrator
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.passive_forces import PassiveForces


class PinocchioStep:
    """A step of dt s: linear damping D that is implicit in velocity acts like an additional armature dt D."""

    def __init__(self, arm: Arm, dt: float):
        integrator = Integrator.from_model(arm.model)
        is_plain = arm.joint_map.is_plain
        self.dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self.passive = PassiveForces(arm.model, arm.joint_map)
        self.dt = dt
        self.model = arm.pinocchio_model.pin_model
        self.data = self.model.createData()
        self.damping_armature = dt * integrator.implicit_damping * self.passive.damping
        self.with_damping = self.model.copy()
        self.with_damping.armature = self.model.armature + self.damping_armature
        self.is_nonlinear_damping_implicit = integrator.implicit_damping
        # Pinocchio has no derivatives of the inverse dynamics of mimic joints.
        self.is_coriolis_implicit = integrator.implicit_coriolis and is_plain

    def inverse_dynamics(self, q, v, a):
        continuous = self.dynamics.inverse_dynamics(q, v, a) - pin.rnea(self.model, self.data, q, v, a)
        return continuous + pin.rnea(self.with_damping, self.data, q, v, a) + self.dt * self.nonlinear_change(q, v, a)

    def friction(self, q, v, a):
        """The torque against dry friction, which acts on the acceleration before the implicit forces."""
        implicit = self.damping_armature * a + self.dt * self.nonlinear_change(q, v, a)
        explicit = a + np.linalg.solve(self.dynamics.mass_matrix(q), implicit)
        return self.dynamics.friction(v, explicit)

    def nonlinear_change(self, q, v, a):
        """Rate at which the implicit forces besides linear damping change during the step, d(force)/dv a."""
        change = np.zeros_like(a)
        if self.is_nonlinear_damping_implicit:
            slope = 2 * self.passive.quadratic_damping * np.abs(v) + 3 * self.passive.cubic_damping * v * v
            change = change + slope * a
        if self.is_coriolis_implicit:
            change = change + pin.computeRNEADerivatives(self.model, self.data, q, v, np.zeros_like(a))[1] @ a
        return change
