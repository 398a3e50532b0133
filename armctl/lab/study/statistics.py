"""Statistics of runs: medians, intervals and paired differences in which a run that failed counts as the worst."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, floor, inf, nan

import numpy as np

from armctl.core.defaults import CONFIDENCE
from armctl.core.validation import Array, BoolArray

_RESAMPLES = 2000
_BOOTSTRAP_SEED = 0  # of the bootstrap: the same runs give the same intervals


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval of 95 % confidence; infinite where so many runs failed that it has no bound."""

    value: float  # the figure
    low: float  # the lower end of the interval
    high: float  # the upper end

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"

    def scaled(self, factor: float) -> Estimate:
        return Estimate(factor * self.value, factor * self.low, factor * self.high)


def success(ok: BoolArray) -> Estimate:
    """The share of successes with Wilson's interval (Wilson, "Probable Inference, the Law of Succession", JASA 1927)."""
    from scipy.stats import binomtest

    if not len(ok):
        return Estimate(nan, nan, nan)
    interval = binomtest(int(ok.sum()), len(ok)).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(float(ok.mean()), float(interval.low), float(interval.high))


def median(values: Array) -> Estimate:
    """The median with its bootstrap interval. NaN, for a run that failed, counts as infinite."""
    if not len(values):
        return Estimate(nan, nan, nan)
    ordered = np.sort(np.where(np.isnan(values), inf, values))
    low, high = _ranks(len(values))
    with np.errstate(invalid="ignore"):
        middle = float(np.median(ordered))
    return Estimate(inf if np.isnan(middle) else middle, float(ordered[floor(low)]), float(ordered[ceil(high)]))


def paired_differences(values: Array, baseline: Array) -> Array:
    """values - baseline, run by run; a run that failed alone is infinitely worse, two that failed are equal."""
    failed = np.isnan(values)
    baseline_failed = np.isnan(baseline)
    out = np.where(failed & baseline_failed, 0.0, values - baseline)
    out[failed & ~baseline_failed] = inf
    out[~failed & baseline_failed] = -inf
    return out


@lru_cache(maxsize=256)
def _ranks(count: int) -> tuple[float, float]:
    """The bootstrap interval of the rank of the median.

    The median of a resample depends on ranks alone. One bootstrap of the ranks therefore serves every figure of so many runs,
    and infinite figures need no arithmetic.
    """
    from scipy.stats import bootstrap

    if count == 1:
        return 0.0, 0.0
    ranks = np.arange(count, dtype=np.float64)
    interval = bootstrap(
        (ranks,),
        np.median,
        n_resamples=_RESAMPLES,
        batch=max(1, 10_000_000 // count),
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(_BOOTSTRAP_SEED),
    ).confidence_interval
    return float(interval.low), float(interval.high)
