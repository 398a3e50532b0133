"""StudyResult: the table of a study's runs, and what follows from it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.core.atomic import atomic_path, file_path
from armctl.core.errors import ArmctlError, InputError, UnknownNameError, import_extra
from armctl.core.file_reading import pyarrow, read_parquet, reading
from armctl.core.log import Log
from armctl.core.result import Verdict
from armctl.core.validation import choice, flag, instance, integer
from armctl.lab.study import plots
from armctl.lab.study.plan import StudyPlan
from armctl.lab.study.study_runner import FIGURES, Outcome, StudyRun
from armctl.lab.study.summary import Sensitivity, StudySummary, sobol_indices, summarize

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

METRICS = (*FIGURES, "ok", "completed", "contacts")
_PARQUET_KEY = b"armctl study"
_MAX_FILE_BYTES = 8_000_000_000  # unpacked: the table of a study of ten million runs
_TEXTS = ("controller", "reason", "digest", "key")


@dataclass(frozen=True, eq=False)
class WorstRun:
    """A run that was simulated again."""

    row: dict[str, Any]  # its row in the table
    log: Log | None  # its ticks; None if it cannot be simulated, as the reason in its row says


@dataclass(frozen=True, eq=False)
class StudyResult(Verdict):
    """The finished runs of a study. `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether all runs are finished; a run that failed is finished, too.
        reason: The reason if it is not ok; empty if it is.
    """

    ok: bool
    reason: str
    study: StudyPlan
    _columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self._columns["run"])

    def __repr__(self) -> str:
        return f"StudyResult({self.study.name!r}, {len(self)} runs)"

    def table(self) -> dict[str, np.ndarray]:
        """One row per run.

        Returns:
            Arrays by name: run (its number), pair (equal for all controllers with the same values and noise), controller, the
            factors, repeat, seed, ok, completed, reason, the figures of a `Report` (NaN if the run was not completed), contacts
            (how many), and digest, which is equal for equal bits of positions and commands.
        """
        return dict(self._columns)

    def to_pandas(self) -> pandas.DataFrame:
        """The table as a DataFrame.

        Raises:
            NotInstalledError: The extra `study` is not installed.
        """
        return import_extra("pandas", "to_pandas needs pandas", "study").DataFrame(self.table())

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the table and the definition of the study as .parquet, which `load` reads, or the table as .csv. Atomic.

        Args:
            path: The file; its folder is made.

        Raises:
            InputError: Another file extension.
            NotInstalledError: The extra `study` is not installed.
            ArmctlError: The file cannot be written.
        """
        path = file_path("path", path, (".parquet", ".csv"))
        if path.suffix == ".csv":
            frame = self.to_pandas()
            with atomic_path(path) as temporary:
                frame.to_csv(temporary, index=False)
            return path
        arrow, parquet = pyarrow()
        columns = {name: column.tolist() for name, column in self.table().items()}
        table = arrow.table(columns)
        table = table.replace_schema_metadata({_PARQUET_KEY: json.dumps(self.study.to_dict())})
        buffer = arrow.BufferOutputStream()
        parquet.write_table(table, buffer, compression="zstd")
        with atomic_path(path) as temporary:
            temporary.write_bytes(buffer.getvalue())
        return path

    @staticmethod
    def load(path: str | os.PathLike[str]) -> StudyResult:
        """Reads a result that `save` wrote as .parquet.

        Raises:
            InputError: There is no such file, or it holds no result of a study.
            NotInstalledError: The extra `study` is not installed.
        """
        path = file_path("path", path, (".parquet",))
        with reading(path, "no result of a study"):
            table = read_parquet(path, _MAX_FILE_BYTES)
            study = StudyPlan.from_dict(json.loads((table.schema.metadata or {})[_PARQUET_KEY]))
            columns = {name: _column(name, table.column(name).to_pylist()) for name in table.column_names}
            missing = {"run", "pair", "repeat", "seed", *_TEXTS, *METRICS, *study.factors} - columns.keys()
            if missing:
                raise InputError(f"it has no column {sorted(missing)[0]!r:.40}")
            if not set(columns["controller"]) <= set(study.controllers):
                raise InputError("its controllers are not those of its study")
        return _with_columns(study, study.run_count, columns)

    def summary(self, metrics: Sequence[str] = ("tip_rms_m", "final_tip_error_m")) -> StudySummary:
        """The controllers side by side, with intervals of 95 % confidence.

        Args:
            metrics: Figures of the table.

        Returns:
            For each controller its share of successes, the medians, and the paired differences from the first controller.

        Raises:
            InputError: There is no finished run, or one of the metrics is unknown.
        """
        instance("metrics", metrics, (str, Sequence), "give a list of names")
        names = [metrics] if isinstance(metrics, str) else list(metrics)
        for metric in names:
            self._check("metrics", metric)
        return StudySummary(
            ok=self.ok,
            reason=self.reason,
            name=self.study.name,
            metrics=tuple(names),
            controllers=summarize(self._columns, self._labels, names),
        )

    def sensitivity(self, metric: str = "tip_rms_m", controller: str | None = None) -> Sensitivity:
        """Sobol indices: which factor explains how much of the variance of a metric.

        Args:
            metric: A figure of the table; "ok" is 1 for a success and 0 otherwise.
            controller: The label of the controller; the first one if left out.

        Raises:
            InputError: The study was not sampled with "saltelli", is not finished, or a run has no such figure.
        """
        self._check("metric", metric)
        label = self._controller(controller)
        if self.study.sampling != "saltelli":
            raise InputError("sensitivity: the study needs sampling='saltelli'; plot_tornado works with any sampling")
        if not self.ok:
            raise InputError(f"sensitivity: {self.reason}; run the study again")
        values = np.asarray(self._columns[metric][self._columns["controller"] == label], dtype=float)
        return sobol_indices(self.study, values, metric, label)

    def worst(
        self,
        count: int = 5,
        metric: str = "tip_rms_m",
        *,
        controller: str | None = None,
        folder: str | os.PathLike[str] | None = None,
        film: bool = False,
    ) -> list[WorstRun]:
        """Simulates the worst runs again: those that were not completed first, then those with the largest figure.

        Args:
            metric: A figure of the table.
            controller: The label of a controller; all if left out.
            folder: Where the logs are written, as worst-1.npz and so on; nowhere if left out.
            film: Whether films are written there, too, as worst-1.gif and so on.

        Returns:
            Rows and logs, the worst first.

        Raises:
            InputError: An argument has a wrong type or value.
            ArmctlError: The robot cannot be loaded, or a file cannot be written.
        """
        count = integer("count", count, 1)
        self._check("metric", metric)
        if flag("film", film) and folder is None:
            raise InputError("folder: expected a folder for the films, got none")
        if folder is not None:
            instance("folder", folder, (str, os.PathLike), "give the name of a folder")
        values = np.asarray(self._columns[metric], dtype=float)
        chosen = np.ones(len(self), bool) if controller is None else self._columns["controller"] == self._controller(controller)
        badness = np.where(np.isnan(values), np.inf, -values if metric in ("ok", "completed") else values)
        order = [int(k) for k in np.argsort(-badness, kind="stable") if chosen[k]][:count]
        found = []
        for place, k in enumerate(order, 1):
            row = {name: column[k] for name, column in self._columns.items()}
            log = self._again(row)
            found.append(WorstRun(row, log))
            if folder is not None and log is not None:
                log.save(Path(folder) / f"worst-{place}.npz")
                if film:
                    from armctl.report.render.video import record

                    record(log, self.study.runner.arm, Path(folder) / f"worst-{place}.gif")
        return found

    def _again(self, row: Mapping[str, Any]) -> Log | None:
        point = {name: row[name] for name in self.study.factors}
        run = StudyRun(row["key"], row["controller"], point, int(row["repeat"]), int(row["seed"]))
        try:
            return self.study.runner.simulate(run)
        except ArmctlError as error:
            return getattr(error, "log", None)

    def plot_quantiles(
        self,
        path: str | os.PathLike[str] | None = None,
        metric: str = "tip_rms_m",
        over: str | None = None,
        *,
        size: tuple[float, float] | None = None,
        title: bool = True,
        ax: Axes | None = None,
    ) -> Path | None:
        """Draws the median of a metric over a factor for each controller, with bands from 25 to 75 % and from 5 to 95 %.

        Args:
            path: The picture, .png, .svg or .pdf; a window opens if left out.
            metric: A figure of the table.
            over: The factor; the first one with several numbers if left out.
            size: Width and height in inches.
            title: Whether what the bands are stands above; False where a caption says it.
            ax: Axes of matplotlib to draw into instead.

        Raises:
            InputError: An argument has a wrong type or value, or the factor has no numbers.
            ArmctlError: The file cannot be written.
        """
        self._check("metric", metric)
        return plots.quantiles(
            self.table(), metric, self._factor("over", over), self._labels, plots.Canvas(path, size, title, ax)
        )

    def plot_tornado(
        self,
        path: str | os.PathLike[str] | None = None,
        metric: str = "tip_rms_m",
        *,
        size: tuple[float, float] | None = None,
        title: bool = True,
        ax: Axes | Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws how the median of a metric moves from the lowest to the highest fifth of each factor, for each controller.

        Args:
            path: The picture, .png, .svg or .pdf; a window opens if left out.
            metric: A figure of the table.
            size: Width and height in inches.
            title: Whether what the marks are stands above; False where a caption says it.
            ax: Axes of matplotlib to draw into instead, one for each controller.

        Raises:
            InputError: An argument has a wrong type or value, or no factor has several numbers.
            ArmctlError: The file cannot be written.
        """
        self._check("metric", metric)
        self._factor("factors", None)
        return plots.tornado(self.table(), metric, self.numeric_factors, self._labels, plots.Canvas(path, size, title, ax))

    def plot_success(
        self,
        path: str | os.PathLike[str] | None = None,
        x: str | None = None,
        y: str | None = None,
        *,
        metric: str = "ok",
        limit: float | None = None,
        size: tuple[float, float] | None = None,
        ax: Axes | Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws the share of successes over two factors: how much of both until it fails.

        Args:
            path: The picture, .png, .svg or .pdf; a window opens if left out.
            x: The factor on the horizontal axis; the first one with several numbers if left out.
            y: The factor on the vertical axis; the second one if left out.
            metric: "ok", the tip is at its goal at the end; or a figure with a limit.
            limit: The largest figure that is a success, in SI units.
            size: Width and height in inches.
            ax: Axes of matplotlib to draw into instead, one for each controller.

        Raises:
            InputError: An argument has a wrong type or value, or the study has only one factor with several numbers.
            ArmctlError: The file cannot be written.
        """
        self._check("metric", metric)
        first = self._factor("x", x)
        others = [name for name in self.numeric_factors if name != first]
        second = self._factor("y", y if y is not None or not others else others[0])
        if first == second:
            raise InputError(f"x, y: expected two different factors with several numbers each, got {first!r} twice")
        values = np.asarray(self._columns[metric], dtype=float)
        if (metric in ("ok", "completed")) != (limit is None):
            raise InputError("metric, limit: give a figure and its limit, or neither of them")
        succeeded = values > 0.5 if limit is None else values <= limit  # False for NaN, a run that was not completed
        return plots.success(
            self.table(), succeeded, (first, second), self._labels, plots.Canvas(path, size, title=True, ax=ax)
        )

    @property
    def _labels(self) -> list[str]:
        return list(self.study.controllers)

    @property
    def numeric_factors(self) -> list[str]:
        """The factors that have several values, all of them numbers."""
        columns = ((name, self._columns[name]) for name in self.study.factors)
        return [name for name, column in columns if column.dtype != object and len(np.unique(column)) > 1]

    def _factor(self, what: str, name: str | None) -> str:
        known = self.numeric_factors
        if not known:
            raise InputError(f"{what}: no factor of the study has several values that are numbers")
        return choice(what, known[0] if name is None else name, known)

    def _controller(self, label: str | None) -> str:
        if label is None:
            return self._labels[0]
        instance("controller", label, str, "give a label of the study's controllers")
        if label not in self.study.controllers:
            raise UnknownNameError.from_known("controller of the study", label, self._labels)
        return label

    def _check(self, what: str, metric: str) -> None:
        choice(what, metric, METRICS)
        if not len(self):
            raise InputError(f"{self.study.name}: no run is finished")


def study_result(study: StudyPlan, outcomes: Mapping[str, Outcome]) -> StudyResult:
    """The result of a study from the outcomes of its runs, by key."""
    numbers = np.array([number for number, run in enumerate(study.runs) if run.key in outcomes], dtype=np.int64)
    runs = [study.runs[number] for number in numbers]
    columns: dict[str, Any] = {
        "run": numbers,
        "pair": numbers // len(study.controllers),
        "controller": [run.controller for run in runs],
    }
    for name in study.factors:
        columns[name] = [run.point[name] for run in runs]
    columns["repeat"] = np.array([run.repeat for run in runs], dtype=np.int64)
    columns["seed"] = np.array([run.seed for run in runs], dtype=np.int64)
    for name in ("ok", "completed", "reason", *FIGURES, "contacts", "digest"):
        columns[name] = [outcomes[run.key][name] for run in runs]
    columns["key"] = [run.key for run in runs]
    return _with_columns(study, len(study.runs), {name: _column(name, values) for name, values in columns.items()})


def _with_columns(study: StudyPlan, total: int, columns: Mapping[str, np.ndarray]) -> StudyResult:
    missing = total - len(columns["run"])
    reason = f"{missing} of {total} runs are not finished" if missing else ""
    return StudyResult(ok=not missing, reason=reason, study=study, _columns=columns)


def _column(name: str, values: Any) -> np.ndarray:
    """A column as an array: numbers and booleans where all are, objects otherwise."""
    if isinstance(values, np.ndarray):
        return values
    if name in FIGURES:
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    if name not in _TEXTS and all(isinstance(value, (bool, int, float)) for value in values):
        return np.array(values)
    out = np.empty(len(values), dtype=object)
    out[:] = [tuple(value) if isinstance(value, list) else value for value in values]
    return out
