"""Fixtures of the random tests.

Each test runs a fixed number of cases, the same in every run of the suite, and then continues until `fuzz_seconds` have passed.
`fuzz_seconds` is 0 unless `--fuzz-minutes` is given (`make fuzz SEED=1 MINUTES=10`).
"""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All random tests are left to the nightly job."""
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker("nightly")


@pytest.fixture
def fuzz_seed(request: pytest.FixtureRequest) -> int:
    """Seed of the random cases, `--fuzz-seed`."""
    return request.config.getoption("--fuzz-seed")


@pytest.fixture
def fuzz_seconds(request: pytest.FixtureRequest) -> float:
    """Time for one test: its share of `--fuzz-minutes`, 0 in the suite."""
    tests = sum("fuzz_seconds" in getattr(item, "fixturenames", ()) for item in request.session.items)
    workers = min(int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")), tests)
    return 60.0 * request.config.getoption("--fuzz-minutes") * workers / tests


@pytest.fixture
def fuzz_motions(request: pytest.FixtureRequest) -> int:
    """The least number of motions of every kind for each arm, `--fuzz-motions`."""
    return request.config.getoption("--fuzz-motions")


@pytest.fixture
def fuzz_first(request: pytest.FixtureRequest) -> int:
    """The number of the first case, `--fuzz-first`: where an earlier run ended."""
    return request.config.getoption("--fuzz-first")


@pytest.fixture
def fuzz_cases(fuzz_seed: int, fuzz_seconds: float, fuzz_first: int) -> Callable[[int], Iterator[np.random.Generator]]:
    """One random generator per case: at least `min_cases` of them, and more until `fuzz_seconds` have passed.

    Case i of a seed is the same in every run: `np.random.default_rng([seed, i])`.
    """

    def cases(min_cases: int) -> Iterator[np.random.Generator]:
        end = time.monotonic() + fuzz_seconds
        case = fuzz_first
        while case < fuzz_first + min_cases or time.monotonic() < end:
            yield np.random.default_rng([fuzz_seed, case])
            case += 1

    return cases
