"""Computed torque within the limits of torque, velocity and position, by a quadratic program."""

from __future__ import annotations

from typing import Any, TypedDict

from armctl import _core
from armctl.control.computed_torque import ComputedTorque
from armctl.control.gain_attribute import Gain
from armctl.control.task_space import arm_length
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.core.errors import InputError
from armctl.core.validation import Array, shown
from armctl.model.arm.arm import Arm


def _no_estimate(name: str, value: Any, _n: int) -> float | None:
    if value is not None:
        raise InputError(f"{name}: got {shown(value)}, but this law uses measured positions and velocities; leave it None")
    return None


class _LimitedLawGains(TypedDict):
    """The gains of a compiled law within limits."""

    stiffness: float
    damping: float
    added_damping: Array
    decay_rate: float
    torque_limit: Array
    q_min: Array
    q_max: Array
    v_max: Array
    a_max: Array
    length: float
    dt: float
    continuous: bool


class ComputedTorqueQP(ComputedTorque):
    """Computed torque that respects the limits of torque, velocity and position with the least error of the tip.

    While the desired acceleration respects all limits, it is applied unchanged. Otherwise a minimizes the square of
    J (a - a_desired), subject to

        -tau_max <= M a + h <= tau_max,    -v_max <= v + dt a <= v_max,    and the viability of q,

    in which rotations weigh less than translations, and the joints decide what the tip leaves open. Speeds are viable if the
    joint stops before the end of its range with its greatest acceleration, or with the torque that is left (Del Prete, "Joint
    position and velocity bounds in discrete-time acceleration/torque control of robot manipulators", 2018). If the limits
    contradict each other, the torque limits hold and the violation of the others is minimal. If that is impossible too, because
    other limits, which a_desired respects, contradict the torque limits, the torque of a_desired is clipped.

    The joints then recover on a curve of the tip. The missing acceleration for a straight return is therefore added to
    a_desired; it is of second order in the errors.

    Clipping each torque, in contrast, moves the arm off its path in all directions. The limits hold for an arm like the model;
    add a known payload to it (`Arm.with_payload`).
    """

    estimate_bandwidth: Gain[float | None] = Gain(_no_estimate)

    def __init__(self, arm: Arm, *, bandwidth: float = DEFAULT_BANDWIDTH, damping_ratio: float = 1.0):
        """A computed torque controller with limits for an arm.

        Args:
            arm: The arm whose model and limits it uses.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio)
        self.name = "qp"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        return _core.ComputedTorqueQP(self._model(dt, continuous), **self._law_gains(dt, continuous))

    def _law_gains(self, dt: float, continuous: bool) -> _LimitedLawGains:
        limits = self._arm.limits
        return {
            "stiffness": self.bandwidth**2,
            "damping": 2 * self.damping_ratio * self.bandwidth,
            "added_damping": self._added_damping(dt),
            "decay_rate": self.bandwidth,
            "q_min": limits.q_min,
            "q_max": limits.q_max,
            "v_max": limits.v_max,
            "a_max": limits.a_max,
            "torque_limit": limits.tau_max,
            "length": arm_length(self._arm),
            "dt": dt,
            "continuous": continuous,
        }
