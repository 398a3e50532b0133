"""JointMap: the joints of an arm, and those that go along with them because they are tied to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.model.arm.loop_closure import LoopClosure, build_loop_closure
from armctl.model.mjmodel.closed_loops import LoopGroup
from armctl.model.mjmodel.queries import Joints
from armctl.model.mjmodel.transmissions import Transmission


@dataclass(frozen=True, eq=False)
class JointMap:
    """All m joints that an arm moves: the chain's, from the base to the tip, then those outside it that move with these.

    Their positions are `ratio @ q + offset`, of the arm's n. In a plain chain no joint follows another, and m = n. The passive
    joints of closed loops follow by no fixed ratio: their rows in `fixed_ratio` are zero, and `closure` has what moves them.
    """

    joints: Joints  # their numbers
    leaders: IntArray  # which of them the arm's n are
    fixed_ratio: Array  # (m, n)
    offset: Array  # (m,) rad
    qpos_adr: IntArray  # (m,) where they are in `MjData.qpos`
    dof_adr: IntArray  # (m,) where they are in `MjData.qvel`
    closure: LoopClosure | None = None  # of closed loops

    @property
    def is_plain(self) -> bool:
        return len(self.leaders) == len(self.joints)

    @property
    def ratio(self) -> Array:
        """(m, n) the speeds of all joints per speed of the arm's; ModelError with closed loops, where they vary."""
        self.require_no_loops()
        return self.fixed_ratio

    def require_no_loops(self) -> None:
        """Raises ModelError for an arm with closed loops, for what does not know them."""
        if self.closure is not None:
            raise ModelError(self.closure.refusal)

    @property
    def moved(self) -> BoolArray:
        """(m, n) which joints each of the arm's n moves."""
        return self.fixed_ratio != 0.0 if self.closure is None else self.closure.moved

    @property
    def moving_rows(self) -> IntArray:
        """Which of the joints carry bodies of their own accord: the arm's n, and the passive ones of loops."""
        return self.leaders if self.closure is None else np.concatenate([self.leaders, self.closure.passive])

    @classmethod
    def from_transmissions(
        cls,
        model: mujoco.MjModel,
        chain: Joints,
        transmissions: Sequence[Transmission],
        loops: Sequence[LoopGroup] = (),
        qpos: Array | None = None,
    ) -> JointMap:
        """The joint map of a chain, whose joints, from the base to the tip, come first in it.

        `loops` are those that the chain moves; their branch is that on which `qpos` (nq,) closes them.
        """
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
        start = model.qpos0 if qpos is None else qpos
        return cls(
            joints=joints,
            leaders=frozen(np.array([row_of[transmission.joint] for transmission in transmissions])),
            fixed_ratio=frozen(ratio),
            offset=frozen(offset),
            qpos_adr=frozen(model.jnt_qposadr[index].astype(np.int64)),
            dof_adr=frozen(model.jnt_dofadr[index].astype(np.int64)),
            closure=build_loop_closure(model, joints, ratio, offset, loops, start) if loops else None,
        )

    def set_positions(self, qpos: Array, q: Array) -> None:
        """Writes the positions of all m joints into a whole model's `qpos`, for q (n,)."""
        qpos[self.qpos_adr] = self.positions(q)

    def set_speeds(self, qvel: Array, v: Array, q: Array) -> None:
        """Writes the speeds of all m joints into a whole model's `qvel`, for v (n,) at q (n,)."""
        qvel[self.dof_adr] = self.speeds(v, q)

    def positions(self, q: Array) -> Array:
        """The positions (..., m) of all of them, rad, for q (..., n). LimitError where closed loops cannot be closed."""
        if self.is_plain:
            return q
        return q @ self.ratio.T + self.offset if self.closure is None else self.closure.at(q)[0]

    def ratio_at(self, q: Array | None) -> Array:
        """(m, n) the speeds of all joints per speed of the arm's at q (n,), which matters with closed loops only."""
        if self.closure is None:
            return self.fixed_ratio
        return self.ratio if q is None else self.closure.at(q)[1]

    def speeds(self, v: Array, q: Array | None = None) -> Array:
        """The speeds (..., m) of all of them, rad/s, for v (..., n); q (n,) matters with closed loops only."""
        return v if self.is_plain else v @ self.ratio_at(q).T

    def accelerations(self, a: Array, q: Array, v: Array) -> Array:
        """The accelerations (m,) of all of them, rad/s^2, for a (n,) at q and v (n,)."""
        all_a = self.speeds(a, q)
        return all_a if self.closure is None else all_a + self.closure.acceleration(q, v)

    def reduced(self, x: Array, q: Array | None = None) -> Array:
        """Forces, or gradients, (..., nv) on a whole model's joints as those (..., n) on the arm's, by virtual work.

        q (n,), where the joints are, matters with closed loops only.
        """
        x = x[..., self.dof_adr]
        return x if self.is_plain else x @ self.ratio_at(q)

    def reduced_matrix(self, X: Array, q: Array | None = None) -> Array:
        """A mass matrix, or a quadratic form, (nv, nv) on a whole model's joints as that (n, n) on the arm's; q as above."""
        X = X[self.dof_adr[:, None], self.dof_adr]
        if self.is_plain:
            return X
        ratio = self.ratio_at(q)
        return ratio.T @ X @ ratio
