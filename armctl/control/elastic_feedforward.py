"""ElasticFeedforward: PD of the motors with the torques that move elastic joints along a motion.

Model: M. W. Spong, "Modeling and control of elastic joint robots" (1987). A motion of the links determines the torques of the
springs, these the motion of the motors, and that their torques: A. De Luca, "Feedforward/feedback laws for the control of
flexible robots" (2000). PD of the motors of an elastic arm is stable: P. Tomei, "A simple PD controller for robots with elastic
joints" (1991).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.gain_attribute import Gain, joint_gain
from armctl.control.interface import Clock, State, explains_wrong_arguments
from armctl.control.pd import PD
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, flag, instance, vector
from armctl.robot.arm import Arm
from armctl.robot.passive_forces import DryFriction, PassiveForces

_REVERSAL_SPEED = 0.01  # rad/s, of the reference, over which compensated friction changes its sign


class ElasticFeedforward(PD):
    """PD of the motors of elastic joints, with the torques of motors and springs along the motion of the links.

    Margins are those of `PD` with the same gains: what is added depends on the reference only. The encoders are those of the
    motors. It runs in the Python loop.
    """

    name = "elastic-feedforward"
    elasticity: Gain[Array] = joint_gain()
    rotor_inertia: Gain[Array] = joint_gain()

    def __init__(
        self,
        arm: Arm,
        elasticity: ArrayLike,
        rotor_inertia: ArrayLike | None = None,
        *,
        stiffness: ArrayLike | None = None,
        damping: ArrayLike | None = None,
        friction: bool = True,
    ):
        """A controller at the start of a run.

        Args:
            elasticity: N m/rad, stiffness of the springs between motors and links; a number for all joints or (n,).
            rotor_inertia: kg m^2 of the motors, at the joints; the model's armature if left out.
            stiffness: As for `PD`.
            damping: As for `PD`.
            friction: Whether the model's dry friction is compensated: it turns with the sign of the motors' reference speed.

        Raises:
            InputError: A value is negative, not finite or of a wrong length, or a stiffness is 0.
        """
        super().__init__(arm, stiffness=stiffness, damping=damping)
        self.elasticity = elasticity
        if not (self.elasticity > 0.0).all():
            raise InputError("elasticity: every spring needs a stiffness above 0")
        armature = arm.pinocchio_model.pin_model.armature
        self._model_inertia = np.array(armature)
        self.rotor_inertia = armature if rotor_inertia is None else rotor_inertia
        self.friction = flag("friction", friction)
        self._passive = PassiveForces(arm.model, arm.joint_map)
        self._loss = DryFriction.of(arm.model, arm.joint_map).loss
        self._reference_clock = Clock()
        self._past: tuple[Array, Array] | None = None

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Returns:
            (n,) N m.
        """
        instance("state", state, State, "armctl.State(q, v) is one")
        zero = np.zeros(self.n)
        return self._motor_torque(state, setpoint, self._spring_torque(setpoint), zero, zero)

    def _spring_torque(self, setpoint: Setpoint) -> Array:
        """(n,) N m, by which the springs move the links along their reference."""
        # The model of a rigid arm has the motors' inertia as armature, and their damping, which move with the motors here.
        rigid = self._arm.inverse_dynamics(setpoint.q, setpoint.v, setpoint.a)
        return rigid - self._model_inertia * setpoint.a - self._passive.damping_torque(np.asarray(setpoint.v))

    def _motor_torque(self, state: State, setpoint: Setpoint, spring: Array, shift: Array, shift_rate: Array) -> Array:
        """(n,) N m, so that the motors follow where the springs have these torques, besides a shift, rad, and its rate."""
        a = np.asarray(setpoint.a)
        if not self._reference_clock.follows(state) or self._past is None:
            self._past = (spring, spring)
        last, before = self._past
        self._past = (spring, last)
        dt = state.dt
        q = setpoint.q + spring / self.elasticity
        v = setpoint.v + (spring - last) / dt / self.elasticity
        acceleration = a + (spring - 2 * last + before) / dt**2 / self.elasticity
        tau = spring + self.rotor_inertia * acceleration + self._passive.damping_torque(v)
        tau += self.stiffness * (q + shift - state.q) + self.damping * (v + shift_rate - state.v)
        if self.friction:
            tau += self._loss * np.clip(v / _REVERSAL_SPEED, -1.0, 1.0)
        return vector("torque", tau, self.n, finite=False)
