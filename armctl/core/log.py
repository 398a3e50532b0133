"""Log: every tick of a run."""

from __future__ import annotations

import csv
import json
import os
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armctl.core.errors import ArmctlError, InputError
from armctl.core.validation import Array, frozen


class Contact(NamedTuple):
    """Two bodies that touched during a run, at least one of them a moving body of the arm.

    Attributes:
        body: The body of the arm.
        other: The body that it touched.
        start: s, when they touched first.
        duration: s, how long they touched in total.
    """

    body: str
    other: str
    start: float
    duration: float

    def __str__(self) -> str:
        return f"{self.body} touched {self.other} for {self.duration:.3g} s"


@dataclass(frozen=True, eq=False)
class Log:
    """What happened, tick by tick. Read-only arrays; row k is the state at t[k] and what was done about it.

    Attributes:
        robot: The arm's name.
        controller: The controller's name.
        joint_names: The n joints.
        dt: s, the tick.
        tau_max: (n,) N m.
        motion_duration: s, when the reference comes to rest; the log may go on.
        target: (7,) where the tip should end, m and wxyz; NaN for what was not asked for. After `Simulation.follow` the target
            at the end of the run.
        real_time_factor: Simulated time over the time it took.
        failure: Why the run ended early, in words; empty if it did not.
        t: (T,) s.
        q: (T, n) rad.
        v: (T, n) rad/s.
        q_ref: (T, n) rad; NaN in an open-loop run, as are v_ref, a_ref and the reference's tip.
        v_ref: (T, n) rad/s.
        a_ref: (T, n) rad/s^2.
        tau: (T, n) N m, what the motors did.
        tau_cmd: (T, n) N m, what the controller wanted.
        tip: (T, 3) m.
        tip_quat: (T, 4) wxyz.
        tip_ref: (T, 3) m.
        tip_ref_quat: (T, 4) wxyz.
        plant: How reality differed from the model, in words.
        qpos: (T, nq) the whole model's positions as in MjData.qpos: grippers and loose objects too, for films.
        units: What each joint is measured in, "rad" or "m"; all in rad if left out.
        contacts: What the arm touched, in the order of time; empty if it touched nothing.
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
    qpos: Array = field(default_factory=lambda: np.zeros((0, 0)))
    units: tuple[str, ...] = ()
    contacts: tuple[Contact, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "units", tuple(self.units) or ("rad",) * len(self.joint_names))
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, np.ndarray):
                frozen(value)

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Log({self.robot!r}, {self.controller!r}, {len(self)} ticks of {1e3 * self.dt:g} ms)"

    @property
    def is_open_loop(self) -> bool:
        """Whether there was no reference to follow."""
        return bool(np.isnan(self.q_ref).all())

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the log as .npz, or as .csv (the arrays over time alone).

        Args:
            path: The file; its folder is made. Its ending decides the format.

        Returns:
            The path.

        Raises:
            InputError: Another ending.
        """
        path = Path(path)
        if path.suffix not in (".npz", ".csv"):
            raise InputError(f"path: {path.name!r} ends in {path.suffix!r}, .npz or .csv wanted")
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".csv":
            self._save_csv(path)
        else:
            everything = {f.name: getattr(self, f.name) for f in fields(self)}
            arrays = {k: x for k, x in everything.items() if isinstance(x, np.ndarray)}
            rest = json.dumps({k: x for k, x in everything.items() if k not in arrays})
            np.savez_compressed(path, allow_pickle=False, meta=np.array(rest), **arrays)
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Log:
        """Reads a log that `save` wrote as .npz.

        Args:
            path: The file.

        Returns:
            The log.

        Raises:
            InputError: There is no such file, or it is no log.
        """
        try:
            with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as data:
                arrays = {k: data[k] for k in data.files if k != "meta"}
                meta = json.loads(str(data["meta"]))
            meta["joint_names"] = tuple(meta["joint_names"])
            meta["contacts"] = tuple(Contact(*each) for each in meta.get("contacts", ()))
            log = cls(**arrays, **meta)
            if len({len(getattr(log, k)) for k in ("t", "q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_cmd", "tip")}) > 1:
                raise ValueError("its columns differ in length")
            return log
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{os.fspath(path)}: no log that armctl wrote ({error})") from None

    def _save_csv(self, path: Path) -> None:
        per_joint = ("q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_cmd")
        header = ["t", *(f"{k}_{j}" for k in per_joint for j in self.joint_names)]
        header += [f"{k}_{axis}" for k in ("tip", "tip_ref") for axis in "xyz"]
        columns = [self.t[:, None], *(getattr(self, k) for k in per_joint), self.tip, self.tip_ref]
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(np.hstack(columns).tolist())


class SimulationError(ArmctlError):
    """A simulation that cannot go on.

    Attributes:
        log: What was recorded before it, or None.
    """

    def __init__(self, message: str, log: Log | None = None):
        """An error with what was recorded before it.

        Args:
            message: One sentence.
            log: The ticks until then, or None.
        """
        super().__init__(message)
        self.log = log
