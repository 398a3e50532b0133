"""Recorder: the rows of a run while it lasts, and the Log they become."""

from __future__ import annotations

import numpy as np

from armctl.arm import Arm
from armctl.arrays import Array
from armctl.log import Log
from armctl.pose import Pose, quats_from_rotations


class Recorder:
    """Rows of a run while it lasts. What was recorded stays readable whatever ends the run.

    Attributes:
        size: How many rows there are.
        q: Row k is q at tick k; so for the others. All have the same capacity, which `reserve` enlarges.
    """

    _COLUMNS = ("q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_cmd")

    def __init__(self, n: int, capacity: int = 1024):
        """An empty record.

        Args:
            n: How many joints.
            capacity: How many rows to make room for.
        """
        self.size = 0
        self.q, self.v, self.q_ref, self.v_ref, self.a_ref, self.tau, self.tau_cmd = (
            np.full((capacity, n), np.nan) for _ in self._COLUMNS
        )
        self.body_position, self.body_quat = np.full((capacity, 3), np.nan), np.full((capacity, 4), np.nan)

    @property
    def capacity(self) -> int:
        """For how many rows there is room."""
        return len(self.q)

    def reserve(self, capacity: int) -> None:
        """Makes room.

        Args:
            capacity: For how many rows in all; at least doubles the room where it is too small.
        """
        if capacity <= self.capacity:
            return
        for name in (*self._COLUMNS, "body_position", "body_quat"):
            old = getattr(self, name)
            new = np.full((max(capacity, 2 * len(old)), old.shape[1]), np.nan)
            new[: len(old)] = old
            setattr(self, name, new)

    def log(
        self,
        arm: Arm,
        *,
        controller: str,
        dt: float,
        motion_duration: float,
        target: Array,
        real_time_factor: float,
        end: str,
    ) -> Log:
        """The recorded rows as a Log. The tip is the simulator's own; the reference's tip is the arm's forward kinematics.

        Args:
            arm: The arm.
            controller: As for Log, like all that follow.
            dt: s.
            motion_duration: s.
            target: (7,).
            real_time_factor: 1 is real time.
            end: Why the run ended early.

        Returns:
            The log; its arrays are copies.
        """
        columns = {name: getattr(self, name)[: self.size].copy() for name in self._COLUMNS}
        tip, tip_quat = _tips(arm.T_body_tip, self.body_position[: self.size], self.body_quat[: self.size])
        tip_ref, rotation_ref = arm.rigid_body.tips(columns["q_ref"])
        return Log(
            robot=arm.name,
            joint_names=arm.joint_names,
            tau_max=np.array(arm.limits.tau_max),
            controller=controller,
            dt=dt,
            motion_duration=motion_duration,
            target=np.array(target),
            real_time_factor=real_time_factor,
            end=end,
            t=dt * np.arange(self.size, dtype=np.float64),
            tip=tip,
            tip_quat=tip_quat,
            tip_ref=tip_ref,
            tip_ref_quat=quats_from_rotations(rotation_ref),
            **columns,
        )


def _tips(T_body_tip: Pose, position: Array, quat: Array) -> tuple[Array, Array]:
    """The tips (T, 3), (T, 4) from the poses (T, 3), (T, 4) of the body that carries the tip."""
    w, xyz, offset = quat[:, :1], quat[:, 1:], T_body_tip.position
    turned = offset + 2 * np.cross(xyz, np.cross(xyz, offset) + w * offset)
    bw, bx, by, bz = T_body_tip.quat
    times_offset = np.array([[bw, -bx, -by, -bz], [bx, bw, bz, -by], [by, -bz, bw, bx], [bz, by, -bx, bw]])
    product = quat @ times_offset.T
    return position + turned, np.where(product[:, :1] < 0, -product, product)
