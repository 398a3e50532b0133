"""JointTrajectory: what every planner returns. Piecewise polynomials of degree five in time, one row of them for each joint."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from armctl.arrays import Array, frozen, number, vector
from armctl.errors import InputError
from armctl.trajectory import Limits, Setpoint

DEGREE = 5
_JOIN_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """A motion of n joints, continuous in position, velocity and acceleration. Frozen; an `armctl.Trajectory`.

    In piece k, with u = t - knots[k]: q(t) = sum over i of coefficients[k, i] u^i. Constant jerk is a cubic, so the profiles of
    an online trajectory generator are held exactly; paths that curve take all five degrees.

    Attributes:
        knots: (m + 1,) s, from 0 to the duration, not decreasing.
        coefficients: (m, 6, n) rad/s^i.
        joint_names: The n joints.
        limits: The limits it was planned for.
    """

    knots: Array
    coefficients: Array
    joint_names: tuple[str, ...]
    limits: Limits

    def __post_init__(self) -> None:
        frozen(self.knots)
        frozen(self.coefficients)

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return self._knot_list[-1]

    @property
    def n(self) -> int:
        """How many joints it moves."""
        return len(self.joint_names)

    @cached_property
    def _knot_list(self) -> list[float]:
        return self.knots.tolist()

    def __call__(self, t: float) -> Setpoint:
        """The setpoint at a time.

        Args:
            t: s, clamped to [0, duration]; outside it the arm stands still at the end.

        Returns:
            q, v, a, each (n,).
        """
        knots = self._knot_list
        inside = min(max(t, 0.0), knots[-1])
        k = min(bisect_right(knots, inside), len(knots) - 1) - 1
        u = inside - knots[k]
        q, v, a = np.array(_basis(u)) @ self.coefficients[k]
        return Setpoint(q, v, a) if inside == t else Setpoint(q, np.zeros_like(v), np.zeros_like(a))

    def sample(self, times: ArrayLike) -> Setpoint:
        """The setpoints at many times at once.

        Args:
            times: (T,) s, each clamped to [0, duration].

        Returns:
            q, v, a, each (T, n).

        Raises:
            InputError: Not a list of finite numbers.
        """
        t = vector("times", times)
        inside = np.clip(t, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.knots, inside, side="right"), 1, len(self.knots) - 1) - 1
        q, v, a = np.einsum("otc,tcn->otn", _basis_many(inside - self.knots[k]), self.coefficients[k])
        outside = t != inside
        v[outside] = a[outside] = 0.0
        return Setpoint(q, v, a)

    def scaled(self, factor: float) -> JointTrajectory:
        """The same path at another speed, as the speed override of a robot controller.

        Args:
            factor: Of the speed, greater than 0; 0.5 takes twice as long.

        Returns:
            The slower (or, where the limits allow it, faster) motion.

        Raises:
            InputError: The factor is not greater than 0.
        """
        factor = number("factor", factor, np.finfo(float).tiny)
        powers = factor ** np.arange(DEGREE + 1)
        return replace(self, knots=self.knots / factor, coefficients=self.coefficients * powers[:, None])

    def then(self, other: JointTrajectory) -> JointTrajectory:
        """This motion, and after it another one.

        Args:
            other: A motion that starts as this one ends: same position, velocity and acceleration.

        Returns:
            Both in one.

        Raises:
            InputError: Other joints, or it starts elsewhere.
        """
        if other.joint_names != self.joint_names:
            raise InputError(f"then: a motion of {list(other.joint_names)} cannot follow one of {list(self.joint_names)}")
        for what, end, start in zip(
            ("position", "velocity", "acceleration"), self(self.duration)[:3], other(0.0)[:3], strict=True
        ):
            gap = np.abs(end - start)
            if (gap > _JOIN_TOLERANCE * np.maximum(1.0, np.abs(end))).any():
                i = int(gap.argmax())
                raise InputError(
                    f"then: {self.joint_names[i]}: the first motion ends at {what} {end[i]:.6g}, the second starts at "
                    f"{start[i]:.6g}; plan it from where the first one ends"
                )
        return self.joined([self, other])

    @classmethod
    def joined(cls, parts: Sequence[JointTrajectory]) -> JointTrajectory:
        """Motions one after another, each known to start as the one before it ends.

        Args:
            parts: The motions, at least one.

        Returns:
            All in one.
        """
        starts = np.cumsum([0.0, *(part.duration for part in parts)])
        knots = [[0.0], *(start + part.knots[1:] for start, part in zip(starts[:-1], parts, strict=True))]
        coefficients = np.concatenate([part.coefficients for part in parts])
        return replace(parts[0], knots=np.concatenate(knots), coefficients=coefficients)

    @classmethod
    def standing(cls, joint_names: tuple[str, ...], limits: Limits, q: Array) -> JointTrajectory:
        """No motion: it stands at a position and takes no time.

        Args:
            joint_names: The n joints.
            limits: Their limits.
            q: (n,) rad.

        Returns:
            The motion.
        """
        coefficients = np.zeros((1, DEGREE + 1, len(q)))
        coefficients[0, 0] = q
        return cls(np.zeros(2), coefficients, joint_names, limits)

    def __repr__(self) -> str:
        return f"JointTrajectory({self.n} joints, {self.duration:.3f} s)"


def _basis(u: float) -> tuple[tuple[float, ...], ...]:
    """Rows that turn the coefficients of a piece into q, v and a at local time u."""
    u2, u3, u4 = u * u, u**3, u**4
    return (
        (1.0, u, u2, u3, u4, u**5),
        (0.0, 1.0, 2 * u, 3 * u2, 4 * u3, 5 * u4),
        (0.0, 0.0, 2.0, 6 * u, 12 * u2, 20 * u3),
    )


def _basis_many(u: Array) -> Array:
    """`_basis` at many local times: (3, T, 6)."""
    one, zero = np.ones_like(u), np.zeros_like(u)
    rows = [[entry + zero if isinstance(entry, np.ndarray) else entry * one for entry in row] for row in _basis(u)]  # type: ignore[arg-type]
    return np.moveaxis(np.array(rows), 1, 2)
