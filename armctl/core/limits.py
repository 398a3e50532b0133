"""Limits: the ranges of the joints, and their greatest speed, acceleration, jerk and torque; a search within the ranges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, instance, number, shown, vector

# Of the search for a configuration.
_FIRST_STEP = 0.2  # of the range of each joint, and at most of a turn
_DISTANCE_FROM_LIMITS = 0.01  # of the range: controllers that respect limits act differently there
_GROWTH = 1.5  # of the step after a success, and to the power of -1/4 after a failure: Rechenberg's rule of 1/5 of successes

_MAX_SAMPLES = 10**7  # in one array; more is a mistake, and takes gigabytes


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits of the joints. Each (n,), read-only; `inf` if a joint is not limited.

    Attributes:
        q_min: Minimum position, rad (m for a slide joint).
        q_max: Maximum position, rad.
        v_max: Maximum speed, rad/s.
        a_max: Maximum acceleration, rad/s^2.
        j_max: Maximum jerk, rad/s^3.
        tau_max: Maximum torque, N m (N for a slide joint).
        stall_torque: Torque of a DC motor at rest and full voltage, N m. At a speed v it gives
            `|tau + stall_torque v / no_load_speed| <= stall_torque`. `inf`, or left out, for a torque that no voltage limits.
        no_load_speed: Its speed at full voltage without a load, rad/s.
    """

    q_min: Array
    q_max: Array
    v_max: Array
    a_max: Array
    j_max: Array
    tau_max: Array
    stall_torque: Array = None  # type: ignore[assignment]  # infinite
    no_load_speed: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        n = vector("q_min", self.q_min, finite=False).size
        for field in fields(self):
            given = getattr(self, field.name)
            value = vector(field.name, np.full(n, np.inf) if given is None else given, n, finite=False)
            if np.isnan(value).any():
                raise InputError(f"{field.name}: joint {int(np.isnan(value).argmax())} is NaN, expected a number")
            if not field.name.startswith("q_") and not (value > 0).all():
                raise InputError(f"{field.name}: every value must be greater than 0, got {value.min():g}")
            object.__setattr__(self, field.name, value)
        if not (self.q_min <= self.q_max).all():
            worst = int((self.q_min - self.q_max).argmax())
            raise InputError(f"q_min: {self.q_min[worst]:g} is above q_max, {self.q_max[worst]:g} (joint {worst})")

    def contains(self, q: ArrayLike, tolerance: float = 0.0) -> bool:
        """Whether positions are inside [q_min, q_max].

        Args:
            q: (n,) or (T, n) rad.
            tolerance: rad by which they may be outside.
        """
        tolerance = number("tolerance", tolerance, 0.0)
        q = self._positions(q)
        return bool(((q >= self.q_min - tolerance) & (q <= self.q_max + tolerance)).all())

    def clamp(self, q: ArrayLike) -> Array:
        """The nearest positions inside [q_min, q_max].

        Args:
            q: (n,) or (T, n) rad.

        Returns:
            The same shape, rad.

        Raises:
            InputError: The positions are not numbers, not of n joints, or NaN.
        """
        positions = self._positions(q)
        if np.isnan(positions).any():
            raise InputError("q: expected a number, got NaN")
        return np.clip(positions, self.q_min, self.q_max)

    def random(self, around: Array, count: int, rng: np.random.Generator) -> Array:
        """Positions anywhere inside [q_min, q_max], or within half a turn of `around` where a joint is not limited.

        Args:
            around: (n,) rad; the nearest positions inside the limits are used.

        Returns:
            (count, n) rad.

        Raises:
            InputError: `around` is not a configuration, the count is no integer from 0 to 10 million, or rng is no Generator.
        """
        instance("rng", rng, np.random.Generator, "numpy.random.default_rng(0) is one")
        instance("count", count, (int, np.integer), "give an integer")
        number("count", count, 0, _MAX_SAMPLES)
        around = self.clamp(around)
        bounded = np.isfinite(self.q_max - self.q_min)
        low = np.where(bounded, self.q_min, np.maximum(self.q_min, around - np.pi))
        high = np.where(bounded, self.q_max, np.minimum(self.q_max, around + np.pi))
        return rng.uniform(low, high, (count, len(around)))

    def at_speed(self, speed: float) -> Limits:
        """The limits for motions at a fraction of the full speed: the same motions, slowed down in time by 1/speed.

        Args:
            speed: In (0, 1]; it scales v_max by speed, a_max by speed^2 and j_max by speed^3, and nothing else.
        """
        speed = check_speed(speed)
        if speed == 1.0:
            return self
        return replace(self, v_max=speed * self.v_max, a_max=speed**2 * self.a_max, j_max=speed**3 * self.j_max)

    @property
    def voltage_damping(self) -> Array:
        """(n,) N m s/rad, how much the torque at full voltage falls with speed; 0 where no voltage limits it."""
        return np.divide(
            self.stall_torque, self.no_load_speed, where=np.isfinite(self.stall_torque), out=np.zeros_like(self.tau_max)
        )

    def _positions(self, q: ArrayLike) -> Array:
        """(n,) or (T, n) float64; NaN is left to the caller, infinity is a position outside."""
        try:
            positions = np.asarray(q, dtype=np.float64)
        except Exception:  # a caller's object may raise anything while NumPy converts it
            raise InputError(f"q: {shown(q)} is not an array of numbers") from None
        if positions.ndim not in (1, 2) or positions.shape[-1] != len(self.q_min):
            raise InputError(f"q: expected shape ({len(self.q_min)},) or (T, {len(self.q_min)}), got {positions.shape}")
        return positions


def torque_shares(limits: Limits, tau: Array, v: Array) -> Array:
    """(..., n) the shares of what the motors can give at (..., n) speeds, by torque and by voltage; above 1 is too much."""
    return np.maximum(np.abs(tau) / limits.tau_max, np.abs(tau + limits.voltage_damping * v) / limits.stall_torque)


def check_speed(speed: float) -> float:
    """A caller's `speed` argument as a float in (0, 1]; raises InputError."""
    return number("speed", speed, 1e-6, 1.0)


def smallest_configuration(
    limits: Limits, score: Callable[[Array], float], starts: Sequence[Array], steps: int, rng: np.random.Generator
) -> Array:
    """The configuration (n,) rad with the smallest score that random steps find, without gradients.

    An evolution strategy of one parent and one child from each start, with so many steps (Rechenberg, Evolutionsstrategie,
    1973). A score that is not finite is no improvement.
    """
    width = np.minimum(limits.q_max - limits.q_min, 2 * np.pi)
    low = limits.q_min + _DISTANCE_FROM_LIMITS * width
    high = limits.q_max - _DISTANCE_FROM_LIMITS * width
    best = starts[0]
    least = np.inf
    for start in starts:
        q = start
        value = score(q)
        step = _FIRST_STEP
        for _ in range(steps):
            child = np.clip(q + step * width * rng.standard_normal(len(q)), low, high)
            childs = score(child)
            if childs < value:
                q = child
                value = childs
                step *= _GROWTH
            else:
                step *= _GROWTH**-0.25
        if value < least:
            best = q
            least = value
    return best
