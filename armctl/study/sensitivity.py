"""Sensitivity: which factor explains how much of the variance of a metric, by Sobol indices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.core.errors import InputError
from armctl.core.tables import Table
from armctl.core.validation import Array
from armctl.study.factors import Random
from armctl.study.plan import StudyPlan
from armctl.study.statistics import CONFIDENCE, Estimate

_RESAMPLES = 500
_SEED = 0


@dataclass(frozen=True)
class FactorSensitivity:
    """How much of a metric's variance a factor explains."""

    factor: str  # the name of the factor
    first_order: Estimate  # the share that it explains alone
    total: Estimate  # the share that it explains together with all others


@dataclass(frozen=True)
class Sensitivity:
    """Sobol indices of a metric. `bool(sensitivity)` is `sensitivity.ok`."""

    ok: bool  # whether every interval is narrower than 0.2; otherwise more samples are needed
    reason: str  # the reason if it is not ok; empty if it is
    metric: str
    controller: str
    samples: int  # the number of samples; runs are (d + 2) times as many
    factors: tuple[FactorSensitivity, ...]  # the indices of each factor, the largest total first

    def __bool__(self) -> bool:
        return self.ok

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
    rng = np.random.default_rng(_SEED)
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
    return Sensitivity(narrow, reason, metric, controller, samples, ranked)


def _indices(blocks: Array) -> Array:
    """(2, d) first-order and total indices of the blocks (d + 2, samples)."""
    from scipy.stats import sobol_indices as scipy_sobol_indices

    func: dict[str, Any] = {"f_A": blocks[:1], "f_B": blocks[1:2], "f_AB": blocks[2:, None]}
    found = scipy_sobol_indices(func=func, n=blocks.shape[1])
    return np.array([found.first_order, found.total_order])
