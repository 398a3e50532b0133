"""LinkRecorder: the readings of a run on a robot, which become a Log."""

from dataclasses import dataclass, field

import numpy as np

from armctl.core.log import Log
from armctl.core.trajectory import TickReference
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm
from armctl.run.execution.recorder import Recorder, ReferenceTips, RunInfo
from armctl.run.links.host import Readings
from armctl.run.links.robot_mirror import RobotMirror


@dataclass
class _Segment:
    """Readings of one stream, and the ticks among them that belong to a run."""

    first: int  # the first tick
    end: int | None  # the tick after the last one; None where the arm was stopped: then until it rests
    readings: list[Readings] = field(default_factory=list)  # those of the stream, in the order of time


class LinkRecorder(Recorder):
    """Readings of a run, which become rows when the log is made: what was sent, and what was measured then."""

    def __init__(self, mirror: RobotMirror, actuation: Actuation, tips: ReferenceTips, dt: float):
        """A recorder of a robot with a tick of dt s; what the robot does not measure is as in the mirror."""
        super().__init__(mirror.model, actuation, tips)
        self._mirror = mirror
        self._dt = dt
        self._segments: list[_Segment] = []
        self._is_open = True  # until its log is made

    @property
    def times(self) -> list[np.ndarray]:
        """The times of the readings, s, part by part."""
        return [part.t for segment in self._segments for part in segment.readings]

    def begin_run(self, first: int, opens: bool) -> None:
        """The ticks of the run, or more of them, are from `first` on, of the same stream or one that `opens`."""
        if opens or not self._segments:
            self._segments.append(_Segment(first, first))

    def end_run(self, end: int | None) -> None:
        """The run ends before a tick; None: with the motion of the arm, which was stopped."""
        if self._is_open and self._segments:
            self._segments[-1].end = end

    def take(self, readings: Readings) -> None:
        if self._is_open and self._segments:
            self._segments[-1].readings.append(readings)

    def log(self, arm: Arm, run: RunInfo) -> Log:
        """The readings as a Log. A tick that was lost has the next reading, and a reference between those that were sent."""
        self._is_open = False
        for segment in self._segments:
            self._add(segment)
        return super().log(arm, run)

    def _add(self, segment: _Segment) -> None:
        parts = [part for part in segment.readings if len(part.tick)]
        if not parts:
            return
        readings = Readings(*map(np.concatenate, zip(*parts, strict=True)))
        end = segment.end
        if end is None:
            moved = np.flatnonzero(np.abs(np.diff(readings.sent, axis=0)).max(axis=1))
            end = int(readings.tick[moved[-1] + 1]) + 1 if len(moved) else segment.first + 1
        ticks = np.arange(segment.first, min(end, int(readings.tick[-1]) + 1))
        if not len(ticks):
            return
        measured = np.minimum(np.searchsorted(readings.tick, ticks), len(readings.tick) - 1)
        q_ref = np.column_stack([np.interp(ticks, readings.tick, column) for column in readings.sent.T])
        v_ref = np.diff(q_ref, axis=0, prepend=q_ref[:1]) / self._dt
        a_ref = np.diff(v_ref, axis=0, append=v_ref[-1:]) / self._dt
        rows = self.begin(TickReference(q_ref, v_ref, a_ref, v_ref, a_ref))
        rows.qpos[:] = self._mirror.data.qpos
        joint_map = self._actuation.joint_map
        rows.qpos[:, joint_map.qpos_adr] = joint_map.positions(readings.q[measured])
        rows.v[:] = readings.v[measured]
        rows.tau[:] = readings.tau[measured]
        rows.tau_cmd[:] = rows.tau
        if np.isfinite(readings.torque).any():
            # Under a law, a row has the torque of the tick that begins with it, which is measured at the end of the tick.
            rows.tau_cmd[:] = readings.torque[measured]
            rows.tau[:] = readings.tau[np.minimum(measured + 1, len(readings.tick) - 1)]
        rows.count = len(ticks)
