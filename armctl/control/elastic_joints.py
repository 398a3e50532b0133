"""ElasticFeedforward and ElasticFeedback: controllers of arms with elastic joints.

Model: M. W. Spong, "Modeling and control of elastic joint robots" (1987). A motion of the links determines the torques of the
springs, these the motion of the motors, and that their torques: A. De Luca, "Feedforward/feedback laws for the control of
flexible robots" (2000). PD of the motors of an elastic arm is stable: P. Tomei, "A simple PD controller for robots with elastic
joints" (1991).

With feedback, the motors yield to the torques of the springs that the motion does not need, which takes energy from vibrations
of the links in any configuration: A. Albu-Schaeffer, C. Ott, G. Hirzinger, "A unified passivity-based control framework for
position, torque and impedance control of flexible joint robots" (2007). The error of the links, motor minus deflection, is
integrated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.gain_attribute import Gain, joint_gain, scalar_gain
from armctl.control.interface import Clock, State, explains_wrong_arguments
from armctl.control.pd import PD
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, flag, instance, vector
from armctl.model.arm.arm import Arm
from armctl.model.arm.passive_forces import DryFriction, PassiveForces

_REVERSAL_SPEED = 0.01  # rad/s, of the reference, over which compensated friction changes its sign
_RETURN_SHARE = 0.5  # of a resonance: the rate at which motors return from where they have yielded to, below that of vibrations
# Of damping / rotor inertia, about the crossover of the motors' loop, where yielding at this rate costs a phase of as many rad.
_CROSSOVER_SHARE = 0.15
_MAX_SHIFT = 2.0  # of the deflection by the torque limits: the integral need not move the motors further
_MAX_RATIO = 1.0
_MAX_BANDWIDTH = 100.0  # rad/s


class ElasticFeedforward(PD):
    """PD of the motors of elastic joints, with the torques of motors and springs along the motion of the links.

    Margins are those of `PD` with the same gains: what is added depends on the reference only. The encoders are those of the
    motors. It runs in Python.
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
            stiffness: N m/rad (N/m for a slide joint), for all joints or (n,); by default from the arm's margins.
            damping: N m s/rad (N s/m), for all joints or (n,); by default from the arm's margins.
            friction: Whether the model's dry friction is compensated: it turns with the sign of the motors' reference speed.

        Raises:
            InputError: A value is negative, not finite or of a wrong length, or a stiffness is 0.
            ModelError: The arm has closed loops.
        """
        super().__init__(arm, stiffness=stiffness, damping=damping)
        self.elasticity = elasticity
        if not (self.elasticity > 0.0).all():
            raise InputError("elasticity: every spring needs a stiffness above 0")
        arm.joint_map.require_no_loops()
        armature = arm.pinocchio_model.pin_model.armature
        self._model_inertia = np.array(armature)
        self.rotor_inertia = armature if rotor_inertia is None else rotor_inertia
        self.friction = flag("friction", friction)
        self._passive = PassiveForces(arm.model, arm.joint_map)
        self._loss = DryFriction.from_model(arm.model, arm.joint_map).loss
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


class ElasticFeedback(ElasticFeedforward):
    """Feedforward of elastic joints, damping of the links by the springs' deflection, and an integral of the links' error.

    It needs `State.deflection`, as joint torque sensors give it, and encoders at the motors. With the same gains of the motors
    its delay margin is below that of `ElasticFeedforward`, by up to a third. It runs in Python.
    """

    name = "elastic-feedback"
    needs_deflection = True
    damping_ratio: Gain[float] = scalar_gain(0.0, _MAX_RATIO)
    link_bandwidth: Gain[float] = scalar_gain(0.0, _MAX_BANDWIDTH)

    def __init__(
        self,
        arm: Arm,
        elasticity: ArrayLike,
        rotor_inertia: ArrayLike | None = None,
        *,
        damping_ratio: float = 0.3,
        link_bandwidth: float = 2.0,
        stiffness: ArrayLike | None = None,
        damping: ArrayLike | None = None,
        friction: bool = True,
    ):
        """A controller at the start of a run.

        Args:
            elasticity: N m/rad, stiffness of the springs between motors and links; a number for all joints or (n,).
            rotor_inertia: kg m^2 of the motors, at the joints; the model's armature if left out.
            damping_ratio: In [0, 1], added to vibrations of the links; reached where the motors are much faster than these.
            link_bandwidth: rad/s, in [0, 100], of the integral of the links' error, which removes what payloads, friction and
                wrong springs leave; well below the resonances.
            stiffness: N m/rad (N/m for a slide joint) of the motors, for all joints or (n,); by default from the margins.
            damping: N m s/rad (N s/m) of the motors, for all joints or (n,); by default from the margins.
            friction: Whether the model's dry friction is compensated.

        Raises:
            InputError: A value is outside its bounds, not finite or of a wrong length.
            ModelError: The arm has closed loops.
        """
        super().__init__(arm, elasticity, rotor_inertia, stiffness=stiffness, damping=damping, friction=friction)
        self.damping_ratio = damping_ratio
        self.link_bandwidth = link_bandwidth
        if not (self.rotor_inertia > 0.0).all():
            raise InputError("rotor_inertia: every motor needs an inertia above 0")
        self._link_inertia = arm.mass_matrix(arm.limits.clamp(arm.home)).diagonal()
        self._feedback_clock = Clock()
        self._yielded = np.zeros(self.n)
        self._integral = np.zeros(self.n)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Returns:
            (n,) N m.

        Raises:
            InputError: An argument is no `State` or no `Setpoint`, has a wrong length, or the state has no deflection.
        """
        instance("state", state, State, "armctl.State(q, v) is one")
        if state.deflection is None or np.shape(state.deflection) != (2, self.n):
            raise InputError(f"state.deflection: {self.name} needs (2, {self.n}) numbers; a Simulation measures them")
        if not self._feedback_clock.follows(state):
            self._yielded = np.zeros(self.n)
            self._integral = np.zeros(self.n)
        deflection = state.deflection[0]
        spring = self._spring_torque(setpoint)
        resonance = np.sqrt(self.elasticity / self._link_inertia)
        excess = deflection - spring / self.elasticity
        rate = np.minimum(2 * self.damping_ratio * resonance, _CROSSOVER_SHARE * self.damping / self.rotor_inertia)
        yielding = -_RETURN_SHARE * resonance * self._yielded - rate * excess
        correcting = self.link_bandwidth * (setpoint.q - (state.q - deflection))
        bound = _MAX_SHIFT * self._arm.limits.tau_max / self.elasticity
        self._yielded = self._yielded + state.dt * yielding
        self._integral = np.clip(self._integral + state.dt * correcting, -bound, bound)
        return self._motor_torque(state, setpoint, spring, self._yielded + self._integral, yielding + correcting)
