"""Limits of single sections of a motion: fractions of its speed and of the acceleration limits, and a payload."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import PlanError
from armctl.core.limits import torque_shares
from armctl.core.validation import Array, IntArray, number
from armctl.model.arm.arm import Arm
from armctl.plan.motion.timing.path_timing import Fractions, slowed_down
from armctl.plan.motion.timing.speed_bounds import TorqueRows
from armctl.plan.motion.torque_limits import MAX_STRETCHES, InverseDynamics, MotionPath, TorqueBounds, sample_times, stretch_for
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory, Slowdown
from armctl.plan.motion.trajectory.piecewise import Pieces, joints_of, sample, standing, time_scaled

_MIN_FRACTION = 1e-3
_MAX_DWELL_S = 3600.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Section:
    """What a `Via`, a `Line` and an `Arc` say about their section of a motion.

    Attributes:
        speed: Fraction of the speed that the motion has without it, in (0, 1].
        acceleration: Fraction of the joints' acceleration limits, in (0, 1].
        payload: kg at the tip, in addition to the payload of the arm.
        dwell: s, a pause at its end, where no corner is rounded then; 0 for no stop.

    Raises:
        InputError: A fraction is outside (0, 1], or the payload or the pause is negative.
    """

    speed: float = 1.0
    acceleration: float = 1.0
    payload: float = 0.0
    dwell: float = 0.0

    def __post_init__(self) -> None:
        number("speed", self.speed, _MIN_FRACTION, 1.0)
        number("acceleration", self.acceleration, _MIN_FRACTION, 1.0)
        number("payload", self.payload, 0.0)
        number("dwell", self.dwell, 0.0, _MAX_DWELL_S)


@dataclass(frozen=True, eq=False)
class Via(Section):
    """A waypoint of `move_through`, and by keywords the limits of the section that ends at it.

    `speed` and `acceleration` are fractions of those that the motion has without them, `payload` is kg at the tip in addition
    to that of the arm, and `dwell` s of rest at the waypoint.

    Attributes:
        q: (n,) rad.
    """

    q: ArrayLike


def is_limited(section: Section) -> bool:
    """Whether a section limits the motion on it."""
    return (section.speed, section.acceleration, section.payload) != (1.0, 1.0, 0.0)


def pause(arm: Arm, q: Array, duration: float) -> JointTrajectory:
    """The arm at rest at q (n,) for a time, s."""
    coefficients = standing(q).coefficients
    return JointTrajectory(
        knots=np.array([0.0, duration]),
        coefficients=coefficients,
        joint_names=arm.joint_names,
        limits=arm.limits,
        units=arm.units,
    )


def within_sections(arm: Arm, motion: JointTrajectory, ends: Array, limits: Sequence[Section]) -> JointTrajectory:
    """A motion from rest to rest, within the limits of its k sections and of the torques, on the same path.

    `ends` (k,) s are the ends of the sections. `slowed` of the result says what the torque limits, with the payloads, cost.
    Raises PlanError if a motor cannot hold the arm with its payload, however slowly it moves.
    """
    fractions = Fractions(ends, np.array([each.speed for each in limits]), np.array([each.acceleration for each in limits]))
    torques = _SectionTorques(arm, ends, limits)
    path = MotionPath(motion)
    knots = np.union1d(motion.knots, ends)
    free = slowed_down(path, motion.limits, knots, None, fractions)
    needed = torques.needed(free)
    if needed.share <= 1.0:
        return JointTrajectory(*joints_of(free), arm.joint_names, arm.limits, units=arm.units)
    feasible = slowed_down(path, motion.limits, knots, torques, fractions)
    for _ in range(MAX_STRETCHES):
        if torques.needed(feasible).share <= 1.0:
            slowed = Slowdown(float(feasible.knots[-1] / free.knots[-1]), arm.joint_names[needed.joint], needed.share)
            return JointTrajectory(*joints_of(feasible), arm.joint_names, arm.limits, slowed=slowed, units=arm.units)
        overshoot = max(float(torques.overshoot(*states).max()) for states in torques.samples(feasible))
        feasible = time_scaled(feasible, 1 / stretch_for(overshoot))
    raise PlanError(
        f"{arm.joint_names[needed.joint]} saturates with its payload, however slowly the arm moves; "
        "take a lighter payload or another path"
    )


class _Needed(NamedTuple):
    """The largest share of a torque limit, and the joint that needs it."""

    share: float
    joint: int


class _SectionTorques:
    """The torque limits of a motion whose sections have payloads; lengths are times in the planned motion."""

    def __init__(self, arm: Arm, ends: Array, limits: Sequence[Section]):
        self._ends = ends
        self._n = arm.n
        self._limits = arm.limits
        loaded = {each.payload: arm.with_payload(each.payload) if each.payload else arm for each in limits}
        bounds = {payload: TorqueBounds(each) for payload, each in loaded.items()}
        dynamics = {payload: InverseDynamics(each) for payload, each in loaded.items()}
        self._bounds = [bounds[each.payload] for each in limits]
        self._dynamics = [dynamics[each.payload] for each in limits]

    def rows(self, s: Array, q: Array, v: Array, a: Array) -> TorqueRows:
        """The bounds at states of the motion, those of the section that each is in."""
        parts = [(here, self._bounds[k].rows(s[here], q[here], v[here], a[here])) for k, here in self._sections(s)]
        rows = TorqueRows(*(np.empty((len(q), column.shape[1])) for column in parts[0][1]))
        for here, part in parts:
            for whole, values in zip(rows, part, strict=True):
                whole[here] = values
        return rows

    def overshoot(self, s: Array, q: Array, v: Array, a: Array) -> Array:
        """The share of what the bounds leave beside holding still, (T,)."""
        shares = np.zeros(len(s))
        for k, here in self._sections(s):
            shares[here] = self._bounds[k].overshoot(s[here], q[here], v[here], a[here])
        return shares

    def needed(self, pieces: Pieces) -> _Needed:
        """The largest share of a torque limit in a motion with its length."""
        worst = _Needed(0.0, 0)
        for s, q, v, a in self.samples(pieces):
            for k, here in self._sections(s):
                shares = torque_shares(self._limits, self._dynamics[k].total(q[here], v[here], a[here]), v[here])
                joint = int(shares.max(axis=0).argmax())
                worst = max(worst, _Needed(float(shares[:, joint].max()), joint))
        return worst

    def samples(self, pieces: Pieces) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Lengths, positions, velocities and accelerations."""
        for times in sample_times(pieces):
            q, v, a = sample(pieces, times)
            yield q[:, -1], q[:, : self._n], v[:, : self._n], a[:, : self._n]

    def _sections(self, s: Array) -> list[tuple[int, IntArray]]:
        """The sections that lengths are in, and which of the lengths."""
        section = np.clip(np.searchsorted(self._ends, s, side="right"), 0, len(self._ends) - 1)
        return [(int(k), np.flatnonzero(section == k)) for k in np.unique(section)]
