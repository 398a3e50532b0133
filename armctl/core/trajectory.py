"""Setpoints and the Trajectory protocol. A trajectory is always in joint space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, shown


class Setpoint(NamedTuple):
    """Where the joints should be: one instant (n,), or many at once (T, n).

    Attributes:
        q: Position, rad (m for a slide joint).
        v: Velocity, rad/s.
        a: Acceleration, rad/s^2.
        v_tick: The sampled velocity, rad/s: the backward difference of q over the control period, or v
            if the arm moves continuously. None if the reference is not sampled.
        a_tick: The change of v_tick over the coming period, rad/s^2: the acceleration that a discrete step must make.
    """

    q: Array
    v: Array
    a: Array
    v_tick: Array | None = None
    a_tick: Array | None = None


@runtime_checkable
class Trajectory(Protocol):
    """A motion of n joints over [0, duration]. Outside that time it stands still at its ends."""

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        ...

    def __call__(self, t: float) -> Setpoint:
        """The setpoint at a time: q, v, a, each (n,).

        Args:
            t: s, clamped to [0, duration].
        """
        ...

    def sample(self, times: ArrayLike) -> Setpoint:
        """The setpoints at many times at once: q, v, a, each (T, n).

        Args:
            times: (T,) s, each clamped to [0, duration].
        """
        ...


class TickReference(NamedTuple):
    """A trajectory on the tick grid: the setpoints of K ticks, each (K, n)."""

    q: Array  # position, rad (m for a slide joint)
    v: Array  # velocity, rad/s
    a: Array  # acceleration, rad/s^2
    v_tick: Array  # the sampled velocity, rad/s
    a_tick: Array  # the forward difference of v_tick, rad/s^2

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory, dt: float, ticks: int, continuous: bool = False) -> TickReference:
        """Samples a trajectory at ticks of dt s from t = 0 on; it stands still before 0 and after its duration.

        v_tick has the differences of q; or v, where the arm moves on continuously between ticks.
        """
        sampled = trajectory.sample(dt * np.arange(-1, ticks + 1))
        q = np.array(sampled[0], dtype=np.float64)  # copies: a user's trajectory may use its memory again
        v = np.array(sampled[1], dtype=np.float64)
        a = np.array(sampled[2], dtype=np.float64)
        return cls.between(q[1:], v[1:], a[1:], q[1] - dt * v[1], dt, continuous)

    @classmethod
    def between(cls, q: Array, v: Array, a: Array, before: Array, dt: float, continuous: bool = False) -> TickReference:
        """K ticks between setpoints one tick apart, each (K + 1, n); v_tick is v where the arm moves on continuously.

        `before` (n,) is the position one tick before the first.
        """
        v_tick = v if continuous else np.diff(np.vstack([before, q]), axis=0) / dt
        return cls(q[:-1], v[:-1], a[:-1], v_tick[:-1], np.diff(v_tick, axis=0) / dt)


def check_trajectory(trajectory: object, what: str = "trajectory") -> None:
    """Raises InputError if an argument is not a trajectory."""
    if isinstance(trajectory, type):
        raise InputError(f"{what}: {shown(trajectory)} is a class, not a trajectory; give an object of it")
    lacking = [name for name in ("duration", "__call__", "sample") if not hasattr(trajectory, name)]
    if lacking:
        raise InputError(
            f"{what}: {shown(trajectory)} is not a trajectory; armctl.move_j(arm, arm.home, q) returns one. It lacks "
            f"{', '.join(lacking)}: one of your own has duration in s, and __call__(t) and sample(times), which return an "
            "armctl.Setpoint(q, v, a)"
        )


def check_motion(trajectory: Any, joint_names: Sequence[str], *, what: str = "trajectory") -> None:
    """Raises InputError if an argument, called `what`, is no motion of these joints.

    A motion without `joint_names`, such as one that a user wrote, is compared by its number of joints.
    """
    check_trajectory(trajectory, what)
    names = getattr(trajectory, "joint_names", None)
    if names is None:
        start: Any = trajectory(0.0)
        moved = np.size(start.q)
        if moved != len(joint_names):
            raise InputError(f"{what}: it moves {moved} joints, but the arm has {len(joint_names)}")
    elif tuple(names) != tuple(joint_names):
        planned = ", ".join(names)
        wanted = ", ".join(joint_names)
        raise InputError(f"{what}: it was planned for the joints {planned:.120}, but the arm has {wanted:.120}")
