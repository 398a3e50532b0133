"""Adaptive control: learns the mass and centre of an unknown payload while it moves."""

from __future__ import annotations

import numpy as np

from armctl.control import feedforward as model
from armctl.control.gains import DEFAULT_BANDWIDTH, poses
from armctl.control.interface import Clock, State
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics

_LITTLE = 0.1  # of what a mass shows: what shows less is learnt more slowly
_ARM = 0.1  # m, of a payload's centre
_UNSEEN = 1e-12  # m^2/s^4, of what gravity shows of a payload: round-off
_PER_TICK = 0.25  # of what a tick bears: leaves room for a delay of two ticks


class Adaptive:
    """Passivity-based adaptive control of an arm with an unknown point mass at its tip.

    With e = q_ref - q and s = e_dot + bandwidth e,

        tau = M (a_ref + bandwidth e_dot + bandwidth s) + C (v + s) + g + Y theta,    theta_dot = gain Y^T s,

    after Slotine and Li, "On the adaptive control of robot manipulators" (1987). Why this one: what an arm does not know is
    mostly what it holds, which is four numbers in which the torque is linear. Once learnt they are right at any speed and pose,
    where an observer or an integral must learn a torque anew all the time; it takes no measured acceleration, so it bears noise
    and delay; and it is proven stable. It does not learn friction: that is a disturbance observer's task.

    Attributes:
        bandwidth: rad/s, of the error.
        adaptation_rate: 1/s, how fast the payload is learnt.
        payload: (4,) the estimate: mass, kg, and first moment m c in the tip's frame, kg m.
    """

    name = "adaptive"

    def __init__(self, arm: Arm, *, bandwidth: float = DEFAULT_BANDWIDTH, adaptation_rate: float = 10.0):
        """An adaptive controller for an arm.

        Args:
            arm: The arm whose model it uses.
            bandwidth: rad/s, the natural frequency of the error.
            adaptation_rate: 1/s, about how fast the payload is learnt; 0 learns nothing.

        Raises:
            InputError: A gain is negative or not finite.
        """
        self.bandwidth = number("bandwidth", bandwidth, 0.0)
        self.adaptation_rate = number("adaptation_rate", adaptation_rate, 0.0)
        self.payload = np.zeros(4)
        self._dynamics, self._clock = Dynamics(arm), Clock()
        self._still, self._tau_max = np.zeros(arm.n), arm.limits.tau_max
        self._gain = self._adaptation_gain(arm)

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.
        """
        q, v = state.q, state.v
        v_ref, a_ref = model.sampled(setpoint)
        rate = v_ref - v
        s = rate + self.bandwidth * (setpoint.q - q)
        a = a_ref + self.bandwidth * (rate + s)
        Y = self._regressor(q, v, v + s, a)
        if not self._clock.follows(state):
            self.payload = np.zeros(4)
        tau = model.torque(self._dynamics, state, a, v_ref, a_ref) + self._dynamics.coriolis(q, v, s) + Y @ self.payload
        if (np.abs(tau) < self._tau_max).all():  # a motor at its limit hides what is being learnt
            self.payload = self.payload + state.dt * self._slowdown(q, Y, state.dt) * (self._gain @ (Y.T @ s))
        return tau

    def _slowdown(self, q: Array, Y: Array, dt: float) -> float:
        """At most 1: less where a fast motion shows so much of a payload that it would be learnt faster than ticks bear.

        Estimate and s are a mass on a spring Y gain Y^T with a damper of the bandwidth; a tick bears spring x dt < bandwidth.
        """
        spring = np.trace(self._gain @ Y.T @ np.linalg.solve(self._dynamics.mass_matrix(q), Y))
        most = _PER_TICK * self.bandwidth
        return most / max(most, float(spring) * dt, np.finfo(float).tiny)

    def _regressor(self, q: Array, v: Array, v_r: Array, a_r: Array) -> Array:
        """(n, 4) Y of M a_r + C(q, v) v_r + g of the payload, C by Christoffel's symbols (polarisation, as in `Dynamics`)."""
        regressor, still = self._dynamics.payload_regressor, self._still
        return regressor(q, still, a_r) + 0.25 * (regressor(q, v + v_r, still) - regressor(q, v - v_r, still))

    def _adaptation_gain(self, arm: Arm) -> Array:
        """(4, 4), rate k (Y^T M^-1 Y)^-1 at rest: a wrong payload is forgotten at about the adaptation rate.

        Where gravity does not show a payload, as without gravity or under a vertical axis, nothing is learnt.
        """
        still, seen = self._still, np.zeros((4, 4))
        for q in poses(arm):
            Y = self._dynamics.payload_regressor(q, still, still)
            seen += Y.T @ np.linalg.solve(self._dynamics.mass_matrix(q), Y)
        seen /= len(poses(arm))
        shown = np.diag(seen)
        moment = max(shown[1:].max(), _ARM**2 * shown[0])
        if moment < _UNSEEN:
            return np.zeros((4, 4))
        little = _LITTLE * np.array([max(shown[0], moment), moment, moment, moment])
        gain = self.adaptation_rate * self.bandwidth * np.linalg.inv(seen + np.diag(little))
        return np.asarray(gain, dtype=np.float64)
