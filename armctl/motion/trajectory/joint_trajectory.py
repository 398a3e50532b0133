"""JointTrajectory: what every planner returns. Piecewise polynomials of degree five in time, one row of them for each joint."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError
from armctl.core.trajectory import Limits, Setpoint
from armctl.core.validation import Array, IntArray, frozen, number, vector
from armctl.motion.slowdown import Slowdown
from armctl.motion.trajectory.limit_check import QUANTITIES, LimitCheck, check_limits
from armctl.motion.trajectory.piecewise import DEGREE, basis, basis_many

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
        slowed: Where the motors made it slower than speed, acceleration and jerk allow: by how much, for which joint.
        units: What each joint is measured in, "rad" or "m"; all in rad if left out.
    """

    knots: Array
    coefficients: Array
    joint_names: tuple[str, ...]
    limits: Limits
    slowed: Slowdown | None = None
    units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "units", self.units or ("rad",) * len(self.joint_names))
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

        Raises:
            InputError: The time is not a number.
        """
        knots = self._knot_list
        inside = min(max(t, 0.0), knots[-1])
        if inside != inside:
            raise InputError("t: nan given, a number wanted")
        k = min(bisect_right(knots, inside), len(knots) - 1) - 1
        u = inside - knots[k]
        q, v, a = np.array(basis(u)) @ self.coefficients[k]
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
        inside, k = self._located(t)
        q, v, a = np.einsum("otc,tcn->otn", basis_many(inside - self.knots[k]), self.coefficients[k])
        outside = t != inside
        v[outside] = a[outside] = 0.0
        return Setpoint(q, v, a)

    def jerk(self, times: ArrayLike) -> Array:
        """The jerk at many times.

        Args:
            times: (T,) s, each clamped to [0, duration].

        Returns:
            (T, n) rad/s^3; where it jumps, the value just after.

        Raises:
            InputError: Not a list of finite numbers.
        """
        inside, k = self._located(vector("times", times))
        u, c = (inside - self.knots[k])[:, None], self.coefficients[k]
        return 6 * c[:, 3] + u * (24 * c[:, 4] + u * 60 * c[:, 5])

    def check_limits(self, limits: Limits | None = None) -> LimitCheck:
        """Holds the motion against limits by its true extremes, also those between samples.

        Args:
            limits: The limits; its own if left out.

        Returns:
            The check: whether it is inside, and each joint's extremes with their times.
        """
        return check_limits(self.knots, self.coefficients, limits or self.limits, self.joint_names, self.units)

    def stopped_at(self, t: float) -> JointTrajectory:
        """The motion with a stop on its path, as soon as the limits allow once it is asked for.

        Args:
            t: s, when the stop is asked for; until then nothing changes.

        Returns:
            The motion, at rest at its end; it never leaves the path.

        Raises:
            InputError: The time is outside the motion.
            PlanError: The motion does not end at rest, and what is left of it is too short to stop.
        """
        from armctl.motion.trajectory.path_stop import stopped

        return stopped(self, number("t", t, 0.0, self.duration))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the motion, exactly, as a NumPy archive that `JointTrajectory.load` reads.

        Args:
            path: Where to; its folder is made, and the name gets the ending .npz if it has none.

        Returns:
            The file.
        """
        from armctl.motion.trajectory import files

        return files.save(self, path)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> JointTrajectory:
        """Reads a motion that `save` wrote.

        Args:
            path: The file.

        Returns:
            The motion.

        Raises:
            InputError: There is no such file, or it holds no motion.
        """
        from armctl.motion.trajectory import files

        return files.load(path)

    def to_csv(self, path: str | os.PathLike[str], dt: float = 1e-3) -> Path:
        """Writes samples as a table: t, then q, v and a of each joint, named in the first row.

        Args:
            path: Where to; its folder is made.
            dt: s, from sample to sample; the end is always one.

        Returns:
            The file.

        Raises:
            InputError: dt is not greater than 0.
        """
        from armctl.motion.trajectory import files

        return files.to_csv(self, path, dt)

    def plot(self, path: str | os.PathLike[str] | None = None) -> object:
        """Draws position, velocity, acceleration and jerk of every joint, the last three as shares of their limits.

        Args:
            path: Where to save the picture; left out, it is not saved.

        Returns:
            Matplotlib's figure.
        """
        from armctl.motion.trajectory import files

        return files.plot(self, path)

    def _located(self, t: Array) -> tuple[Array, IntArray]:
        """Times clamped to the motion, and the pieces they are in."""
        inside = np.clip(t, 0.0, self.duration)
        return inside, np.clip(np.searchsorted(self.knots, inside, side="right"), 1, len(self.knots) - 1) - 1

    def scaled(self, factor: float) -> JointTrajectory:
        """The same path at another speed, as the speed override of a robot controller.

        Args:
            factor: Of the speed, greater than 0; 0.5 takes twice as long.

        Returns:
            The slower (or, where the limits allow it, faster) motion.

        Raises:
            InputError: The factor is not greater than 0.
            LimitError: It is greater than 1, and a joint would leave its limits.
        """
        factor = number("factor", factor, 1e-9)
        powers = factor ** np.arange(DEGREE + 1)
        changed = replace(self, knots=self.knots / factor, coefficients=self.coefficients * powers[:, None])
        if factor > 1.0 and not (check := changed.check_limits()).ok:
            raise LimitError(f"factor: {factor:g} is too fast: {check.violations[0]}")
        return changed

    def then(self, other: JointTrajectory) -> JointTrajectory:
        """This motion, and after it another one.

        Args:
            other: A motion that starts as this one ends: same position, velocity and acceleration.

        Returns:
            Both in one.

        Raises:
            InputError: No such motion, other joints, or it starts elsewhere.
        """
        if not isinstance(other, JointTrajectory):
            raise InputError(f"then: {other!r} is no JointTrajectory")
        if other.joint_names != self.joint_names:
            raise InputError(f"then: a motion of {list(other.joint_names)} cannot follow one of {list(self.joint_names)}")
        for what, end, start in zip(QUANTITIES[:3], self(self.duration)[:3], other(0.0)[:3], strict=True):
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
        slowed = [part.slowed for part in parts if part.slowed is not None]
        slowest = max(slowed, key=lambda slowdown: slowdown.factor, default=None)
        return replace(parts[0], knots=np.concatenate(knots), coefficients=coefficients, slowed=slowest)

    @classmethod
    def standing(cls, joint_names: tuple[str, ...], limits: Limits, units: tuple[str, ...], q: Array) -> JointTrajectory:
        """No motion: it stands at a position and takes no time.

        Args:
            joint_names: The n joints.
            limits: Their limits.
            units: What each is measured in, "rad" or "m".
            q: (n,) rad.

        Returns:
            The motion.
        """
        coefficients = np.zeros((1, DEGREE + 1, len(q)))
        coefficients[0, 0] = q
        return cls(np.zeros(2), coefficients, joint_names, limits, units=units)

    def __reduce__(self):
        return JointTrajectory, (self.knots, self.coefficients, self.joint_names, self.limits, self.slowed, self.units)

    def __repr__(self) -> str:
        return f"JointTrajectory({self.n} joints, {self.duration:.3f} s)"
