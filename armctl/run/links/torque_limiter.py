"""TorqueLimiter: keeps torques and their rate within the bounds of a maker, and tells where the arm leaves its range."""

from __future__ import annotations

import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.run.links.added_torque import AddedTorque
from armctl.run.links.envelope import Envelope
from armctl.run.links.link import Reading
from armctl.run.links.torque_interface import TorqueInterface

_KEPT_SHARE = 1.0 - 1e-3  # of a maker's bounds, so that rounding on the wire does not exceed them
_ENCODER_EXCESS = 1e-3  # rad: encoders may read a little more than the range


class TorqueLimiter:
    """The torques that are sent for torques of the motors, within the bounds of their maker."""

    def __init__(self, arm: Arm, interface: TorqueInterface, dt: float):
        """Bounds for an arm and a tick of dt s."""
        self.sent = np.zeros(arm.n)  # (n,) N m, the last torques that were sent
        self.total = np.zeros(arm.n)  # (n,) N m, the same with what the maker adds to them
        self._arm = arm
        self._maker = AddedTorque(arm, interface)
        self._tau_max = _KEPT_SHARE * np.minimum(interface.torque_limits, arm.limits.tau_max)
        self._step_max = _KEPT_SHARE * dt * interface.rate_limits

    def start(self, reading: Reading) -> None:
        """Begins at the torques that hold the arm: those that the robot measures, or else its weight."""
        total = reading.tau if np.isfinite(reading.tau).all() else self._arm.gravity(reading.q)
        added = self._maker.at(reading.q, reading.v)
        self.sent = _within(total - added, -self._tau_max, self._tau_max)
        self.total = self.sent + added

    def to_send(self, total: Array, reading: Reading) -> Array:
        """(n,) N m, what is sent so that the motors give a total torque, as far as the bounds allow."""
        added = self._maker.at(reading.q, reading.v)
        sent = _within(total, -self._tau_max, self._tau_max) - added
        sent = _within(sent, self.sent - self._step_max, self.sent + self._step_max)
        if reading.tau_ref is not None:
            # Where a torque is lost, the robot compares the next one with the one before it.
            sent = _within(sent, reading.tau_ref - self._step_max, reading.tau_ref + self._step_max)
        self.sent = _within(sent, -self._tau_max, self._tau_max)
        self.total = self.sent + added
        return self.sent

    def why_outside(self, q: Array, v: Array, envelope: Envelope) -> str:
        """Why the arm leaves what its maker allows: it would not come to rest within the range, or is too fast; else empty."""
        limits = envelope.limits
        way = v * np.abs(v) / (2.0 * limits.a_max)
        low, high = envelope.speed_limits(q)
        beyond = np.maximum(limits.q_min - (q + np.minimum(way, 0.0)), q + np.maximum(way, 0.0) - limits.q_max)
        # Where the maker allows no speed near an end of the range, the first bound is the narrower one.
        fastest = np.maximum(np.where(v > 0.0, high, -low), 0.0)
        excess = np.abs(v) - np.where(fastest > 0.0, fastest, limits.v_max)
        if beyond.max() > _ENCODER_EXCESS:
            joint = int(beyond.argmax())
            return (
                f"{self._arm.joint_names[joint]} at {q[joint]:.4g} rad with {v[joint]:.3g} rad/s would leave its range "
                f"[{limits.q_min[joint]:.4g}, {limits.q_max[joint]:.4g}] rad"
            )
        if excess.max() > 0.0:
            joint = int(excess.argmax())
            return (
                f"{self._arm.joint_names[joint]} moves at {v[joint]:.3g} rad/s at {q[joint]:.4g} rad, "
                f"at most {abs(v[joint]) - excess[joint]:.3g} rad/s"
            )
        return ""


def _within(values: Array, low: Array, high: Array) -> Array:
    """`numpy.clip`, without the checks that take most of its time for a few joints."""
    return np.minimum(np.maximum(values, low), high)
