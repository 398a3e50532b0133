"""LatestWorker: runs slow work of the page in one thread, newest order only."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

_log = logging.getLogger("armctl.viewer")


class LatestWorker:
    """One daemon thread. An order that has not begun is replaced by a newer one, so a flood of orders costs one thread."""

    def __init__(self, name: str):
        """Starts the thread."""
        self._order: Callable[[], object] | None = None
        self._ordered = threading.Condition()
        self._closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, order: Callable[[], object]) -> None:
        """Runs a function soon, unless a newer one comes first. Its exceptions go to the log."""
        with self._ordered:
            self._order = order
            self._ordered.notify()

    def close(self) -> None:
        """Ends the thread after the work that it does now, if any."""
        with self._ordered:
            self._closed = True
            self._ordered.notify()

    def _run(self) -> None:
        while True:
            with self._ordered:
                self._ordered.wait_for(lambda: self._closed or self._order is not None)
                if self._closed or self._order is None:
                    return
                order = self._order
                self._order = None
            try:
                order()
            except Exception:
                _log.exception("work for the page failed")
