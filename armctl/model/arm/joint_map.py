"""JointMap: the joints of an arm, and those that go along with them because they are tied to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray, frozen
from armctl.model.mjmodel.queries import Joints
from armctl.model.mjmodel.transmissions import Transmission


@dataclass(frozen=True, eq=False)
class JointMap:
    """All m joints that an arm moves: the chain's, from the base to the tip, then those outside it that follow one of these.

    Their positions are `ratio @ q + offset`, of the arm's n. In a plain chain no joint follows another, and m = n.
    """

    joints: Joints  # their numbers
    leaders: IntArray  # which of them the arm's n are
    ratio: Array  # (m, n)
    offset: Array  # (m,) rad
    qpos_adr: IntArray  # (m,) where they are in `MjData.qpos`
    dof_adr: IntArray  # (m,) where they are in `MjData.qvel`

    @property
    def is_plain(self) -> bool:
        return len(self.leaders) == len(self.joints)

    @classmethod
    def from_transmissions(cls, model: mujoco.MjModel, chain: Joints, transmissions: Sequence[Transmission]) -> JointMap:
        """The joint map of a chain, whose joints, from the base to the tip, come first in it."""
        coupled = sorted({joint for each in transmissions for joint in each.coupled} - set(chain))
        joints = (*chain, *coupled)
        row_of = {joint: row for row, joint in enumerate(joints)}
        ratio = np.zeros((len(joints), len(transmissions)))
        offset = np.zeros(len(joints))
        for column, transmission in enumerate(transmissions):
            for joint, mimic in transmission.coupled.items():
                ratio[row_of[joint], column] = mimic.ratio
                offset[row_of[joint]] = mimic.offset
        index = list(joints)
        return cls(
            joints=joints,
            leaders=frozen(np.array([row_of[transmission.joint] for transmission in transmissions])),
            ratio=frozen(ratio),
            offset=frozen(offset),
            qpos_adr=frozen(model.jnt_qposadr[index].astype(np.int64)),
            dof_adr=frozen(model.jnt_dofadr[index].astype(np.int64)),
        )

    def set_positions(self, qpos: Array, q: Array) -> None:
        """Writes the positions of all m joints into a whole model's `qpos`, for q (n,)."""
        qpos[self.qpos_adr] = self.positions(q)

    def set_speeds(self, qvel: Array, v: Array) -> None:
        """Writes the speeds of all m joints into a whole model's `qvel`, for v (n,)."""
        qvel[self.dof_adr] = self.speeds(v)

    def positions(self, q: Array) -> Array:
        """The positions (..., m) of all of them, rad, for q (..., n)."""
        return q if self.is_plain else q @ self.ratio.T + self.offset

    def speeds(self, v: Array) -> Array:
        """The speeds (..., m) of all of them, rad/s, for v (..., n)."""
        return v if self.is_plain else v @ self.ratio.T

    def reduced(self, x: Array) -> Array:
        """Forces, or gradients, (..., nv) on a whole model's joints as those (..., n) on the arm's, by virtual work."""
        x = x[..., self.dof_adr]
        return x if self.is_plain else x @ self.ratio

    def reduced_matrix(self, X: Array) -> Array:
        """A mass matrix, or a quadratic form, (nv, nv) on a whole model's joints as that (n, n) on the arm's."""
        X = X[self.dof_adr[:, None], self.dof_adr]
        return X if self.is_plain else self.ratio.T @ X @ self.ratio
