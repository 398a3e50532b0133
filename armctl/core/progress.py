"""Progress bars on stderr, for work that may take longer than a few seconds."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

DELAY_S = 2.0  # shorter work shows no bar


class ProgressBar(Protocol):
    """What `progress_bar` gives to its block."""

    def update(self, n: float | None = 1) -> object:
        """Counts n more pieces of work as done."""
        ...


class _NoBar:
    def update(self, n: float | None = 1) -> None:
        pass


@contextmanager
def progress_bar(description: str, total: int, unit: str) -> Iterator[ProgressBar]:
    """A bar that appears after `DELAY_S` if stderr is a terminal; otherwise nothing is printed.

    Args:
        description: What is being done, in a word or two.
        total: The number of pieces of work.
        unit: What one piece is called.

    Yields:
        The bar; call its `update`.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield _NoBar()
        return
    from tqdm import tqdm

    class Bar(tqdm):
        monitor_interval = 0  # without tqdm's thread, which would outlive the bar

    with Bar(
        desc=description, total=total, unit=f" {unit}", delay=DELAY_S, miniters=1, file=sys.stderr, dynamic_ncols=True
    ) as bar:
        yield bar
