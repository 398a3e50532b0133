"""The torques that a motion takes: held against the motors' limits, and kept inside them by slowing down.

A torque is not a polynomial in time, so its extremes are looked for at samples, and a motion is held to a little less than the
limits (`_MARGIN`) to cover what is between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import Array
from armctl.motion.timing.path_timing import TorqueRows, slower
from armctl.motion.trajectory.joint_trajectory import JointTrajectory, Slowdown
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

_SAMPLE = 0.004  # s
_MARGIN = 1e-3  # of the limits
_STRETCHES, _STRETCH = 400, 1.01


@dataclass(frozen=True)
class TorqueCheck:
    """What a motion makes of the motors' limits.

    Attributes:
        ok: Whether no joint needs more than its motor gives.
        joint: The joint that uses most of its limit.
        time: s, when.
        torque: N m (N for a slide joint), how much it needs then.
        bound: N m, its limit.
        unit: "N m" or "N".
        ratio: How much of it that is.
        ratios: (n,) the most that each joint uses of its limit.
    """

    ok: bool
    joint: str
    time: float
    torque: float
    bound: float
    unit: str
    ratio: float
    ratios: tuple[float, ...]

    def __str__(self) -> str:
        verdict = "inside" if self.ok else "outside"
        return (
            f"{verdict} the torque limits: {self.joint} needs {self.torque:.4g} {self.unit} of {self.bound:.4g} {self.unit} "
            f"({100 * self.ratio:.1f} %) at {self.time:.3f} s"
        )


def check_torque(arm: Arm, trajectory: Trajectory) -> TorqueCheck:
    """The torques that a motion takes, by inverse dynamics with damping and dry friction, against the motors' limits.

    Args:
        arm: The arm, with what it carries.
        trajectory: Any motion of its joints.

    Returns:
        The check, from samples at most 4 ms apart.

    Raises:
        InputError: It is not an arm, not a motion, or a motion of other joints.
    """
    check_arm(arm)
    check_motion(trajectory, arm.joint_names)
    times = _times(trajectory)
    torques = _torques(Dynamics(arm), *trajectory.sample(times)[:3])
    shares = np.abs(torques) / arm.limits.tau_max
    k, i = np.unravel_index(int(shares.argmax()), shares.shape)
    ratios = tuple(shares.max(axis=0).tolist())
    at, share = (float(times[k]), float(torques[k, i]), float(arm.limits.tau_max[i])), float(shares[k, i])
    return TorqueCheck(share <= 1.0, arm.joint_names[i], *at, arm.torque_units[i], share, ratios)


def within_torque(arm: Arm, trajectory: JointTrajectory) -> JointTrajectory:
    """A motion that the motors can follow: the same path, slower where one of them would saturate.

    Args:
        arm: The arm, with what it carries.
        trajectory: The motion, at rest at its end.

    Returns:
        The motion itself if the motors can follow it; else a slower one, whose `slowed` says by how much and for which joint.

    Raises:
        PlanError: Holding still on the path already takes more torque than a motor gives.
    """
    asked = check_torque(arm, trajectory)
    if asked.ratio <= 1.0:
        return trajectory
    if trajectory(0.0).v.any() or trajectory(0.0).a.any():
        raise PlanError(f"{asked}, and a motion that starts moving cannot start slower; stop first, or go less far")
    pieces = slower(_AsPath(trajectory), trajectory.limits, trajectory.knots, _Torques(arm))
    feasible = replace(trajectory, knots=pieces.knots, coefficients=pieces.coefficients)
    for _ in range(_STRETCHES):
        if check_torque(arm, feasible).ratio <= 1.0:
            slowdown = Slowdown(feasible.duration / trajectory.duration, asked.joint, asked.ratio)
            return replace(feasible, slowed=slowdown)
        feasible = feasible.scaled(1 / _STRETCH)
    raise PlanError(f"{check_torque(arm, feasible)}, however slowly the arm moves; take a lighter payload or another path")


class _AsPath:
    """A motion seen as a path whose length is the time."""

    def __init__(self, trajectory: JointTrajectory):
        self._trajectory = trajectory
        self.length = trajectory.duration

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """Position, velocity, acceleration and jerk, each (T, n)."""
        q, v, a = self._trajectory.sample(s)[:3]
        return q, v, a, self._trajectory.jerk(s)


class _Torques:
    """What bounds the torques: linear in the squared pace, in its change and, with damping, in the pace."""

    def __init__(self, arm: Arm):
        self._arm, self._dynamics = arm, Dynamics(arm)
        self._most = (1 - _MARGIN) * arm.limits.tau_max

    def rows(self, q: Array, v: Array, a: Array) -> TorqueRows:
        dynamics, zero = self._dynamics, np.zeros(self._arm.n)
        still = np.array([dynamics.inverse(row, zero, zero) for row in q])
        turning = np.array([dynamics.bias(row, speed) - dynamics.bias(row, zero) for row, speed in zip(q, v, strict=True)])
        moving = np.array([dynamics.inverse(row, speed, zero) for row, speed in zip(q, v, strict=True)])
        alpha = np.array([dynamics.inverse(row, zero, speed) for row, speed in zip(q, v, strict=True)]) - still
        beta = np.array([dynamics.inverse(row, zero, rate) for row, rate in zip(q, a, strict=True)]) - still + turning
        friction = np.sign(v) * dynamics.friction_loss
        low, high = -self._most - still - friction, self._most - still - friction
        if (low >= 0).any() or (high <= 0).any():
            k, i = np.argwhere((low >= 0) | (high <= 0))[0]
            unit = self._arm.torque_units[i]
            raise PlanError(
                f"{self._arm.joint_names[i]}: holding still takes {still[k, i] + friction[k, i]:.4g} {unit} at "
                f"{100 * k / (len(q) - 1):.0f} % of the motion, and its motor gives {self._arm.limits.tau_max[i]:.4g} {unit}; "
                "take a lighter payload or another path"
            )
        return TorqueRows(alpha, beta, moving - still - turning, low, high)

    def overshoot(self, q: Array, v: Array, a: Array) -> Array:
        dynamics, zero = self._dynamics, np.zeros(self._arm.n)
        still = np.array([dynamics.inverse(row, zero, zero) for row in q]).reshape(q.shape)
        moving = np.array([dynamics.inverse(*row) for row in zip(q, v, a, strict=True)]).reshape(q.shape) - still
        held = still + np.sign(v) * dynamics.friction_loss
        up, down = (np.maximum(self._most - side * held, _MARGIN * self._most) for side in (1.0, -1.0))
        return np.maximum(moving / up, -moving / down).max(axis=1)


def _times(trajectory: Trajectory) -> Array:
    """Evenly spaced times, and the knots where there are some."""
    count = math.ceil(trajectory.duration / _SAMPLE) + 1
    even = np.linspace(0.0, trajectory.duration, count)
    return np.union1d(even, trajectory.knots) if isinstance(trajectory, JointTrajectory) else even


def _torques(dynamics: Dynamics, q: Array, v: Array, a: Array) -> Array:
    """(T, n) N m, dry friction included."""
    return np.array([dynamics.inverse(*row) for row in zip(q, v, a, strict=True)]) + dynamics.friction(q, v, a)
