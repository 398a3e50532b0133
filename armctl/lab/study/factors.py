"""Factors of a study: what varies between its runs, and the points at which the runs are made."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array, choice, flag, integer, number, shown, vector

SAMPLINGS = ("sobol", "lhs", "saltelli")
MAX_RUNS = 10_000_000

Value = float | bool | str | tuple[float, ...]
Point = dict[str, Any]  # the value of each factor


@dataclass(frozen=True)
class Range:
    """A factor that is uniform between two bounds. Ranges of a study are sampled together by a space-filling design.

    Attributes:
        low: The lower bound.
        high: The upper bound.
        log: Whether the logarithm is uniform, for a factor over several orders of magnitude.
    """

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", number("low", self.low))
        object.__setattr__(self, "high", number("high", self.high))
        object.__setattr__(self, "log", flag("log", self.log))
        if not self.low < self.high:
            raise InputError(f"high: expected a number above low = {self.low:g}, got {self.high:g}")
        if self.log and self.low <= 0.0:
            raise InputError(f"low: expected a number above 0 for a logarithmic range, got {self.low:g}")

    def at(self, share: float) -> float:
        """The quantile: a share of all values is below it.

        Args:
            share: From 0 to 1.

        Returns:
            The value, in the unit of the bounds.
        """
        share = number("share", share, 0.0, 1.0)
        if self.log:
            return self.low * (self.high / self.low) ** share
        return self.low + share * (self.high - self.low)

    def _quantiles(self, u: Array, name: str) -> list[Value]:
        if _is_whole_number(name):  # both ends included
            low = integer(f"{name}: low", self.low)
            high = integer(f"{name}: high", self.high)
            return [min(low + int(x * (high - low + 1)), high) for x in u.tolist()]
        if self.log:
            return np.exp(math.log(self.low) + u * math.log(self.high / self.low)).tolist()
        return (self.low + u * (self.high - self.low)).tolist()

    def _examples(self) -> list[Value]:
        return [self.low, self.high]


@dataclass(frozen=True)
class Normal:
    """A factor with a normal distribution, cut off at its bounds.

    Attributes:
        mean: The mean of the distribution without bounds.
        std: Its standard deviation.
        low: The lower bound.
        high: The upper bound.
    """

    mean: float
    std: float
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", number("mean", self.mean))
        object.__setattr__(self, "std", number("std", self.std, 1e-300))
        object.__setattr__(self, "low", _bound("low", self.low))
        object.__setattr__(self, "high", _bound("high", self.high))
        if not self.low <= self.mean <= self.high:
            raise InputError(f"mean: expected a number between {self.low:g} and {self.high:g}, got {self.mean:g}")

    def _quantiles(self, u: Array, name: str) -> list[Value]:
        from scipy.stats import truncnorm

        bounds = [(bound - self.mean) / self.std for bound in (self.low, self.high)]
        inside = np.clip(u, 2.0**-53, 1.0 - 2.0**-53)  # a share of 0 is at minus infinity
        return truncnorm.ppf(inside, *bounds, loc=self.mean, scale=self.std).tolist()

    def _examples(self) -> list[Value]:
        return [self.mean, *(bound for bound in (self.low, self.high) if math.isfinite(bound))]


@dataclass(frozen=True)
class Choice:
    """A factor that is drawn from values of equal probability. A plain list instead gives a grid: all combinations."""

    values: tuple[Value, ...]

    def __init__(self, values: Iterable[Any]):
        """A factor of these values.

        Args:
            values: Numbers, texts, booleans or lists of numbers.

        Raises:
            InputError: There is none, or one is something else.
        """
        object.__setattr__(self, "values", levels("values", values))

    def _quantiles(self, u: Array, name: str) -> list[Value]:
        last = len(self.values) - 1
        return [self.values[min(int(x * len(self.values)), last)] for x in u.tolist()]


# `_quantiles(u, name)`: the values of the factor `name` below which the shares u (k,) of the distribution are.
Random = Range | Normal | Choice
Factor = Random | tuple[Value, ...]
_TABLES: dict[frozenset[str], type[Random]] = {
    frozenset({"low", "high"}): Range,
    frozenset({"mean", "std"}): Normal,
    frozenset({"values"}): Choice,
}


def _is_whole_number(name: str) -> bool:
    from armctl.run.sim.plant import PLANT_ATTRIBUTES  # loads MuJoCo, which a Range alone does not need
    from armctl.run.sim.plant_attribute import Kind

    return name in PLANT_ATTRIBUTES and PLANT_ATTRIBUTES[name].kind is Kind.WHOLE_NUMBER


def _bound(name: str, value: float) -> float:
    """A number, which may be infinite."""
    return value if isinstance(value, float) and math.isinf(value) else number(name, value)


def levels(name: str, values: Any) -> tuple[Value, ...]:
    """Values as plain data, without repeated ones; InputError for anything else."""
    if isinstance(values, str) or not isinstance(values, Iterable) or getattr(values, "ndim", None) == 0:
        values = (values,)
    out = tuple(dict.fromkeys(_plain(name, value) for value in values))
    if not out:
        raise InputError(f"{name}: no values given")
    return out


def read_factor(name: str, value: Any) -> Factor:
    """A factor from what a caller or a file gave: a distribution, a table such as {low = 0, high = 2}, a list, or one value."""
    if isinstance(value, Random):
        return value
    if not isinstance(value, Mapping):
        return levels(name, value)
    for keys, kind in _TABLES.items():
        if keys <= value.keys():
            try:
                return kind(**value)
            except TypeError:
                break
    raise InputError(f"factors: {name}: expected {{low, high}}, {{mean, std}} or {{values}}, got {shown(dict(value))}")


def examples(factor: Factor, drawn: Iterable[Value]) -> Iterable[Value]:
    """The values of a factor that are checked before anything runs: bounds, or those drawn for the runs."""
    return factor._examples() if isinstance(factor, Range | Normal) else dict.fromkeys(drawn)


def factor_table(factor: Factor) -> Any:
    """The inverse of `read_factor`, as plain data."""
    if not isinstance(factor, Random):
        return list(factor)
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in vars(factor).items()}
    return {key: value for key, value in plain.items() if not isinstance(value, float) or math.isfinite(value)}


def design_points(factors: Mapping[str, Factor], samples: int, sampling: str, seed: int) -> list[Point]:
    """The points of a study: every combination of the lists, at each sample of the distributions."""
    choice("sampling", sampling, SAMPLINGS)
    random = {name: factor for name, factor in factors.items() if isinstance(factor, Random)}
    lists = {name: factor for name, factor in factors.items() if not isinstance(factor, Random)}
    combinations = math.prod(len(values) for values in lists.values())
    if sampling == "saltelli" and (combinations > 1 or len(random) < 2):
        raise InputError("sampling: 'saltelli' needs two or more distributions, and no list of several values")
    blocks = len(random) + 2 if sampling == "saltelli" else 1
    if combinations * blocks * (samples if random else 1) > MAX_RUNS:
        raise InputError(f"samples: {samples} of {combinations} combinations are more than {MAX_RUNS} points")
    grid = [dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values())]
    if not random:
        return grid
    shares = _shares(len(random), samples, sampling, seed)
    columns = [factor._quantiles(u, name) for u, (name, factor) in zip(shares.T, random.items(), strict=True)]
    return [{**each, **dict(zip(random, row, strict=True))} for row in zip(*columns, strict=True) for each in grid]


def _shares(d: int, samples: int, sampling: str, seed: int) -> Array:
    """(k, d) points in the unit cube."""
    from scipy.stats import qmc

    rng = np.random.default_rng(seed)
    if sampling == "lhs":
        return qmc.LatinHypercube(d, rng=rng).random(samples)
    if samples & (samples - 1):
        raise InputError(f"samples: expected a power of 2 such as {2 ** round(math.log2(samples))}, got {samples}")
    if sampling == "sobol":
        return qmc.Sobol(d, rng=rng).random(samples)
    a, b = np.split(qmc.Sobol(2 * d, rng=rng).random(samples), 2, axis=1)
    mixed = [np.where(np.arange(d) == i, b, a) for i in range(d)]
    return np.concatenate([a, b, *mixed])


def _plain(name: str, value: Any) -> Value:
    if isinstance(value, (bool, str)):
        return value
    if isinstance(value, (list, tuple, np.ndarray)):
        return tuple(vector(name, value).tolist())
    checked = number(name, value)
    return int(value) if isinstance(value, (int, np.integer)) else checked
