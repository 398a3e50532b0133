"""JointMap: the joints of an arm, and those that go along with them because they are tied to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray, frozen
from armctl.mjmodel.queries import Chain
from armctl.mjmodel.transmissions import chain_transmissions


@dataclass(frozen=True, eq=False)
class JointMap:
    """All m joints that an arm moves: the chain's, from the base to the tip, then those outside it that follow one of these.

    Their positions are `ratio @ q + offset`, of the arm's n. In a plain chain no joint follows another, and m = n.

    Attributes:
        joints: Their numbers.
        length: How many are in the chain.
        leaders: Which of them the arm's n are.
        ratio: (m, n).
        offset: (m,) rad.
        qpos_adr: (m,) where they are in `MjData.qpos`.
        dof_adr: (m,) where they are in `MjData.qvel`.
    """

    joints: Chain
    length: int
    leaders: IntArray
    ratio: Array
    offset: Array
    qpos_adr: IntArray
    dof_adr: IntArray

    @property
    def is_plain(self) -> bool:
        """Whether no joint follows another."""
        return len(self.leaders) == len(self.joints)

    def positions(self, q: Array) -> Array:
        """Where all of them are.

        Args:
            q: (..., n) rad.

        Returns:
            (..., m) rad.
        """
        return q if self.is_plain else q @ self.ratio.T + self.offset

    def speeds(self, v: Array) -> Array:
        """How fast all of them are.

        Args:
            v: (..., n) rad/s.

        Returns:
            (..., m) rad/s.
        """
        return v if self.is_plain else v @ self.ratio.T

    def reduced(self, x: Array) -> Array:
        """Forces, or gradients, on a whole model's joints as those on the arm's, by virtual work.

        Args:
            x: (..., nv).

        Returns:
            (..., n).
        """
        x = x[..., self.dof_adr]
        return x if self.is_plain else x @ self.ratio

    def reduced_matrix(self, X: Array) -> Array:
        """A mass matrix, or a quadratic form, on a whole model's joints as that on the arm's.

        Args:
            X: (nv, nv).

        Returns:
            (n, n).
        """
        X = X[self.dof_adr[:, None], self.dof_adr]
        return X if self.is_plain else self.ratio.T @ X @ self.ratio


def joint_map_of(model: mujoco.MjModel, chain: Chain) -> JointMap:
    """The joint_map of a chain.

    Args:
        model: The compiled model, with whatever drives the chain.
        chain: Its joints, from the base to the tip.

    Returns:
        The joint_map.

    Raises:
        ModelError: A joint of it cannot be driven by one actuator.
    """
    drives = chain_transmissions(model, chain)
    tied = sorted({joint for drive in drives for joint in drive.ties} - set(chain))
    joints = (*chain, *tied)
    ratio, offset = np.zeros((len(joints), len(drives))), np.zeros(len(joints))
    for i, drive in enumerate(drives):
        for joint, tie in drive.ties.items():
            ratio[joints.index(joint), i], offset[joints.index(joint)] = tie.ratio, tie.offset
    index = list(joints)
    return JointMap(
        joints,
        len(chain),
        frozen(np.array([joints.index(drive.joint) for drive in drives])),
        frozen(ratio),
        frozen(offset),
        frozen(model.jnt_qposadr[index].astype(int)),
        frozen(model.jnt_dofadr[index].astype(int)),
    )


def joined(linkages: Sequence[JointMap]) -> JointMap:
    """Several linkages as one, none of which moves a joint of another.

    Args:
        linkages: The linkages.

    Returns:
        All of them, in order; its chain is the first one's.
    """
    ratio = np.zeros(np.sum([one.ratio.shape for one in linkages], axis=0))
    leaders, row, column = [], 0, 0
    for one in linkages:
        rows, columns = one.ratio.shape
        ratio[row : row + rows, column : column + columns] = one.ratio
        leaders.append(one.leaders + row)
        row, column = row + rows, column + columns
    parts = {
        name: frozen(np.concatenate([getattr(one, name) for one in linkages])) for name in ("offset", "qpos_adr", "dof_adr")
    }
    joints = tuple(joint for one in linkages for joint in one.joints)
    return JointMap(joints, linkages[0].length, frozen(np.concatenate(leaders)), frozen(ratio), **parts)
