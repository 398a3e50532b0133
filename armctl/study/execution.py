"""Making the runs of a study on an executor. Executors schedule; this module hands out chunks and notes what is finished."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from math import ceil

from armctl.core.errors import ArmctlError
from armctl.study.bench import Bench, Outcome, Run, failed_outcome

# A run takes 1 to 20 ms and a task of a cluster costs about 1.5 ms; a chunk is what is lost if its worker dies.
_MIN_CHUNK = 8
_MAX_CHUNK = 64
_CHUNKS_OF_SMALL_STUDY = 64
_MAX_PENDING = 256  # chunks that are handed out at a time, which bounds the memory of the scheduler

Note = Callable[[Sequence[Run], Sequence[Outcome], bool], None]  # runs, outcomes, and whether they are final


def execute_here(bench: Bench, runs: Sequence[Run], note: Note) -> None:
    """Makes runs on all cores, in threads of this process: the compiled tick loop does not hold Python's lock."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with ThreadPoolExecutor(processors) as threads:
        execute(bench.outcomes, runs, threads, note)


def execute(work: Callable[[Sequence[Run]], list[Outcome]], runs: Sequence[Run], executor: Executor, note: Note) -> None:
    """Makes runs on an executor; `note` is called in this thread with each chunk that is finished.

    Raises ArmctlError if the workers cannot load the robot, or the executor has stopped. What was finished has been noted.
    """
    pending: dict[Future[list[Outcome]], Sequence[Run]] = {}
    waiting = deque(_chunks(runs))
    try:
        while waiting or pending:
            while waiting and len(pending) < _MAX_PENDING:
                chunk = waiting.popleft()
                pending[executor.submit(work, chunk)] = chunk
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                chunk = pending.pop(future)
                error = future.exception()
                if error is None:
                    note(chunk, future.result(), True)
                elif isinstance(error, ArmctlError | BrokenExecutor):
                    raise error
                elif len(chunk) > 1:  # one of these runs may end its worker: find out which
                    waiting.extendleft([run] for run in chunk)
                else:
                    note(chunk, [_lost(error)], False)
    except (BrokenExecutor, CancelledError) as error:
        why = f"{type(error).__name__}: {error!s:.120}"
        raise ArmctlError(f"the executor has stopped ({why}); run the study again to make the runs that remain") from None
    finally:
        for future, chunk in pending.items():
            if not future.cancel() and future.done() and not future.cancelled() and future.exception() is None:
                note(chunk, future.result(), True)


def _chunks(runs: Sequence[Run]) -> Iterator[Sequence[Run]]:
    size = min(max(_MIN_CHUNK, ceil(len(runs) / _CHUNKS_OF_SMALL_STUDY)), _MAX_CHUNK)
    for first in range(0, len(runs), size):
        yield runs[first : first + size]


def _lost(error: BaseException) -> Outcome:
    return failed_outcome(f"its worker failed ({type(error).__name__}: {error!s:.200})")
