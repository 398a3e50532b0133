"""Progress bars on stderr, for work that may take longer than a few seconds."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

DELAY_S = 2.0  # shorter work shows no bar
LINE_INTERVAL_S = 10.0  # between two lines if stderr is no terminal


class ProgressBar(Protocol):
    """What `progress_bar` gives to its block."""

    def update(self, n: float | None = 1) -> object: ...


class _Lines:
    """Progress as plain lines, for files and pipes."""

    def __init__(self, description: str, total: int, unit: str):
        self._description = description
        self._total = total
        self._unit = unit
        self._done = 0.0
        self._printed_at = time.monotonic()

    def update(self, n: float | None = 1) -> None:
        self._done += n or 0
        now = time.monotonic()
        if now - self._printed_at >= LINE_INTERVAL_S and sys.stderr is not None:
            self._printed_at = now
            print(f"{self._description}: {self._done:g} of {self._total} {self._unit}", file=sys.stderr, flush=True)


@contextmanager
def progress_bar(description: str, total: int, unit: str) -> Iterator[ProgressBar]:
    """A bar that appears after `DELAY_S` if stderr is a terminal; otherwise a line every `LINE_INTERVAL_S`."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield _Lines(description, total, unit)
        return
    from tqdm import tqdm

    class Bar(tqdm):
        monitor_interval = 0  # without tqdm's thread, which would outlive the bar

    with Bar(
        desc=description, total=total, unit=f" {unit}", delay=DELAY_S, miniters=1, file=sys.stderr, dynamic_ncols=True
    ) as bar:
        yield bar
