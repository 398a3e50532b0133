"""Log: every tick of a run."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core import log_columns, log_files
from armctl.core.atomic import atomic_path, file_path
from armctl.core.errors import ArmctlError, InputError
from armctl.core.file_reading import reading
from armctl.core.log_columns import POSE_AXES, QUANTITIES, REFERENCES, STATES
from armctl.core.other_names import with_hints
from armctl.core.validation import Array, choice, flag, frozen, instance, matrix, number, shown, words

if TYPE_CHECKING:
    from armctl.core.log_csv import Columns, Units

_MAX_STATE = 1e20  # rad, m, rad/s, m/s; MuJoCo itself stops at 1e10
_MIN_ROWS = 2  # of a recording, for its velocity
_QUATERNION_TOLERANCE = 1e-3  # of the norm of a quaternion in a file
_OTHER_TIPS = ("other_tips", "other_tips_ref", "other_targets")


class LogSource(StrEnum):
    """Where a log comes from."""

    SIMULATION = "simulation"
    """A simulation of armctl: positions and torques are of the same instant."""
    ROBOT = "robot"
    """`armctl.Robot`: what the robot measured while armctl commanded it."""
    RECORDING = "recording"
    """A file or arrays of another program."""


class LogTorques(StrEnum):
    """What the torques of a log are."""

    BOTH = "both"
    """`tau` is what the motors gave, `tau_cmd` what the controller commanded."""
    MEASURED = "measured"
    """Both are what the motors gave: commands were not recorded."""
    COMMANDED = "commanded"
    """Both are what was commanded: motors were not measured."""


class Contact(NamedTuple):
    """Two bodies that touched during a run, at least one of them a moving body of the arm.

    Attributes:
        body: The body of the arm.
        other: The body that it touched; the geom, if it belongs to the world.
        start: s, when they touched first.
        duration: s, how long they touched in total.
        on_tool: Whether one of them is behind the last joint to the (first) tip, like a tool: a flange sensor measures no
            others.
    """

    body: str
    other: str
    start: float
    duration: float
    on_tool: bool = True

    def __str__(self) -> str:
        return f"{self.body} touched {self.other} for {self.duration:.3g} s"


class TipLog(NamedTuple):
    """What a log has of one tip.

    Attributes:
        position: (T, 3) m.
        quat: (T, 4) wxyz.
        position_ref: (T, 3) m, of the reference; NaN in an open-loop run.
        quat_ref: (T, 4) wxyz.
        target: (7,) where the tip should end, m and wxyz; NaN for what is free.
    """

    position: Array
    quat: Array
    position_ref: Array
    quat_ref: Array
    target: Array


@dataclass(frozen=True, eq=False)
class Log:
    """The record of a run, tick by tick, in read-only arrays. Row k holds the state at t[k] and the torques of that tick.

    Attributes:
        dt: s, the tick.
        tau_max: (n,) N m.
        motion_duration: s, until the reference is at rest; the log may continue.
        target: (7,) where the tip should end, m and wxyz; NaN for what is free. After `Simulation.follow` the target at the end
            of the run.
        real_time_factor: Simulated time divided by computing time.
        failure: The reason if the run ended early; empty if it did not.
        t: (T,) s.
        q: (T, n) rad.
        v: (T, n) rad/s.
        q_ref: (T, n) rad; NaN in an open-loop run, as are v_ref, a_ref and the reference's tip.
        v_ref: (T, n) rad/s.
        a_ref: (T, n) rad/s^2.
        tau: (T, n) N m, the torque of the motors; NaN from a robot that does not measure it.
        tau_cmd: (T, n) N m, the torque that the controller commanded, before the torque limits.
        tip: (T, 3) m.
        tip_quat: (T, 4) wxyz.
        tip_ref: (T, 3) m.
        tip_ref_quat: (T, 4) wxyz.
        plant: The differences of the plant from the model, in words.
        source: Where the log comes from: a simulation, an `armctl.Robot`, or a recording of another program.
        continuous: Whether the arm moved almost continuously between ticks; False for the steps of MuJoCo, one for each tick.
        torques: What `tau` and `tau_cmd` are, where they are known.
        qpos: (T, nq) the positions of the whole model as in MjData.qpos, with grippers and loose objects, for films.
        units: The unit of each joint, "rad" or "m"; rad for all joints if left out.
        contacts: What the arm touched, in the order of time; empty if it touched nothing.
        wrench: (T, 6) N and N m, the true wrench of the environment on the tip: force first, world axes, at the tip; NaN at
            ticks at which the controller did not measure it, (0, 6) if it never did.
        tip_names: The names of all tips of an arm with several, of which `tip` and `target` are the first one's; empty for one.
        other_tips: (T, 7 K), position, m, and quaternion of each of the K others; (0, 0) for one tip. `tips` has them by name.
        other_tips_ref: (T, 7 K), those of the reference.
        other_targets: (7 K,), where they should end; NaN for what is free.
    """

    robot: str
    controller: str
    joint_names: tuple[str, ...]
    dt: float
    tau_max: Array
    motion_duration: float
    target: Array
    real_time_factor: float
    failure: str
    t: Array
    q: Array
    v: Array
    q_ref: Array
    v_ref: Array
    a_ref: Array
    tau: Array
    tau_cmd: Array
    tip: Array
    tip_quat: Array
    tip_ref: Array
    tip_ref_quat: Array
    plant: str = "nominal"
    source: LogSource = LogSource.SIMULATION
    continuous: bool = False
    torques: LogTorques = LogTorques.BOTH
    qpos: Array = field(default_factory=lambda: np.zeros((0, 0)))
    units: tuple[str, ...] = ()
    contacts: tuple[Contact, ...] = ()
    wrench: Array = field(default_factory=lambda: np.zeros((0, 6)))
    tip_names: tuple[str, ...] = ()
    other_tips: Array = field(default_factory=lambda: np.zeros((0, 0)))
    other_tips_ref: Array = field(default_factory=lambda: np.zeros((0, 0)))
    other_targets: Array = field(default_factory=lambda: np.zeros(0))

    if not TYPE_CHECKING:
        __getattr__ = with_hints(
            {
                "to_dataframe": "pandas.DataFrame(log.to_dict())",
                "to_pandas": "pandas.DataFrame(log.to_dict())",
                "to_csv": "log.save('run.csv')",
                "plot": "armctl.Report.from_log(log).plot()",
                "qpos": "log.q",
                "qvel": "log.v",
            }
        )

    def __post_init__(self) -> None:
        if not isinstance(self.source, LogSource):
            object.__setattr__(self, "source", LogSource(choice("source", self.source, LogSource)))
        if not isinstance(self.torques, LogTorques):
            object.__setattr__(self, "torques", LogTorques(choice("torques", self.torques, LogTorques)))
        object.__setattr__(self, "joint_names", words("joint_names", self.joint_names))
        units = words("units", self.units) or ("rad",) * len(self.joint_names)
        if len(units) != len(self.joint_names) or not set(units) <= {"rad", "m"}:
            raise InputError(f"units: expected 'rad' or 'm' for each of {len(self.joint_names)} joints, got {shown(units)}")
        object.__setattr__(self, "units", units)
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                frozen(value)

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Log({self.robot!r}, {self.controller!r}, {len(self)} ticks of {1e3 * self.dt:g} ms)"

    @property
    def tips(self) -> dict[str, TipLog]:
        """All tips by name; the tip of an arm with one is "tip"."""
        names = self.tip_names or ("tip",)
        found = {names[0]: TipLog(self.tip, self.tip_quat, self.tip_ref, self.tip_ref_quat, self.target)}
        width = len(POSE_AXES)
        for k, name in enumerate(names[1:]):
            own = slice(width * k, width * (k + 1))
            pose = self.other_tips[:, own]
            pose_ref = self.other_tips_ref[:, own]
            found[name] = TipLog(pose[:, :3], pose[:, 3:], pose_ref[:, :3], pose_ref[:, 3:], self.other_targets[own])
        return found

    @property
    def is_open_loop(self) -> bool:
        """Whether there was no reference to follow."""
        return bool(np.isnan(self.q_ref).all())

    @property
    def unmeasured_bodies(self) -> tuple[str, ...]:
        """The bodies that touched something in front of a flange sensor; empty if the controller did not measure wrenches."""
        if not len(self.wrench):
            return ()
        return tuple(dict.fromkeys(contact.body for contact in self.contacts if not contact.on_tool))

    def to_dict(self) -> dict[str, Array]:
        """The arrays over time as a flat table, for `pandas.DataFrame(log.to_dict())`.

        Returns:
            Vectors (T,) by name: "t", "q/joint1", ..., "tip/x", ..., "other_tips/NAME/x"; units as those of the attributes.
        """
        widths = log_columns.widths(vars(self))
        return log_columns.flat(vars(self), log_columns.columns(self.joint_names, self.units, widths, self.tip_names))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the log. The extension selects the format. `load` reads .npz, .parquet and .csv, which contain the whole log.

        Parquet has one column per quantity and joint, such as "q/joint1", with its unit in the metadata of the column. CSV has
        the same columns after one line with everything else: `pandas.read_csv(path, comment="#")`. MCAP has ROS 2 messages,
        for `ros2 bag` and Foxglove: `sensor_msgs/JointState` on /joint_states and /joint_references, poses on /tip and
        /tip_reference, of further tips on /tips/NAME and /tip_references/NAME.

        The file is written atomically: whatever interrupts the writing, the old file or the new one is there, complete.

        Args:
            path: The file; its folder is made.

        Raises:
            InputError: Another file extension.
            NotInstalledError: Parquet needs the extra `study`, MCAP the extra `ros`.
            ArmctlError: The file cannot be written.
        """
        path = file_path("path", path, (*log_files.WRITERS, ".mcap"))
        with atomic_path(path) as temporary:
            if path.suffix == ".mcap":
                from armctl.core.log_mcap import save_mcap

                save_mcap(temporary, self)
            else:
                left_out = () if self.tip_names else ("tip_names", *_OTHER_TIPS)
                everything = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}
                arrays = {k: x for k, x in everything.items() if isinstance(x, np.ndarray)}
                facts = {k: x for k, x in everything.items() if k not in arrays}
                log_files.save(temporary, log_files.LogContent(arrays, facts))
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Log:
        """Reads a log that `save` wrote as .npz, .parquet or .csv, and checks it: shapes, finite numbers, increasing time.

        Raises:
            InputError: There is no such file, or it holds no log.
            NotInstalledError: Parquet needs the extra `study`.
        """
        path = file_path("path", path)
        with reading(path, "no log that armctl wrote"):
            return cls(**_checked(*log_files.load(path)))

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        columns: Columns | None = None,
        *,
        units: Units | None = None,
        joint_names: Sequence[str] | None = None,
        torques: LogTorques | str = LogTorques.MEASURED,
        robot: str = "",
    ) -> Log:
        """Reads the recording of a real robot: time, joint positions and joint torques.

        Time steps may be uneven, and rows may repeat: repeated rows are left out, and the others are interpolated on a grid of
        the median time step. The velocity follows from the positions by a zero-phase filter; its cut-off is chosen from the
        spectrum of the positions, and `plant` reports it. Columns of velocities are not read: robots filter and delay them.

        Args:
            path: The file: a first line with names, then numbers; separated by commas, semicolons or tabs.
            columns: The columns of "t", "q" and "tau": a name, a list of names from the base to the tip, or a name in which "*"
                stands for the number of the joint. The default is `{"t": "t", "q": "q*", "tau": "tau*"}`.
            units: The units of "t" (s, ms, us, ns), "q" (rad, deg, m, mm) and "tau" (N m, mN m, N, N mm); a list for "q" and
                "tau" if the joints have different units. The default is s, rad and N m.
            joint_names: The n joints, such as `arm.joint_names`; the names of the columns of q if left out.
            torques: "measured" by the motors, or "commanded".

        Returns:
            The log. What the file does not contain (references, the tip) is NaN; torque limits are infinite.

        Raises:
            InputError: The file cannot be read, a column or unit is unknown, or the numbers are no recording.
        """
        instance("robot", robot, str, "give a name")
        kind = LogTorques(choice("torques", torques, (LogTorques.MEASURED, LogTorques.COMMANDED)))
        from armctl.core.log_csv import read_recording

        recording = read_recording(path, columns, units)
        names = recording.joint_names if joint_names is None else words("joint_names", joint_names)
        if len(names) != len(recording.joint_names):
            raise InputError(f"{path!s:.80}: {len(recording.joint_names)} joints are recorded, {len(names)} are named")
        found = {"q": recording.q, "v": recording.v, "tau": recording.tau, "tau_cmd": recording.tau}
        facts = _Recorded(names, recording.units, recording.dt, recording.t, str(recording), kind)
        return cls._recorded(robot, facts, **found)

    @classmethod
    def from_positions(
        cls,
        dt: float,
        q: ArrayLike,
        q_ref: ArrayLike,
        *,
        joint_names: Sequence[str],
        units: Sequence[str] = (),
        robot: str = "",
    ) -> Log:
        """A log of commanded and measured positions, as of an arm with position servos, for `identify_servo`.

        Args:
            dt: s between two samples.
            q: (T, n) rad, measured.
            q_ref: (T, n) rad, the command that is given when a position is measured.
            joint_names: The n joints, such as `arm.joint_names`.
            units: The unit of each joint, "rad" or "m"; rad for all joints if left out.

        Returns:
            The log. Velocities are differences of positions; torques and the tip are NaN.

        Raises:
            InputError: The interval is not above 0, or the positions have different shapes or are not finite.
        """
        instance("robot", robot, str, "give a name")
        names = words("joint_names", joint_names)
        measured = matrix("q", q, len(names))
        commanded = matrix("q_ref", q_ref, len(names))
        if measured.shape != commanded.shape:
            raise InputError(f"q_ref: expected the shape of q, {measured.shape}, got {commanded.shape}")
        if len(measured) < _MIN_ROWS:
            raise InputError(f"q: expected at least {_MIN_ROWS} samples, got {len(measured)}")
        dt = number("dt", dt, 1e-6, 10.0)
        t = np.asarray(dt * np.arange(len(measured)), np.float64)
        found = {"q": measured, "v": np.gradient(measured, dt, axis=0), "q_ref": commanded}
        facts = _Recorded(names, words("units", units), dt, t, "a recording of positions", LogTorques.MEASURED)
        return cls._recorded(robot, facts, **found)

    @classmethod
    def _recorded(cls, robot: str, recording: _Recorded, **known: Array) -> Log:
        """A log of a real robot, whose quantities that are not known are NaN."""
        n = len(recording.joint_names)
        recorded = {name: each for name, each in QUANTITIES.items() if not each.is_optional}
        widths = {name: n if each.is_per_joint else len(each.axes) for name, each in recorded.items()}
        unknown = {name: np.full((len(recording.t), width), np.nan) for name, width in widths.items()}
        return cls(
            robot=robot,
            controller="recorded",
            joint_names=recording.joint_names,
            dt=recording.dt,
            tau_max=np.full(n, np.inf),
            motion_duration=float(recording.t[-1]),
            target=np.full(7, np.nan),
            real_time_factor=1.0,
            failure="",
            t=recording.t,
            plant=recording.description,
            source=LogSource.RECORDING,
            continuous=True,
            torques=recording.torques,
            units=recording.units,
            **{**unknown, **known},
        )


class _Recorded(NamedTuple):
    """What a recording of another program says of itself; the names are those of `Log`."""

    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    dt: float
    t: Array
    description: str
    torques: LogTorques


def _of_earlier_versions(meta: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a log says of itself, added to a file of an earlier version, which said it only in texts."""
    if "source" in meta:
        return meta
    plant = str(meta["plant"])
    if meta["controller"] == "recorded":
        return {**meta, "source": LogSource.RECORDING, "continuous": True, "torques": LogTorques.MEASURED}
    if plant.startswith("robot: "):
        return {**meta, "source": LogSource.ROBOT, "continuous": True, "torques": LogTorques.MEASURED}
    return {**meta, "source": LogSource.SIMULATION, "continuous": "continuous" in plant, "torques": LogTorques.BOTH}


def _checked(arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a log from a file; an InputError says which of them cannot be."""
    meta = _of_earlier_versions(meta)
    tip_names = words("tip_names", meta.get("tip_names", ()))
    if not tip_names:
        arrays = {name: array for name, array in arrays.items() if name not in _OTHER_TIPS}
    needed = {f.name for f in fields(Log)} - {"contacts", "wrench", "tip_names"} - (set() if tip_names else {*_OTHER_TIPS})
    missing = needed - {*arrays, *meta}
    unknown = ({*arrays, *meta} - {f.name for f in fields(Log)}) | (set(arrays) & set(meta))
    if missing or unknown:
        raise InputError(f"its fields do not fit: missing {shown(sorted(missing))}, unknown {shown(sorted(unknown))}")
    joint_names = words("joint_names", meta["joint_names"])
    if not joint_names:
        raise InputError("joint_names: there is none")
    for name in ("robot", "controller", "plant", "failure"):
        instance(name, meta[name], str, "give a name")
    dt = number("dt", meta["dt"], 1e-12, 1e4)
    _check_arrays(arrays, len(joint_names), len(tip_names), dt)
    factor = meta["real_time_factor"]
    facts = {
        "joint_names": joint_names,
        "tip_names": tip_names,
        "dt": dt,
        "motion_duration": number("motion_duration", meta["motion_duration"], 0.0),
        "real_time_factor": factor if factor in (math.inf, -math.inf) else number("real_time_factor", factor),
        "continuous": flag("continuous", meta["continuous"]),
        "contacts": tuple(_contact(each) for each in meta.get("contacts", ())),
    }
    return {**arrays, **meta, **facts}


def _check_arrays(arrays: Mapping[str, Array], n: int, tips: int, dt: float) -> None:
    ticks = len(arrays["t"]) if np.ndim(arrays["t"]) == 1 else -1
    nq = arrays["qpos"].shape[1:]
    others = _OTHER_TIPS if tips else ()
    width = len(POSE_AXES) * (tips - 1)
    shapes: dict[str, tuple[int, ...]] = {"t": (ticks,), "tau_max": (n,), "target": (7,), "other_targets": (width,)}
    for name, quantity in QUANTITIES.items():
        shapes[name] = (ticks, n if quantity.is_per_joint else width if quantity.is_per_tip else len(quantity.axes))
    shapes["qpos"] = (ticks, *nq)
    if arrays["qpos"].shape == (0, 0):  # a log without positions of the model
        shapes["qpos"] = (0, 0)
    shapes = {name: shape for name, shape in shapes.items() if name in arrays and (name != "wrench" or len(arrays[name]))}
    for name, shape in shapes.items():
        column = arrays[name]
        if column.dtype != np.float64 or column.shape != shape or len(nq) != 1:
            raise InputError(f"{name}: expected float64 of shape {shape}, got {column.dtype} of shape {column.shape}")
    for name in ("t", *STATES, "tip", "tip_quat", "qpos", *others[:1]):
        # A recording does not contain the tip, and a robot without torque sensors no torque.
        unknown = name.startswith(("tip", "tau")) and np.isnan(arrays[name]).all()
        if not np.isfinite(arrays[name]).all() and not unknown:
            raise InputError(f"{name}: a number is not finite")
    for name in ("t", "q", "v", "tip", "qpos", *others[:1]):
        if (np.abs(arrays[name]) > _MAX_STATE).any():
            raise InputError(f"{name}: a number is above {_MAX_STATE:g}")
    for name in (*REFERENCES, "tip_ref", "tip_ref_quat", "target", *others[1:]):
        if np.isinf(arrays[name]).any():
            raise InputError(f"{name}: a number is infinite")
    if not (arrays["tau_max"] > 0).all():
        raise InputError("tau_max: a torque limit is not greater than 0")
    for name in ("tip_quat", "tip_ref_quat", "target", *others):
        poses = arrays[name].reshape(-1, len(POSE_AXES)) if name in others else np.atleast_2d(arrays[name])
        norms = np.linalg.norm(poses[:, -4:], axis=1)
        if not (np.isnan(norms) | (np.abs(norms - 1) < _QUATERNION_TOLERANCE)).all():
            raise InputError(f"{name}: a quaternion does not have length 1")
    if not np.allclose(np.diff(arrays["t"]), dt, rtol=1e-6, atol=1e-9 * dt + 1e-15 * ticks):
        raise InputError(f"t: the times are not {dt:g} s apart")


def _contact(value: object) -> Contact:
    if not isinstance(value, list) or len(value) != 5 or not isinstance(value[4], bool):
        raise InputError(f"contacts: {shown(value)} is not a contact")
    body, other = words("contacts", value[:2])
    return Contact(body, other, number("start", value[2], 0.0), number("duration", value[3], 0.0), value[4])


class SimulationError(ArmctlError):
    """A simulation cannot continue; its `log` has the ticks until then."""

    def __init__(self, message: str, log: Log | None = None):
        """An error with the log of the run.

        Args:
            message: One sentence.
            log: The ticks until then, or None.
        """
        super().__init__(message)
        self.log = log
