"""Disturbance observer: what torque besides its own made the last tick what it was."""

from __future__ import annotations

import math

import numpy as np

from armctl.control import feedforward as model
from armctl.control.interface import Clock, State
from armctl.core.validation import Array
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

_PER_TICK = 0.3  # rad, the most that bandwidth x dt may be


class DisturbanceObserver:
    """A one-step disturbance observer of first order, d = LP[ID(q, v, (v_next - v) / dt) - tau].

    After Ohnishi, Shibata, Murakami, "Motion control for advanced mechatronics" (1996), with the whole arm's inverse dynamics
    in place of a joint's nominal inertia. Unfiltered, a delay of two ticks makes it diverge; the low-pass is therefore never
    faster than 0.3 / dt, which bears a delay of two ticks besides the observer's own.

    Attributes:
        bandwidth: rad/s, of the low-pass, where ticks are short enough for it.
        estimate: (n,) N m, the unknown torque on each joint.
    """

    def __init__(self, arm: Arm, bandwidth: float):
        """An observer of an arm.

        Args:
            arm: The arm whose model it uses; its torque limits tell what a motor cannot have done.
            bandwidth: rad/s, of the low-pass.
        """
        self.bandwidth = bandwidth
        self.estimate = np.zeros(arm.n)
        self._dynamics, self._tau_max, self._clock = Dynamics(arm), arm.limits.tau_max, Clock()
        self._tau = np.zeros(arm.n)
        self._before = State(self._tau, self._tau)

    def corrected(self, tau: Array, state: State, friction: Array | None = None) -> Array:
        """A torque less the estimated disturbance, which is brought up to date first.

        Args:
            tau: (n,) N m that the model would take.
            state: The measured state.
            friction: (n,) N m that will be added to overcome dry friction, of which the model here knows nothing.

        Returns:
            (n,) N m.
        """
        if self._clock.follows(state):
            unknown = model.inverse(self._dynamics, self._before, (state.v - self._before.v) / state.dt) - self._tau
            share = -math.expm1(-min(self.bandwidth * state.dt, _PER_TICK))
            self.estimate = self.estimate + share * (unknown - self.estimate)
        else:
            self.estimate = np.zeros_like(self.estimate)
        tau = tau - self.estimate
        own = np.zeros_like(tau) if friction is None else friction
        self._tau = np.clip(tau + own, -self._tau_max, self._tau_max) - own
        self._before = state._replace(q=state.q.copy(), v=state.v.copy())
        return tau
