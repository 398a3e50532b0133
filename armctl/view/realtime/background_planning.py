"""BackgroundPlanning: plans in another thread, where only the last request counts."""

from __future__ import annotations

import logging
from collections.abc import Callable

from armctl.core.latest_worker import LatestWorker
from armctl.core.target import Target
from armctl.run.execution.move import PlannedMove

_log = logging.getLogger("armctl.run.sim")


class BackgroundPlanning:
    """At most one request, and its answer. The thread starts with the first request."""

    def __init__(self) -> None:
        self._worker: LatestWorker | None = None
        self._request: object = None
        self._answer: tuple[object, PlannedMove] | None = None  # to which request, and what was planned

    @property
    def move(self) -> PlannedMove | None:
        """The answer to the request; None as long as there is none."""
        answer = self._answer
        return answer[1] if answer is not None and answer[0] is self._request else None

    def begin(self, plan: Callable[[], PlannedMove], target: Target) -> None:
        """Requests a plan of a motion to a target, in place of the request before."""
        request = object()
        self._request = request

        def answer() -> None:
            try:
                move = plan()
            except Exception as error:
                _log.exception("planning failed")
                move = PlannedMove(target, refusal=f"planning failed: {error}")
            self._answer = (request, move)

        if self._worker is None:
            self._worker = LatestWorker("armctl planning")
        self._worker.submit(answer)

    def cancel(self) -> None:
        """Forgets the request and its answer."""
        self._request = None
        self._answer = None

    def close(self) -> None:
        if self._worker is not None:
            self._worker.close()
