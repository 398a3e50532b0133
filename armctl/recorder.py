"""Recorder: the rows of a run while it lasts, and the Log they become."""

from __future__ import annotations

import math

import numpy as np

from armctl.arm import Arm
from armctl.arrays import Array
from armctl.errors import InputError
from armctl.log import Log
from armctl.pose import quats_from_rotations
from armctl.trajectory import TickReference

MOST_TICKS = 10_000_000  # 2.8 hours at 1 ms, and 4 GB for seven joints


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
        for name in self._COLUMNS:
            old = getattr(self, name)
            new = np.full((max(capacity, 2 * len(old)), old.shape[1]), np.nan)
            new[: len(old)] = old
            setattr(self, name, new)

    def rows(self, reference: TickReference) -> tuple[list[Array], list[Array], list[Array], list[Array]]:
        """Makes room for a reference's ticks and notes it.

        Args:
            reference: What will be followed.

        Returns:
            The rows to write q, v, the torque commanded and the torque done into, tick by tick; `size` counts what was written.
        """
        first, last = self.size, self.size + len(reference.q)
        self.reserve(last)
        self.q_ref[first:last], self.v_ref[first:last], self.a_ref[first:last] = reference[:3]
        q, v, tau_cmd, tau = (list(column[first:last]) for column in (self.q, self.v, self.tau_cmd, self.tau))
        return q, v, tau_cmd, tau

    def part(self, joints: slice) -> Recorder:
        """The rows of some of the joints.

        Args:
            joints: Which.

        Returns:
            A record that shares its rows with this one.
        """
        part = Recorder(joints.stop - joints.start, 0)
        for name in self._COLUMNS:
            setattr(part, name, getattr(self, name)[:, joints])
        part.size = self.size
        return part

    def log(
        self,
        arm: Arm,
        *,
        controller: str,
        plant: str,
        dt: float,
        motion_duration: float,
        target: Array,
        real_time_factor: float,
        end: str,
    ) -> Log:
        """The recorded rows as a Log, with the tips by the arm's forward kinematics, which is MuJoCo's to 1e-9.

        Args:
            arm: The arm.
            controller: As for Log, like all that follow.
            plant: In words.
            dt: s.
            motion_duration: s.
            target: (7,).
            real_time_factor: 1 is real time.
            end: Why the run ended early.

        Returns:
            The log; its arrays are copies.
        """
        columns = {name: getattr(self, name)[: self.size].copy() for name in self._COLUMNS}
        (tip, rotation), (tip_ref, rotation_ref) = (arm.rigid_body.tips(columns[name]) for name in ("q", "q_ref"))
        return Log(
            robot=arm.name,
            joint_names=arm.joint_names,
            tau_max=np.array(arm.limits.tau_max),
            controller=controller,
            plant=plant,
            dt=dt,
            motion_duration=motion_duration,
            target=np.array(target),
            real_time_factor=real_time_factor,
            end=end,
            t=dt * np.arange(self.size, dtype=np.float64),
            tip=tip,
            tip_quat=quats_from_rotations(rotation),
            tip_ref=tip_ref,
            tip_ref_quat=quats_from_rotations(rotation_ref),
            **columns,
        )


def ticks_for(duration: float, dt: float) -> int:
    """How many ticks show a motion from its first instant to its last.

    Args:
        duration: s.
        dt: s, the tick.

    Returns:
        The number.

    Raises:
        InputError: They are too many for a log.
    """
    ticks = duration / dt
    if ticks > MOST_TICKS:
        raise InputError(f"duration: {duration:g} s are {ticks:.3g} ticks of {dt:g} s, at most {MOST_TICKS:,} fit into a log")
    return math.ceil(ticks - 1e-9) + 1
