"""A log as a recording for the rerun viewer: curves of all joints, and the path of the tip in 3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from armctl.core.errors import NotInstalledError
from armctl.core.log_files import PER_JOINT, columns, flat


def save_rerun(path: Path, log: Any) -> None:
    """Writes an .rrd file: an entity per joint quantity such as "q/joint1", and "tip" with its pose and paths."""
    try:
        import rerun
    except ImportError:
        raise NotInstalledError.of_extra("to_rerun needs rerun-sdk", "rerun") from None
    recording = rerun.RecordingStream("armctl", recording_id=f"{log.robot} {log.controller}")
    recording.save(path)
    time = [rerun.TimeColumn("time", duration=log.t)]
    layout = [column for column in columns(log.joint_names, log.units, {}) if column.array in PER_JOINT]
    with recording:
        for name, values in flat(vars(log), layout).items():
            recording.send_columns(name, indexes=time, columns=rerun.Scalars.columns(scalars=values))
        quaternions = log.tip_quat[:, [1, 2, 3, 0]]  # rerun takes xyzw
        recording.send_columns(
            "tip", indexes=time, columns=rerun.Transform3D.columns(translation=log.tip, quaternion=quaternions)
        )
        recording.log("tip_path", rerun.LineStrips3D([log.tip]), static=True)
        if not log.is_open_loop:
            recording.log("tip_ref_path", rerun.LineStrips3D([log.tip_ref]), static=True)
    recording.flush()
    recording.disconnect()
