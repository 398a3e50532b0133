"""What a motion is to everyone else: limits, setpoints, and the Trajectory protocol. Always in joints."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, vector


class Setpoint(NamedTuple):
    """Where the joints should be: one instant (n,), or many at once (T, n).

    Attributes:
        q: Position, rad (m for a slide joint).
        v: Velocity, rad/s.
        a: Acceleration, rad/s^2.
        v_tick: What a sampled velocity reads on the way, rad/s: the backward difference of q over the control period, or v
            where the arm moves continuously. None where nobody samples.
        a_tick: The change of v_tick over the coming period, rad/s^2: the acceleration that a discrete step must make.
    """

    q: Array
    v: Array
    a: Array
    v_tick: Array | None = None
    a_tick: Array | None = None


@dataclass(frozen=True, eq=False)
class Limits:
    """What the joints can do. Each (n,), read-only; `inf` where a joint is not limited.

    Attributes:
        q_min: Least position, rad (m for a slide joint).
        q_max: Greatest position, rad.
        v_max: Greatest speed, rad/s.
        a_max: Greatest acceleration, rad/s^2.
        j_max: Greatest jerk, rad/s^3.
        tau_max: Greatest torque, N m (N for a slide joint).
    """

    q_min: Array
    q_max: Array
    v_max: Array
    a_max: Array
    j_max: Array
    tau_max: Array

    def __post_init__(self) -> None:
        n = np.size(self.q_min)
        for field in fields(self):
            value = vector(field.name, getattr(self, field.name), n, finite=False)
            if np.isnan(value).any():
                raise InputError(f"{field.name}: joint {int(np.isnan(value).argmax())} is NaN, a number wanted")
            if not field.name.startswith("q_") and not (value > 0).all():
                raise InputError(f"{field.name}: {value.min():g} given, every value must be greater than 0")
            object.__setattr__(self, field.name, value)
        if not (self.q_min <= self.q_max).all():
            worst = int((self.q_min - self.q_max).argmax())
            raise InputError(f"q_min: {self.q_min[worst]:g} is above q_max, {self.q_max[worst]:g} (joint {worst})")

    def contains(self, q: ArrayLike, tolerance: float = 0.0) -> bool:
        """Whether positions are inside [q_min, q_max].

        Args:
            q: (n,) or (T, n) rad.
            tolerance: rad by which they may be outside.

        Returns:
            True if all are.
        """
        q = np.asarray(q)
        return bool(((q >= self.q_min - tolerance) & (q <= self.q_max + tolerance)).all())

    def clamp(self, q: ArrayLike) -> Array:
        """The nearest positions inside [q_min, q_max].

        Args:
            q: (n,) or (T, n) rad.

        Returns:
            The same shape, rad.
        """
        return np.clip(np.asarray(q, dtype=np.float64), self.q_min, self.q_max)

    def random(self, around: Array, count: int, rng: np.random.Generator) -> Array:
        """Positions anywhere inside [q_min, q_max], or within half a turn of `around` where a joint is not limited.

        Args:
            around: (n,) rad, inside the limits.
            count: How many.
            rng: The generator.

        Returns:
            (count, n) rad.
        """
        bounded = np.isfinite(self.q_max - self.q_min)
        low = np.where(bounded, self.q_min, np.maximum(self.q_min, around - np.pi))
        high = np.where(bounded, self.q_max, np.minimum(self.q_max, around + np.pi))
        return rng.uniform(low, high, (count, len(around)))


@runtime_checkable
class Trajectory(Protocol):
    """A motion of n joints over [0, duration]. Outside that time it stands still at its ends."""

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        ...

    def __call__(self, t: float) -> Setpoint:
        """The setpoint at a time.

        Args:
            t: s, clamped to [0, duration].

        Returns:
            q, v, a, each (n,).
        """
        ...

    def sample(self, times: ArrayLike) -> Setpoint:
        """The setpoints at many times at once.

        Args:
            times: (T,) s, each clamped to [0, duration].

        Returns:
            q, v, a, each (T, n).
        """
        ...


class TickReference(NamedTuple):
    """A trajectory on the tick grid: rows for a `Setpoint`, each (K, n).

    Attributes:
        q: Position, rad (m for a slide joint).
        v: Velocity, rad/s.
        a: Acceleration, rad/s^2.
        v_tick: What a sampled velocity reads on the way, rad/s.
        a_tick: The forward difference of v_tick, rad/s^2.
    """

    q: Array
    v: Array
    a: Array
    v_tick: Array
    a_tick: Array

    @classmethod
    def of(cls, trajectory: Trajectory, dt: float, ticks: int, continuous: bool = False) -> TickReference:
        """Samples a trajectory.

        Args:
            trajectory: The motion; it stands still before 0 and after its duration.
            dt: s, the tick.
            ticks: How many ticks, from t = 0 on.
            continuous: Whether the arm moves on continuously between ticks: its velocity then is no difference of positions.

        Returns:
            Its q, v, a and the differences of q (of v, where the arm moves continuously) on the grid.
        """
        q, v, a = trajectory.sample(dt * np.arange(-1, ticks + 1))[:3]
        q = np.array(q)
        q[0] = q[1] - dt * v[1]
        v_tick = v[1:] if continuous else np.diff(q, axis=0) / dt
        return cls(q[1:-1], v[1:-1], a[1:-1], v_tick[:-1], np.diff(v_tick, axis=0) / dt)


def check_motion(trajectory: object) -> None:
    """Makes sure that an argument is a motion.

    Args:
        trajectory: The argument.

    Raises:
        InputError: It cannot be followed, such as a joint position.
    """
    if not callable(trajectory) or not hasattr(trajectory, "duration"):
        raise InputError(f"trajectory: {trajectory!r:.80} is no motion; armctl.move_j(arm, arm.home, q) is one")
