"""Recorder: the ticks of a run as named columns that are allocated before the run, and the Log made from them."""

import math
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from armctl import _core
from armctl.control.interface import WRENCH_SIZE
from armctl.core.errors import InputError
from armctl.core.log import Contact, Log, LogSource, LogTorques
from armctl.core.log_columns import REFERENCES, STATES
from armctl.core.trajectory import TickReference
from armctl.core.validation import Array, read_only
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm
from armctl.model.arm.core_model import frames, quaternions, tips
from armctl.model.mjmodel.queries import body_name, geom_owner_name

MOST_TICKS = 10_000_000  # 2.8 hours at 1 ms, and 4 GB for seven joints
_MAX_KEPT_ROWS = 20_000  # of a reference
NO_TARGET = np.full(7, np.nan)  # of a tip
_RECORDED = ("qpos", *STATES[1:])  # q is part of qpos


class TickRows:
    """Rows for the ticks of one reference. The tick loop writes row k, then sets `count` to k + 1."""

    def __init__(self, reference: TickReference, nq: int, n: int):
        ticks = len(reference.q)
        self.reference = TickReference(*(read_only(np.ascontiguousarray(column, np.float64)) for column in reference))
        self.qpos = np.empty((ticks, nq))  # the whole model's positions
        self.v = np.empty((ticks, n))  # rad/s
        self.tau_cmd = np.empty((ticks, n))  # N m, the command
        self.tau = np.empty((ticks, n))  # N m, what the motors did
        self.wrench: Array | None = None  # (ticks, 6) the true ones on the tip, if the controller measured them
        self.count = 0
        # For each row at which the touching geoms change: `MjData.contact.geom`.
        self.contacts: list[tuple[int, bytes]] = []

    def with_wrench(self) -> Array:
        """The rows of the wrenches, (ticks, 6); NaN before the first call."""
        if self.wrench is None:
            self.wrench = np.full((len(self.v), WRENCH_SIZE), np.nan)
        return self.wrench


class TipPoses(NamedTuple):
    """Where the tips of an arm are over time: the first one, and the K others next to each other."""

    position: Array  # (T, 3) m
    quat: Array  # (T, 4) wxyz
    others: Array  # (T, 7 K) m and wxyz; (0, 0) for one tip

    @classmethod
    def at(cls, arm: Arm, q: Array) -> "TipPoses":
        """The tips at q (T, n) rad."""
        first = tips(arm.core_model, q)
        others = [frames(arm.core_model, q, *arm.pinocchio_model.carried(k)) for k in range(1, len(arm.tips))]
        columns = [column for position, rotation in others for column in (position, quaternions(rotation))]
        return cls(first[0], quaternions(first[1]), np.column_stack(columns) if columns else np.zeros((0, 0)))


class ReferenceTips:
    """The tips of the last reference: many runs follow the same one."""

    def __init__(self) -> None:
        self._last: tuple[_core.ArmModel, Array, TipPoses] | None = None

    def of(self, arm: Arm, q_ref: Array) -> TipPoses:
        """The tips of an arm at q_ref (T, n) rad, which must not change later."""
        last = self._last
        if last is None or last[0] is not arm.core_model or last[1] is not q_ref:
            last = (arm.core_model, q_ref, TipPoses.at(arm, q_ref))
            self._last = last if len(q_ref) <= _MAX_KEPT_ROWS else None
        return last[2]


class RunInfo(NamedTuple):
    """What a log says of its run as a whole; as in Log, but for one."""

    controller: str
    plant: str
    source: LogSource
    continuous: bool
    torques: LogTorques
    dt: float
    motion_duration: float
    target: Array
    wall_time: float
    failure: str
    targets: Mapping[str, Array] = {}  # (7,) by tip, of an arm with several


class Recorder:
    """The rows of a run, one `TickRows` after the other. They stay readable however the run ends."""

    def __init__(
        self,
        model: mujoco.MjModel,
        actuation: Actuation,
        tips: ReferenceTips,
        positions: Callable[[Array], Array] | None = None,
    ):
        """A recorder without rows.

        Args:
            model: The model whose positions are recorded.
            actuation: The joints of the arm in it.
            tips: Those of references.
            positions: The joint positions (T, n) of rows (T, nq); those of the actuation if left out.
        """
        self._model = model
        self._positions = positions
        self._actuation = actuation
        self._tips = tips
        self._parts: list[TickRows] = []
        self.started = time.perf_counter()
        self.has_begun = False  # whether a run was begun, even if no tick of it is complete

    @property
    def size(self) -> int:
        """The number of complete rows."""
        return sum(part.count for part in self._parts)

    def begin(self, reference: TickReference) -> TickRows:
        rows = TickRows(reference, self._model.nq, self._actuation.n)
        self._parts.append(rows)
        self.has_begun = True
        return rows

    def restart_clock(self) -> None:
        """Counts the computing time from now on, unless a tick is complete: the design of gains is no part of the run."""
        if not self.size:
            self.started = time.perf_counter()

    def log(self, arm: Arm, run: RunInfo) -> Log:
        """The recorded rows as a Log; the tips are from the arm's forward kinematics, which is MuJoCo's to 1e-9."""
        dt = run.dt
        columns = self._columns()
        qpos = columns.pop("qpos")
        seen = TipPoses.at(arm, columns["q"])
        reference = self._tips.of(arm, columns["q_ref"])
        return Log(
            robot=arm.name,
            joint_names=arm.joint_names,
            tau_max=np.array(arm.motor_torque_limits),
            controller=run.controller,
            plant=run.plant,
            source=run.source,
            continuous=run.continuous,
            torques=run.torques,
            dt=dt,
            motion_duration=run.motion_duration,
            target=np.array(run.target),
            real_time_factor=self.size * dt / max(run.wall_time, 1e-9),
            failure=run.failure,
            t=dt * np.arange(self.size, dtype=np.float64),
            tip=seen.position,
            tip_quat=seen.quat,
            tip_ref=reference.position,
            tip_ref_quat=reference.quat,
            qpos=qpos[:, : arm.model.nq],
            units=arm.units,
            contacts=self._contacts(arm, dt),
            wrench=self._wrenches(),
            tip_names=arm.tips if arm.further_tips else (),
            other_tips=seen.others,
            other_tips_ref=reference.others,
            other_targets=np.concatenate([run.targets.get(tip.name, NO_TARGET) for tip in arm.further_tips] or [NO_TARGET[:0]]),
            **columns,
        )

    def _columns(self) -> dict[str, Array]:
        """All complete rows by name: the whole model's positions (T, nq), and columns of the joints, each (T, n)."""
        n = self._actuation.n
        parts = self._parts or [TickRows(TickReference(*[np.zeros((0, n))] * 5), self._model.nq, n)]
        columns = {name: _joined([getattr(part, name)[: part.count] for part in parts]) for name in _RECORDED}
        for name in REFERENCES:
            rows = [_first(getattr(part.reference, name.removesuffix("_ref")), part.count) for part in parts]
            columns[name] = _joined(rows)
        qpos = columns["qpos"]
        positions = self._positions
        columns["q"] = qpos.take(self._actuation.qpos_adr, axis=1) if positions is None else positions(qpos)
        return columns

    def _wrenches(self) -> Array:
        """(T, 6), NaN where the controller did not measure them; (0, 6) if none did."""
        if all(part.wrench is None for part in self._parts):
            return np.zeros((0, WRENCH_SIZE))
        unknown = np.full((1, WRENCH_SIZE), np.nan)
        rows = [
            np.repeat(unknown, part.count, axis=0) if part.wrench is None else part.wrench[: part.count] for part in self._parts
        ]
        return np.concatenate(rows)

    def _contacts(self, arm: Arm, dt: float) -> tuple[Contact, ...]:
        """What the moving bodies of the arm touched. Contacts among the bodies behind its last joint do not count."""
        if not any(part.contacts for part in self._parts):
            return ()
        moving, last = _moving_bodies(arm)
        tool = arm.last_bodies[0]
        start: dict[tuple[int, int], int] = {}
        ticks: dict[tuple[int, int], int] = {}
        offset = 0
        for part in self._parts:
            ends = [*(row for row, _ in part.contacts), part.count][1:]
            for (row, geoms), end in zip(part.contacts, ends, strict=True):
                for pair in _touching(self._model, geoms, moving, last):
                    start.setdefault(pair, offset + row)
                    ticks[pair] = ticks.get(pair, 0) + max(0, end - row)
            offset += part.count
        return tuple(
            Contact(
                body=body_name(self._model, pair[0]),
                other=geom_owner_name(self._model, -1 - pair[1]) if pair[1] < 0 else body_name(self._model, pair[1]),
                start=dt * start[pair],
                duration=dt * ticks[pair],
                on_tool=tool in map(last.get, pair),
            )
            for pair in sorted(start, key=lambda pair: start[pair])
            if ticks[pair]
        )


def _first(column: Array, count: int) -> Array:
    """The first rows of a column: itself, if these are all."""
    return column if count == len(column) else column[:count]


def _joined(parts: list[Array]) -> Array:
    """The rows of all parts. Those of a single complete part are not copied: nobody writes them any more."""
    if len(parts) == 1 and parts[0].flags.c_contiguous:
        return parts[0]
    return np.concatenate(parts)


def ticks_for(duration: float, dt: float) -> int:
    """The number of ticks from a motion's first instant, t = 0, to its last, t = duration."""
    ticks = duration / dt
    if not ticks <= MOST_TICKS:
        raise InputError(f"duration: {duration:g} s are {ticks:.3g} ticks of {dt:g} s, at most {MOST_TICKS:,} fit into a log")
    return math.ceil(ticks - 1e-9) + 1


def _moving_bodies(arm: Arm) -> tuple[frozenset[int], dict[int, int]]:
    """The bodies that the arm moves, and of those behind the last joint to a tip, such as a gripper's, that joint's body."""
    model = arm.model
    moving: set[int] = set()
    last: dict[int, int] = {}
    moved = arm.moved_bodies
    ends = arm.last_bodies
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        if body in moved or parent in moving:
            moving.add(body)
        if body in ends:
            last[body] = body
        elif parent in last:
            last[body] = last[parent]
    return frozenset(moving), last


def _touching(model: mujoco.MjModel, geoms: bytes, moving: frozenset[int], last: dict[int, int]) -> set[tuple[int, int]]:
    """The pairs that touch: the arm's body, and the other body, or -1 - geom for a geom of the world."""
    pairs = set()
    for first_geom, second_geom in np.frombuffer(geoms, np.int32).reshape(-1, 2).tolist():
        first = int(model.geom_bodyid[first_geom])
        second = int(model.geom_bodyid[second_geom])
        if first == second or (first in last and last[first] == last.get(second)):
            continue
        if first in moving:
            pairs.add((first, second or -1 - second_geom))
        elif second in moving:
            pairs.add((second, first or -1 - first_geom))
    return pairs
