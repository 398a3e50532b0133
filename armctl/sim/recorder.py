"""Recorder: the rows of a run while it lasts, and the Log they become."""

from __future__ import annotations

import math

import numpy as np

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.pose import quats_from_rotations
from armctl.core.trajectory import TickReference
from armctl.core.validation import Array
from armctl.robot.arm import Arm

MOST_TICKS = 10_000_000  # 2.8 hours at 1 ms, and 4 GB for seven joints
_RECORDED, _FOLLOWED = ("v", "tau_cmd", "tau"), ("q_ref", "v_ref", "a_ref")


class Recorder:
    """Rows of a run while it lasts. What was recorded stays readable whatever ends the run.

    Attributes:
        arm: Whose runs.
        tape: The rows one after the other as bytes, which grows faster than rows of arrays fill: in each, the whole model's nq
            positions, then v, the torque commanded and the torque done of the n joints, all float64. Only whole rows are added.
    """

    def __init__(self, arm: Arm):
        """An empty record.

        Args:
            arm: Whose runs.
        """
        self.arm, self.tape = arm, bytearray()
        self._followed: list[tuple[int, Array]] = []

    @property
    def size(self) -> int:
        """How many rows there are."""
        return len(self.tape) // (8 * self._width)

    @property
    def _width(self) -> int:
        """How many numbers a row has."""
        return self.arm.model.nq + len(_RECORDED) * self.arm.n

    def follow(self, reference: TickReference) -> None:
        """Notes what the coming rows follow.

        Args:
            reference: A row for each of them; what is not followed to its end counts as far as there are rows.
        """
        self._followed.append((self.size, np.stack(reference[: len(_FOLLOWED)])))

    def log(
        self,
        arm: Arm,
        *,
        joints: slice = slice(None),
        controller: str,
        plant: str,
        dt: float,
        motion_duration: float,
        target: Array,
        real_time_factor: float,
        failure: str,
    ) -> Log:
        """The recorded rows as a Log, with the tips by the arm's forward kinematics, which is MuJoCo's to 1e-9.

        Args:
            arm: The arm.
            joints: Which of the joints are this arm's.
            controller: As for Log, like all that follow.
            plant: In words.
            dt: s.
            motion_duration: s.
            target: (7,).
            real_time_factor: 1 is real time.
            failure: Why the run ended early.

        Returns:
            The log; its arrays are copies.
        """
        qpos, columns = self._columns()
        columns = {name: column[:, joints].copy() for name, column in columns.items()}
        (tip, rotation), (tip_ref, rotation_ref) = (arm.pinocchio_model.tips(columns[name]) for name in ("q", "q_ref"))
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
            failure=failure,
            t=dt * np.arange(self.size, dtype=np.float64),
            tip=tip,
            tip_quat=quats_from_rotations(rotation),
            tip_ref=tip_ref,
            tip_ref_quat=quats_from_rotations(rotation_ref),
            qpos=qpos.copy(),
            units=arm.units,
            **columns,
        )

    def _columns(self) -> tuple[Array, dict[str, Array]]:
        """The whole model's positions, (T, nq), and what is known of the joints, each (T, n)."""
        n, nq = self.arm.n, self.arm.model.nq
        qpos, recorded = np.split(np.frombuffer(bytes(self.tape)).reshape(-1, self._width), [nq], axis=1)
        recorded = recorded.reshape(-1, len(_RECORDED), n).swapaxes(0, 1)
        ends = [first for first, _ in self._followed[1:]] + [self.size]
        parts = [rows[:, : end - first] for (first, rows), end in zip(self._followed, ends, strict=True)]
        followed = np.concatenate([np.zeros((len(_FOLLOWED), 0, n)), *parts], axis=1)
        joints = dict(zip(_RECORDED + _FOLLOWED, [*recorded, *followed], strict=True))
        return qpos, joints | {"q": qpos[:, self.arm.qpos_adr]}


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
