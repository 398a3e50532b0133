"""LatestWorker: runs slow work in one thread, newest order only."""

import logging
import threading
from collections.abc import Callable

_JOIN_TIMEOUT_S = 2.0

_log = logging.getLogger("armctl")


class LatestWorker:
    """One daemon thread. An order that has not begun is replaced by a newer one, so a flood of orders costs one thread."""

    def __init__(self, name: str):
        self._order: Callable[[], object] | None = None
        self._ordered = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_closed(self) -> bool:
        """Whether the thread ends after the work that it does now: what shows the result may be gone by then."""
        return self._closed

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
        self._thread.join(timeout=_JOIN_TIMEOUT_S)

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
                _log.exception("work in the background failed")
            del order  # what it refers to must not live until the next order
