"""The torques of a motion: compared with the motors' limits, and kept inside them by slowing the motion down.

A torque is not a polynomial in time, so its extremes are searched at samples. A motion is kept a little below the limits, by
`TORQUE_MARGIN`, to cover what happens between samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from armctl import _core
from armctl.core.errors import PlanError
from armctl.core.limits import torque_shares
from armctl.core.result import Verdict
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.core_model import inverse_dynamics
from armctl.model.arm.passive_forces import DryFriction, PassiveForces, PassiveJoints
from armctl.plan.motion.loop_check import check_loops
from armctl.plan.motion.timing.path_timing import slowed_down
from armctl.plan.motion.timing.speed_bounds import TorqueRows
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory, Slowdown
from armctl.plan.motion.trajectory.limit_check import REST_SPEED
from armctl.plan.motion.trajectory.piecewise import Pieces, joints_of

_SAMPLE_INTERVAL_S = 0.004
_MAX_EVEN_SAMPLES = 20_000  # a longer motion is sampled piece by piece, or in chunks of so many samples
_MIN_SAMPLES_PER_PIECE = 64  # of a motion with very many pieces
TORQUE_MARGIN = 1e-3  # of the limits
MAX_STRETCHES = 100
_MIN_STRETCH = 1.0005  # factors by which one stretch lengthens a motion
_MAX_STRETCH = 1.5


@dataclass(frozen=True)
class TorqueCheck(Verdict):
    """Whether the motors can follow a motion. True if they can.

    Attributes:
        ok: Whether no joint needs more torque than its motor gives.
        joint: The joint that uses the largest share of its limit.
        time: s, when it does.
        torque: N m (N for a slide joint), the torque that it needs then.
        bound: N m, its limit, at its speed.
        unit: "N m" or "N".
        ratio: The share of the limit.
        ratios: (n,) the largest share of its limit that each joint uses.
    """

    ok: bool
    joint: str
    time: float
    torque: float
    bound: float
    unit: str
    ratio: float
    ratios: tuple[float, ...]

    @property
    def reason(self) -> str:
        """The joint that needs too much torque; empty if none does."""
        return "" if self.ok else str(self)

    def __str__(self) -> str:
        verdict = "inside" if self.ok else "outside"
        return (
            f"{verdict} the torque limits: {self.joint} needs {self.torque:.4g} {self.unit} of {self.bound:.4g} {self.unit} "
            f"({100 * self.ratio:.1f} %) at {self.time:.3f} s"
        )


def check_torque(arm: Arm, trajectory: Trajectory) -> TorqueCheck:
    """The torques of a motion, by inverse dynamics with damping and dry friction, compared with what the motors give.

    The torque of a DC motor falls with its speed.

    Args:
        arm: The arm, with its payload.
        trajectory: Any motion of its joints.

    Returns:
        The check, from samples at most 4 ms apart. A `JointTrajectory` of more than 80 s is sampled at least 64 times in each
        of its pieces instead, so that time and memory grow with the pieces and not with the seconds.

    Raises:
        InputError: It is not an arm, not a motion, or a motion of other joints.
        PlanError: Closed loops of the arm cannot be closed in it, or a passive joint would leave its limits.
    """
    check_arm(arm)
    check_motion(trajectory, arm.joint_names)
    if arm.joint_map.closure is not None:
        check_loops(arm, trajectory)
    inverse_dynamics = InverseDynamics(arm)
    ratios = np.zeros(arm.n)
    worst: tuple[float, float, float, int] = (-1.0, 0.0, 0.0, 0)  # share, time, torque, joint
    for times in sample_times(trajectory):
        q, v, a = trajectory.sample(times)[:3]
        torques = inverse_dynamics.total(q, v, a)
        shares = torque_shares(arm.limits, torques, v)
        ratios = np.maximum(ratios, shares.max(axis=0))
        k, i = np.unravel_index(int(shares.argmax()), shares.shape)
        if not shares[k, i] <= worst[0]:
            worst = (float(shares[k, i]), float(times[k]), float(torques[k, i]), int(i))
    share, time, torque, i = worst
    return TorqueCheck(
        ok=share <= 1.0,
        joint=arm.joint_names[i],
        time=time,
        torque=torque,
        bound=min(abs(torque) / share if share else math.inf, float(arm.limits.tau_max[i])),
        unit=arm.torque_units[i],
        ratio=share,
        ratios=tuple(ratios.tolist()),
    )


def within_torque(arm: Arm, trajectory: JointTrajectory) -> JointTrajectory:
    """The motion itself if the motors can follow it; else the same path, slower, with a `slowed` that says why.

    The motion must end at rest. Raises PlanError if holding still on the path already takes more torque than a motor gives.
    """
    if np.isinf(arm.limits.tau_max).all():
        if arm.joint_map.closure is not None:
            check_loops(arm, trajectory)
        return trajectory
    needed = check_torque(arm, trajectory)
    if needed.ok:
        return trajectory
    if trajectory(0.0).v.any() or trajectory(0.0).a.any():
        raise PlanError(
            f"{needed}, and a motion that starts moving cannot be slowed down at its start; stop first, or choose a nearer goal"
        )
    if np.abs(trajectory(trajectory.duration).v).max() > REST_SPEED:
        raise PlanError(f"{needed}, and a motion that ends moving cannot be slowed down at its end; end slower")
    torques = TorqueBounds(arm)
    pieces = slowed_down(MotionPath(trajectory), trajectory.limits, trajectory.knots, torques)
    feasible = JointTrajectory(*joints_of(pieces), trajectory.joint_names, trajectory.limits, units=trajectory.units)
    for _ in range(MAX_STRETCHES):
        check = check_torque(arm, feasible)
        if check.ok:
            slowdown = Slowdown(feasible.duration / trajectory.duration, needed.joint, needed.ratio)
            return replace(feasible, slowed=slowdown)
        overshoot = max(float(torques.overshoot(times, *feasible.sample(times)[:3]).max()) for times in sample_times(feasible))
        feasible = feasible.scaled(1 / stretch_for(overshoot))
    raise PlanError(f"{check_torque(arm, feasible)}, however slowly the arm moves; take a lighter payload or another path")


def stretch_for(overshoot: float) -> float:
    """The factor by which a motion is lengthened next, if bounds on torques are exceeded by a factor."""
    return min(max(math.sqrt(overshoot), _MIN_STRETCH), _MAX_STRETCH)


def slowed_relative_to(arm: Arm, motion: JointTrajectory, free: JointTrajectory) -> JointTrajectory:
    """A motion whose `slowed` compares it with one that is planned without torque limits; none if those do not matter."""
    needed = check_torque(arm, free)
    if needed.ok:
        return replace(motion, slowed=None)
    return replace(motion, slowed=Slowdown(motion.duration / free.duration, needed.joint, needed.ratio))


class MotionPath:
    """A motion as a path whose length is the time."""

    def __init__(self, trajectory: JointTrajectory):
        self._trajectory = trajectory
        self.length = trajectory.duration

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """Position, velocity, acceleration and jerk, each (T, n)."""
        q, v, a = self._trajectory.sample(s)[:3]
        return q, v, a, self._trajectory.jerk(s)


class InverseDynamics:
    """The torques of an arm at many states, each (T, n)."""

    def __init__(self, arm: Arm):
        self._model = arm.core_model
        self._friction = DryFriction.from_model(arm.model, arm.joint_map)
        self.damping = PassiveForces(arm.model, arm.joint_map).damping_torque
        self.friction_loss = self._friction.loss
        self._closure = arm.joint_map.closure
        self._passive_loss = PassiveJoints(arm.model, arm.joint_map).friction.loss

    def smooth(self, q: Array, v: Array, a: Array) -> Array:
        """Without dry friction."""
        return inverse_dynamics(self._model, q, v, a)

    def total(self, q: Array, v: Array, a: Array) -> Array:
        """With dry friction."""
        tau = self.smooth(q, v, a) + self._friction.torque(v, a)
        return tau if self._closure is None else tau + self._passive_friction(q, v)

    def _passive_friction(self, q: Array, v: Array) -> Array:
        """Against the dry friction of passive joints, (T, n)."""
        assert self._closure is not None
        ratios = self._closure.at(q)[1]
        return np.einsum("tmn,tm->tn", ratios, np.sign(np.einsum("tmn,tn->tm", ratios, v)) * self._passive_loss)

    def holding(self, q: Array) -> Array:
        tau = np.empty(q.shape)
        _core.gravity(self._model, np.ascontiguousarray(q), tau)
        return tau


class TorqueBounds:
    """Bounds on the torques: linear in the squared path speed and its slope, and with damping also in the path speed."""

    def __init__(self, arm: Arm):
        self._arm = arm
        self._inverse_dynamics = InverseDynamics(arm)
        self._bound = (1 - TORQUE_MARGIN) * arm.limits.tau_max
        self._voltage_bound = (1 - TORQUE_MARGIN) * arm.limits.stall_torque
        self._voltage_damping = arm.limits.voltage_damping

    def rows(self, s: Array, q: Array, v: Array, a: Array) -> TorqueRows:
        """The bounds at states of a motion, as `path_timing.Torques`."""
        smooth = self._inverse_dynamics.smooth
        zero = np.zeros_like(q)
        static = self._inverse_dynamics.holding(q)
        damping = self._inverse_dynamics.damping(v)
        coriolis = smooth(q, v, zero) - static - damping
        alpha = smooth(q, zero, v) - static
        beta = smooth(q, zero, a) - static + coriolis
        friction = np.sign(v) * self._inverse_dynamics.friction_loss
        low = -self._bound - static - friction
        high = self._bound - static - friction
        if (low >= 0).any() or (high <= 0).any():
            k, i = np.argwhere((low >= 0) | (high <= 0))[0]
            unit = self._arm.torque_units[i]
            raise PlanError(
                f"{self._arm.joint_names[i]}: holding still needs {static[k, i] + friction[k, i]:.4g} {unit} at "
                f"{100 * k / (len(q) - 1):.0f} % of the motion, but the limit is {self._arm.limits.tau_max[i]:.4g} {unit}; "
                "take a lighter payload or another path"
            )
        rows = TorqueRows(alpha, beta, damping, low, high)
        if not self._voltage_damping.any():
            return rows
        held = static + friction
        by_voltage = TorqueRows(
            alpha, beta, damping + self._voltage_damping * v, -self._voltage_bound - held, self._voltage_bound - held
        )
        return TorqueRows(*(np.concatenate(pair, axis=1) for pair in zip(rows, by_voltage, strict=True)))

    def overshoot(self, s: Array, q: Array, v: Array, a: Array) -> Array:
        """The share of what the bounds leave beside holding still, as `path_timing.Torques`."""
        static = self._inverse_dynamics.holding(q)
        dynamic = self._inverse_dynamics.smooth(q, v, a) - static
        held = static + np.sign(v) * self._inverse_dynamics.friction_loss
        share = _share_of_rest(dynamic, held, self._bound)
        if self._voltage_damping.any():
            share = np.maximum(share, _share_of_rest(dynamic + self._voltage_damping * v, held, self._voltage_bound))
        return share


def _share_of_rest(dynamic: Array, held: Array, bound: Array) -> Array:
    """(T,) the largest share of what bounds leave beside holding still."""
    up = np.maximum(bound - held, TORQUE_MARGIN * bound)
    down = np.maximum(bound + held, TORQUE_MARGIN * bound)
    return np.maximum(dynamic / up, -dynamic / down).max(axis=1)


def sample_times(motion: Trajectory | Pieces) -> Iterator[Array]:
    """Chunks of sample times: evenly spaced with the knots, or for a long motion so many times in each piece."""
    knots = motion.knots if isinstance(motion, (JointTrajectory, Pieces)) else None
    duration = motion.duration if not isinstance(motion, Pieces) else float(motion.knots[-1])
    count = math.ceil(duration / _SAMPLE_INTERVAL_S) + 1
    if count <= _MAX_EVEN_SAMPLES:
        even = np.linspace(0.0, duration, count)
        yield even if knots is None else np.union1d(even, knots)
    elif knots is not None:
        lengths = np.diff(knots)
        most = max(_MIN_SAMPLES_PER_PIECE, _MAX_EVEN_SAMPLES // len(lengths))
        counts = np.minimum(most, np.ceil(lengths / _SAMPLE_INTERVAL_S)).astype(np.int64) + 1
        chunk = np.cumsum(counts) // _MAX_EVEN_SAMPLES
        for pieces in np.split(np.arange(len(lengths)), np.flatnonzero(np.diff(chunk)) + 1):
            count = counts[pieces]
            last = np.cumsum(count) - 1
            number = np.arange(last[-1] + 1) - np.repeat(last + 1 - count, count)
            times = number * np.repeat(lengths[pieces] / np.maximum(count - 1, 1), count) + np.repeat(knots[pieces], count)
            times[last] = knots[pieces + 1]
            yield times
    else:
        for first in range(0, count, _MAX_EVEN_SAMPLES):
            yield np.minimum(np.arange(first, min(first + _MAX_EVEN_SAMPLES, count)) * _SAMPLE_INTERVAL_S, duration)
