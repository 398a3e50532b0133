"""StudySummary: the controllers of a study side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from armctl.core.errors import InputError
from armctl.core.json_values import json_value
from armctl.core.result import Verdict
from armctl.core.tables import Table
from armctl.core.validation import Array
from armctl.lab.study.factors import Random
from armctl.lab.study.plan import StudyPlan
from armctl.lab.study.statistics import CONFIDENCE, Estimate, median, paired_differences, success

_RESAMPLES = 500
_RESAMPLING_SEED = 0


@dataclass(frozen=True)
class ControllerSummary:
    """One controller over all its runs."""

    controller: str  # its label
    runs: int  # the number of its runs
    completed: int  # how many of them were completed, whether or not the tip was at its goal
    success: Estimate  # the share of runs at whose end the tip was at its goal, with Wilson's interval
    # The median of each metric, with a bootstrap interval; a run that was not completed counts as infinite
    medians: dict[str, Estimate]
    # The median of the differences from the first controller at the same point with the same noise; empty for the first one.
    # Below 0 this controller is better.
    differences: dict[str, Estimate]


@dataclass(frozen=True)
class StudySummary(Verdict):
    """The controllers of a study side by side. `bool(summary)` is `summary.ok`."""

    ok: bool  # whether all runs of the study are finished
    reason: str  # the reason if it is not ok; empty if it is
    name: str  # the name of the study
    metrics: tuple[str, ...]
    controllers: tuple[ControllerSummary, ...]  # one for each controller

    def table(self) -> Table:
        """The summary as a table; intervals are of 95 % confidence."""
        header = ["controller", "runs", "completed", "at the goal, %"]
        for metric in self.metrics:
            label, _ = unit_of(metric)
            header += [f"median {label}", "difference from the first"]
        rows = []
        for each in self.controllers:
            row = [each.controller, str(each.runs), str(each.completed), f"{each.success.scaled(100):.1f}"]
            for metric in self.metrics:
                _, factor = unit_of(metric)
                row.append(f"{each.medians[metric].scaled(factor):.3g}")
                row.append(f"{each.differences[metric].scaled(factor):.3g}" if each.differences else "")
            rows.append(row)
        return Table(header, rows)

    def __str__(self) -> str:
        text = self.table().markdown()
        return text if self.ok else f"{self.reason}\n\n{text}"

    def to_dict(self) -> dict[str, object]:
        """All figures for JSON; what is not finite is None."""
        controllers = json_value([asdict(each) for each in self.controllers])
        return {"ok": self.ok, "reason": self.reason, "name": self.name, "controllers": controllers}


def unit_of(metric: str) -> tuple[str, float]:
    """The label of a metric in tables and plots, and the factor to its unit there: lengths in mm."""
    name, _, unit = metric.rpartition("_")
    known = {"m": ("mm", 1e3), "rad": ("rad", 1.0), "s": ("s", 1.0), "nm": ("N m", 1.0)}
    if unit not in known:
        return metric.replace("_", " "), 1.0
    label, factor = known[unit]
    return f"{name.replace('_', ' ')}, {label}", factor


def summarize(
    columns: Mapping[str, np.ndarray], labels: Sequence[str], metrics: Sequence[str]
) -> tuple[ControllerSummary, ...]:
    """The controllers of a table one by one; `metrics` are names of its columns."""
    first = columns["controller"] == labels[0]
    found = []
    for label in labels:
        own = columns["controller"] == label
        differences = {}
        if label != labels[0]:
            # Where the runs are that have the same point and repetition.
            pairs = (columns["pair"][own], columns["pair"][first])
            _, mine, others = np.intersect1d(*pairs, assume_unique=True, return_indices=True)
            for metric in metrics:
                change = paired_differences(columns[metric][own][mine], columns[metric][first][others])
                differences[metric] = median(change)
        found.append(
            ControllerSummary(
                controller=label,
                runs=int(own.sum()),
                completed=int(columns["completed"][own].sum()),
                success=success(columns["ok"][own]),
                medians={metric: median(columns[metric][own]) for metric in metrics},
                differences=differences,
            )
        )
    return tuple(found)


@dataclass(frozen=True)
class FactorSensitivity:
    """How much of a metric's variance a factor explains."""

    factor: str  # the name of the factor
    first_order: Estimate  # the share that it explains alone
    total: Estimate  # the share that it explains together with all others


@dataclass(frozen=True)
class Sensitivity(Verdict):
    """Sobol indices of a metric. `bool(sensitivity)` is `sensitivity.ok`."""

    ok: bool  # whether every interval is narrower than 0.2; otherwise more samples are needed
    reason: str  # the reason if it is not ok; empty if it is
    metric: str
    controller: str
    samples: int  # the number of samples; runs are (d + 2) times as many
    factors: tuple[FactorSensitivity, ...]  # the indices of each factor, the largest total first

    def __str__(self) -> str:
        rows = [[each.factor, f"{each.first_order:.2f}", f"{each.total:.2f}"] for each in self.factors]
        text = Table([f"{self.controller}: {self.metric}", "alone", "with all others"], rows).markdown()
        return text if self.ok else f"{text}\n{self.reason}"


_WIDEST_INTERVAL = 0.2


def sobol_indices(study: StudyPlan, values: Array, metric: str, controller: str) -> Sensitivity:
    """Sobol indices by `scipy.stats.sobol_indices`.

    The estimators are those of Saltelli et al., "Variance based sensitivity analysis of model output", 2010. The intervals
    are of a bootstrap over the samples: SciPy's own bootstrap takes no seed.
    """
    names = [name for name, factor in study.factors.items() if isinstance(factor, Random)]
    if not np.isfinite(values).all():
        missing = f"{int((~np.isfinite(values)).sum())} of {len(values)}"
        raise InputError(f"sensitivity: {missing} runs of {controller} have no {metric}; metric='ok' always exists")
    # The order of runs is that of the points: blocks A, B, AB_1 ... AB_d, with the repetitions of a point in sequence.
    blocks = values.reshape(len(names) + 2, -1, study.repeats).mean(axis=2)
    samples = blocks.shape[1]
    indices = _indices(blocks)
    rng = np.random.default_rng(_RESAMPLING_SEED)
    resampled = np.array([_indices(blocks[:, rng.integers(samples, size=samples)]) for _ in range(_RESAMPLES)])
    low, high = np.quantile(resampled, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE], axis=0)
    found = [
        FactorSensitivity(
            factor=name,
            first_order=Estimate(*(float(x[0, i]) for x in (indices, low, high))),
            total=Estimate(*(float(x[1, i]) for x in (indices, low, high))),
        )
        for i, name in enumerate(names)
    ]
    widest = float((high - low).max())
    narrow = widest <= _WIDEST_INTERVAL
    reason = "" if narrow else f"an interval is {widest:.2f} wide; take more samples than {study.samples}"
    ranked = tuple(sorted(found, key=lambda each: -each.total.value))
    return Sensitivity(ok=narrow, reason=reason, metric=metric, controller=controller, samples=samples, factors=ranked)


def _indices(blocks: Array) -> Array:
    """(2, d) first-order and total indices of the blocks (d + 2, samples)."""
    from scipy.stats import sobol_indices as scipy_sobol_indices

    func: dict[str, Any] = {"f_A": blocks[:1], "f_B": blocks[1:2], "f_AB": blocks[2:, None]}
    found = scipy_sobol_indices(func=func, n=blocks.shape[1])
    return np.array([found.first_order, found.total_order])
