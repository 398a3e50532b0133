"""Disturbance observer: the torque that, besides the commanded one, explains the motion of the last tick."""

from __future__ import annotations

import math

import numpy as np

from armctl.control import feedforward
from armctl.control.interface import Clock, State
from armctl.core.validation import Array
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

# rad. A faster low-pass diverges with a delay of two periods in addition to the observer's own delay of one. With light wrists
# two periods can be too much at this bound, too: `armctl.margins` measures it.
MAX_BANDWIDTH_TIMES_DT = 0.3


class DisturbanceObserver:
    """A one-step disturbance observer of first order, d = LP[ID(q, v, (v_next - v) / dt) - tau].

    After Ohnishi, Shibata, Murakami, "Motion control for advanced mechatronics" (1996), with the inverse dynamics of the whole
    arm instead of a nominal inertia of each joint. Without a low-pass it diverges with a delay of two control periods; the
    bandwidth of the low-pass is therefore at most 0.3 / dt.

    Attributes:
        bandwidth: rad/s of the low-pass, if the control period is short enough for it.
        estimate: (n,) N m, the estimated disturbance torque of each joint.
    """

    def __init__(self, arm: Arm, bandwidth: float):
        """An observer for an arm; the bandwidth of its low-pass is in rad/s."""
        self.bandwidth = bandwidth
        self.estimate = np.zeros(arm.n)
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._tau_max = arm.limits.tau_max
        self._clock = Clock()
        self._last_tau = np.zeros(arm.n)
        self._last_state = State(self._last_tau, self._last_tau)

    def corrected(self, tau: Array, state: State, friction: Array | None = None) -> Array:
        """Updates the estimate, and returns a torque minus the estimated disturbance.

        Args:
            tau: (n,) N m, the torque that the model needs.
            state: The measured state.
            friction: (n,) N m against dry friction, which the caller adds afterwards. The observer's model has no dry friction.

        Returns:
            (n,) N m.
        """
        if self._clock.follows(state):
            acceleration = (state.v - self._last_state.v) / state.dt
            disturbance = feedforward.inverse_dynamics(self._dynamics, self._last_state, acceleration) - self._last_tau
            weight = -math.expm1(-min(self.bandwidth * state.dt, MAX_BANDWIDTH_TIMES_DT))
            self.estimate = self.estimate + weight * (disturbance - self.estimate)
        else:
            self.estimate = np.zeros_like(self.estimate)
        tau = tau - self.estimate
        friction = np.zeros_like(tau) if friction is None else friction
        # The motors clip the sum of both; what they cut off is not a disturbance.
        self._last_tau = np.clip(tau + friction, -self._tau_max, self._tau_max) - friction
        self._last_state = state._replace(q=state.q.copy(), v=state.v.copy())
        return tau
