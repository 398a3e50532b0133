"""ElasticFeedback: feedforward of elastic joints, with feedback of the springs' deflection.

The motors yield to the torques of the springs that the motion does not need, which takes energy from vibrations of the links in
any configuration: A. Albu-Schaeffer, C. Ott, G. Hirzinger, "A unified passivity-based control framework for position, torque
and impedance control of flexible joint robots" (2007). The error of the links, motor minus deflection, is integrated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.elastic_feedforward import ElasticFeedforward
from armctl.control.gain_attribute import Gain, scalar_gain
from armctl.control.interface import Clock, State, explains_wrong_arguments
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, instance
from armctl.robot.arm import Arm

_RETURN_SHARE = 0.5  # of a resonance: the rate at which motors return from where they have yielded to, below that of vibrations
# Of damping / rotor inertia, about the crossover of the motors' loop, where yielding at this rate costs a phase of as many rad.
_CROSSOVER_SHARE = 0.15
_MAX_SHIFT = 2.0  # of the deflection by the torque limits: the integral need not move the motors further
_MAX_RATIO = 1.0
_MAX_BANDWIDTH = 100.0  # rad/s


class ElasticFeedback(ElasticFeedforward):
    """Feedforward of elastic joints, damping of the links by the springs' deflection, and an integral of the links' error.

    It needs `State.deflection`, as joint torque sensors give it, and encoders at the motors. With the same gains of the motors
    its delay margin is below that of `ElasticFeedforward`, by up to a third. It runs in the Python loop.
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
            elasticity: As for `ElasticFeedforward`.
            rotor_inertia: As for `ElasticFeedforward`.
            damping_ratio: In [0, 1], added to vibrations of the links; reached where the motors are much faster than these.
            link_bandwidth: rad/s, in [0, 100], of the integral of the links' error, which removes what payloads, friction and
                wrong springs leave; well below the resonances.
            stiffness: As for `PD`, of the motors.
            damping: As for `PD`, of the motors.
            friction: Whether the model's dry friction is compensated.

        Raises:
            InputError: A value is outside its bounds, not finite or of a wrong length.
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
