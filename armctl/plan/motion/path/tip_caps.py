"""Caps on the speed of the tip, and how much of them a motion of the joints uses over its whole length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armctl import _core
from armctl.core.validation import Array, number
from armctl.model.arm.arm import Arm
from armctl.plan.motion.timing.initial_timing import Path
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import limit_excess
from armctl.plan.motion.trajectory.piecewise import DEGREE, Pieces, basis_many

_DEGREE = 8  # of the polynomials for the squared speed of the tip, in each piece
# A piece that is longer in both is divided: the squared speed is no polynomial. Time alone would divide a slow motion thousands
# of times, though the tip moves hardly at all in each part.
_MAX_PART_S = 0.02
_MAX_PART_TRAVEL = 0.01  # rad (m), of all joints together


@dataclass(frozen=True, eq=False)
class TipCaps:
    """The greatest speeds of the tips along a path of the joints."""

    arm: Arm
    path: Path  # the path of its joints
    tips: tuple[str, ...]
    linear: float  # m/s, of its point
    angular: float  # rad/s, of its turning

    @classmethod
    def from_path(
        cls,
        arm: Arm,
        path: Path,
        speed: float,
        tip_speed: float | None,
        tip_angular_speed: float | None,
        tips: tuple[str, ...] | None = None,
    ) -> TipCaps | None:
        """The caps at a fraction of the full speed, of the first tip unless others are named; None if there are none."""
        if tip_speed is None and tip_angular_speed is None:
            return None
        linear = np.inf if tip_speed is None else speed * number("tip_speed", tip_speed, 1e-6)
        angular = np.inf if tip_angular_speed is None else speed * number("tip_angular_speed", tip_angular_speed, 1e-6)
        return cls(arm=arm, path=path, tips=tips or (arm.tip,), linear=linear, angular=angular)

    def at(self, s: Array) -> Array:
        """(T,) m/s, the greatest speeds along the path at lengths (T,)."""
        twists = self._twists(*self.path.derivatives(s)[:2])
        with np.errstate(divide="ignore"):
            linear = self.linear / np.linalg.norm(twists[:, :, :3], axis=2)
            angular = self.angular / np.linalg.norm(twists[:, :, 3:], axis=2)
        return np.minimum(linear, angular).min(axis=0)

    def acceleration_at(self, s: Array) -> Array:
        """The caps leave the acceleration limits as they are: (T,) ones."""
        return np.ones_like(s)

    def overshoot(self, pieces: Pieces) -> Array:
        """The share of the caps that the tip uses in each piece, (m,); any number of at most 1 where it keeps them.

        The squared speed of the tip is interpolated at Chebyshev's points, to rounding; its extremes are those of polynomials.
        """
        joints = pieces.coefficients[:, :, : self.arm.n]
        steps = np.diff(pieces.knots)
        travel = np.einsum("mp,mpn->m", steps[:, None] ** np.arange(1, DEGREE + 1), np.abs(joints[:, 1:]))
        parts = np.maximum(1, np.ceil(np.minimum(steps / _MAX_PART_S, travel / _MAX_PART_TRAVEL))).astype(int)
        piece = np.repeat(np.arange(len(steps)), parts)
        first = np.concatenate([[0], np.cumsum(parts)[:-1]])
        length = steps[piece] / parts[piece]
        begin = (np.arange(len(piece)) - first[piece]) * length
        x = 0.5 - 0.5 * np.cos(np.pi * np.arange(_DEGREE + 1) / _DEGREE)
        u = (begin[:, None] + length[:, None] * x).ravel()
        basis = basis_many(u)
        k = np.repeat(piece, _DEGREE + 1)
        q = np.einsum("tc,tcn->tn", basis[0], joints[k])
        v = np.einsum("tc,tcn->tn", basis[1], joints[k])
        twists = self._twists(q, v)
        used = np.column_stack(
            [
                (each**2).sum(axis=1) / cap**2
                for tip in twists
                for each, cap in ((tip[:, :3], self.linear), (tip[:, 3:], self.angular))
            ]
        )
        width = used.shape[1]
        powers = np.asarray(
            np.linalg.inv(np.vander(x, increasing=True)) @ used.reshape(len(piece), _DEGREE + 1, width), np.float64
        )
        one = np.ones(width)
        squared = 1 + limit_excess(powers, np.ones(len(piece)), 0, -np.inf * one, one).max(axis=1)
        return np.sqrt(np.maximum(np.maximum.reduceat(squared, first), 0.0))

    def _twists(self, q: Array, v: Array) -> Array:
        """(K, T, 6) linear and angular speed of each of the K tips."""
        twists = np.empty((len(self.tips), len(q), 6))
        for tip, rows in zip(self.tips, twists, strict=True):
            if tip == self.arm.tip:
                _core.tip_twists(self.arm.core_model, np.ascontiguousarray(q), np.ascontiguousarray(v), rows)
            else:
                rows[:] = [self.arm.jacobian(each, tip) @ speeds for each, speeds in zip(q, v, strict=True)]
        return twists

    def kept(self, motion: JointTrajectory) -> JointTrajectory:
        most = float(self.overshoot(motion.pieces).max())
        if most <= 1.0:
            return motion
        slower = motion.scaled(1 / most)
        return (
            slower
            if motion.slowed is None
            else replace(slower, slowed=replace(motion.slowed, factor=most * motion.slowed.factor))
        )
