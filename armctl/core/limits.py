"""Limits: the ranges of the joints, and their greatest speed, acceleration, jerk and torque; a search within the ranges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.validation import Array, frozen, instance, number, shown, vector

# Of the search for a configuration.
_FIRST_STEP = 0.2  # of the range of each joint, and at most of a turn
_DISTANCE_FROM_LIMITS = 0.01  # of the range: controllers that respect limits act differently there
_GROWTH = 1.5  # of the step after a success, and to the power of -1/4 after a failure: Rechenberg's rule of 1/5 of successes

# What a field is where nothing is given; infinite for all others.
_LEFT_OUT = {"v_min": -np.inf, "a_min": -np.inf, "velocity_offset": 0.0}

_MAX_SAMPLES = 10**7  # in one array; more is a mistake, and takes gigabytes


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits of the joints. Each (n,), read-only; `inf` if a joint is not limited.

    Attributes:
        q_min: Minimum position, rad (m for a slide joint).
        q_max: Maximum position, rad.
        v_max: Maximum velocity, rad/s.
        a_max: Maximum acceleration, rad/s^2.
        j_max: Maximum jerk, rad/s^3.
        tau_max: Maximum torque, N m (N for a slide joint).
        stall_torque: Torque of a DC motor at rest and full voltage, N m. At a speed v it gives
            `|tau + stall_torque v / no_load_speed| <= stall_torque`. `inf`, or left out, for a torque that no voltage limits.
        no_load_speed: Its speed at full voltage without a load, rad/s.
        v_min: Minimum velocity, rad/s, less than 0; `-inf`, or left out, for `-v_max`.
        a_min: Minimum acceleration, rad/s^2, less than 0; `-inf`, or left out, for `-a_max`.
        deceleration_limit: rad/s^2. At a distance d from an end of its range, a joint moves towards this end with at most
            `sqrt(2 deceleration_limit d) - velocity_offset`, as Franka publishes it for its FR3; where that is less than 0,
            it does not move towards the end. `inf`, or left out, for a velocity limit that does not depend on the position.
        velocity_offset: rad/s, at least 0; 0, or left out, for none.
    """

    q_min: Array
    q_max: Array
    v_max: Array
    a_max: Array
    j_max: Array
    tau_max: Array
    stall_torque: Array = None  # type: ignore[assignment]  # infinite
    no_load_speed: Array = None  # type: ignore[assignment]
    v_min: Array = None  # type: ignore[assignment]
    a_min: Array = None  # type: ignore[assignment]
    deceleration_limit: Array = None  # type: ignore[assignment]
    velocity_offset: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        n = vector("q_min", self.q_min, finite=False).size
        for field in fields(self):
            given = getattr(self, field.name)
            left_out = _left_out(field.name, n)
            if given is None or given is left_out:  # also in `dataclasses.replace`, which so takes less time
                object.__setattr__(self, field.name, left_out)
                continue
            value = vector(field.name, given, n, finite=field.name == "velocity_offset")
            if np.isnan(value).any():
                raise InputError(f"{field.name}: joint {int(np.isnan(value).argmax())} is NaN, expected a number")
            if field.name in ("v_min", "a_min"):
                if not (value < 0).all():
                    raise InputError(f"{field.name}: every value must be less than 0, got {value.max():g}")
            elif field.name == "velocity_offset":
                if not (value >= 0).all():
                    raise InputError(f"{field.name}: every value must be at least 0, got {value.min():g}")
            elif not field.name.startswith("q_") and not (value > 0).all():
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
            speed: In (0, 1]; it scales velocities by speed, accelerations by speed^2 and j_max by speed^3, and nothing else.
        """
        speed = check_speed(speed)
        if speed == 1.0:
            return self
        slow = replace(self, v_max=speed * self.v_max, a_max=speed**2 * self.a_max, j_max=speed**3 * self.j_max)
        if np.isfinite(self.v_min).any() or np.isfinite(self.a_min).any():
            slow = replace(slow, v_min=speed * self.v_min, a_min=speed**2 * self.a_min)
        if not self.depends_on_position:
            return slow
        return replace(
            slow, deceleration_limit=speed**2 * self.deceleration_limit, velocity_offset=speed * self.velocity_offset
        )

    @cached_property
    def v_low(self) -> Array:
        """(n,) rad/s, the lowest velocities away from the ends of the range; `v_min`, or `-v_max` where there is none."""
        return frozen(np.where(np.isfinite(self.v_min), self.v_min, -self.v_max))

    @cached_property
    def a_low(self) -> Array:
        """(n,) rad/s^2, the lowest accelerations; `a_min`, or `-a_max` where there is none."""
        return frozen(np.where(np.isfinite(self.a_min), self.a_min, -self.a_max))

    @cached_property
    def depends_on_sign(self) -> bool:
        """Whether velocity or acceleration of a joint has other limits in one direction than in the other."""
        return bool((self.v_low != -self.v_max).any() or (self.a_low != -self.a_max).any())

    @cached_property
    def depends_on_position(self) -> bool:
        """Whether a velocity limit shrinks near an end of a joint's range."""
        is_bounded = np.isfinite(self.q_min) | np.isfinite(self.q_max)
        return bool((np.isfinite(self.deceleration_limit) & is_bounded).any())

    @cached_property
    def symmetric(self) -> Limits:
        """Limits that are the same in both directions: the smaller ones."""
        if not self.depends_on_sign:
            return self
        v_max = np.minimum(self.v_max, -self.v_low)
        a_max = np.minimum(self.a_max, -self.a_low)
        return replace(self, v_max=v_max, a_max=a_max, v_min=None, a_min=None)  # type: ignore[arg-type]

    @cached_property
    def plain(self) -> Limits:
        """Limits that depend neither on the sign nor on the position: `symmetric`, the same at the ends of the range."""
        if not self.depends_on_position:
            return self.symmetric
        return replace(self.symmetric, deceleration_limit=None)  # type: ignore[arg-type]

    @cached_property
    def larger_sides(self) -> tuple[Array, Array, Array]:
        """The greatest velocity, acceleration and jerk in either direction, each (n,)."""
        return frozen(np.maximum(self.v_max, -self.v_low)), frozen(np.maximum(self.a_max, -self.a_low)), self.j_max

    def velocity_bounds(self, q: ArrayLike, dt: float = 0.0) -> tuple[Array, Array]:
        """The velocities that are allowed at positions, which may be outside [q_min, q_max].

        Args:
            q: (n,) or (T, n) rad.
            dt: s, for how long a velocity is held, and is allowed until then.

        Returns:
            The lowest and the highest ones, each of the same shape, rad/s.

        Raises:
            InputError: The positions are not numbers, or not of n joints.
        """
        q = self._positions(q)
        low = self.v_low if q.ndim == 1 else np.broadcast_to(self.v_low, q.shape)
        high = self.v_max if q.ndim == 1 else np.broadcast_to(self.v_max, q.shape)
        if not self.depends_on_position:
            return low, high
        with np.errstate(invalid="ignore"):  # infinity of a joint without limits
            up = self._fastest_towards(np.maximum(self.q_max - q, 0.0), dt)
            down = self._fastest_towards(np.maximum(q - self.q_min, 0.0), dt)
        is_limited = np.isfinite(self.deceleration_limit)
        up = np.where(is_limited, np.maximum(up, 0.0), np.inf)
        down = np.where(is_limited, np.maximum(down, 0.0), np.inf)
        return np.maximum(low, -down), np.minimum(high, up)

    def _fastest_towards(self, distance: Array, dt: float) -> Array:
        """The velocities towards an end at a distance from it that may be held for dt; less than 0 where none is allowed.

        (v + offset)^2 <= 2 deceleration_limit (distance - v dt) is solved for v.
        """
        squared = 2.0 * self.deceleration_limit * distance
        if dt == 0.0:
            return np.sqrt(squared) - self.velocity_offset
        half = self.velocity_offset + self.deceleration_limit * dt
        return np.sqrt(np.maximum(half**2 - self.velocity_offset**2 + squared, 0.0)) - half

    @cached_property
    def end_zones(self) -> Array:
        """(n,) rad, how near to an end of its range a joint must not move towards it; 0 without such a limit."""
        return frozen(self.velocity_offset**2 / (2.0 * self.deceleration_limit))

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


@lru_cache(maxsize=256)
def _left_out(name: str, n: int) -> Array:
    """(n,) what a field of limits is where nothing is given."""
    return frozen(np.full(n, _LEFT_OUT.get(name, np.inf)))


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
