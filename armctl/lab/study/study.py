"""Study: a table of closed-loop runs over factors and controllers, on any executor, that can be stopped and continued."""

from __future__ import annotations

import json
import os
import sqlite3
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from math import ceil
from pathlib import Path

from armctl.core.atomic import file_path
from armctl.core.errors import ArmctlError, ArmctlWarning, InputError
from armctl.core.progress import progress_bar
from armctl.core.validation import flag, instance, shown
from armctl.lab.study.factors import examples
from armctl.lab.study.plan import StudyPlan
from armctl.lab.study.study_result import StudyResult, study_result
from armctl.lab.study.study_runner import (
    CONTROLLER_FACTOR,
    FIGURES,
    Outcome,
    StudyRun,
    failed_outcome,
    make_controller,
    run_chunk,
    versions,
)
from armctl.run.sim.simulate import processors

# A run takes 1 to 20 ms and a task of a cluster costs about 1.5 ms; a chunk is what is lost if its worker dies.
_MIN_CHUNK = 8
_MAX_CHUNK = 64
_CHUNKS_OF_SMALL_STUDY = 64
_MAX_PENDING = 256  # chunks that are handed out at a time, which bounds the memory of the scheduler

Note = Callable[[Sequence[StudyRun], Sequence[Outcome], bool], None]  # runs, outcomes, and whether they are final
_BUSY_S = 30.0  # how long to wait for another program that writes the same file
_KEYS_PER_QUERY = 500


def execute(
    work: Callable[[Sequence[StudyRun]], list[Outcome]], runs: Sequence[StudyRun], executor: Executor, note: Note
) -> None:
    """Makes runs on an executor; `note` is called in this thread with each chunk that is finished.

    Raises ArmctlError if the workers cannot load the robot, or the executor has stopped. What was finished has been noted.
    """
    pending: dict[Future[list[Outcome]], Sequence[StudyRun]] = {}
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
                    note(chunk, [failed_outcome(f"its worker failed ({type(error).__name__}: {error!s:.200})")], False)
    except (BrokenExecutor, CancelledError) as error:
        why = f"{type(error).__name__}: {error!s:.120}"
        raise ArmctlError(f"the executor has stopped ({why}); run the study again to make the runs that remain") from None
    finally:
        for future, chunk in pending.items():
            if not future.cancel() and future.done() and not future.cancelled() and future.exception() is None:
                note(chunk, future.result(), True)


def _chunks(runs: Sequence[StudyRun]) -> Iterator[Sequence[StudyRun]]:
    size = min(max(_MIN_CHUNK, ceil(len(runs) / _CHUNKS_OF_SMALL_STUDY)), _MAX_CHUNK)
    for first in range(0, len(runs), size):
        yield runs[first : first + size]


class Study(StudyPlan):
    """Many runs of a motion: every controller at every point of the factors, `repeats` times with different noise.

    A study is plain data, and so is each of its runs, about 200 bytes. The seed of a run follows from what it is (the study,
    the values of the factors, the repetition), not from when or where it is made, nor from the controller. All controllers
    therefore run with the same noise, and their differences are paired.

    A factor is a field of `Plant` (payload, mass_scale, coulomb_friction, viscous_friction, delay, encoder_noise, ...), or:
    "friction", Coulomb friction as a fraction of the torque limits and half as much viscous friction per rad/s; "noise", of
    measurements, times 1e-5 rad and 1e-3 rad/s; "speed", a fraction of the motion's full speed; "target", the position of the
    tip for the motion "reach"; or "controller." and an argument of all controllers, such as "controller.bandwidth". Its value
    is a list, of which every value is combined with every other, or a `Range`, `Normal` or `Choice`.

    Attributes:
        name: Names the study and its files; part of the seeds.
        robot: The name or file of the robot, or a dict of the arguments of `load`.
        controllers: Names of controllers, or a dict: label to a name, or to a dict of "controller" and its arguments. A name
            such as "module:Class" is a class that is called with the arm; workers must be able to import it.
        motion: "out-and-back", all joints at once from home and back; "reach", from home to the factor "target"; the .npz file
            of a motion; or a motion.
        factors: The factors by name; a single value is the same for all runs.
        repeats: The number of runs at each point, with different noise.
        samples: The number of samples of the distributions among the factors: a power of 2, unless `sampling` is "lhs".
        sampling: "sobol", a scrambled Sobol sequence, of which more samples keep the first ones; "lhs", a Latin hypercube;
            "saltelli", the points that `StudyResult.sensitivity` needs: (d + 2) samples for d distributions.
        dwell: s to hold the end of the motion.
        tolerance: m, the largest distance at which the tip is at its goal.
    """

    def run(
        self, executor: Executor | None = None, *, folder: str | os.PathLike[str] = ".", progress: bool = True
    ) -> StudyResult:
        """Makes all runs that are not yet finished, and returns the results of all.

        Finished runs are stored in the file NAME.sqlite. If the program or a worker is interrupted, a second call makes only
        the remaining runs, with the same bits. Results of other versions of armctl, MuJoCo, Pinocchio or NumPy are kept,
        but not mixed with these.

        Args:
            executor: Where the runs are made: any `concurrent.futures.Executor`, such as a `ProcessPoolExecutor`, or
                `dask.distributed.Client(address).get_executor(pure=False)` for a cluster; None for this process. It is not shut
                down. Processes that are started by spawning need `if __name__ == "__main__":` in the script.
            progress: Whether a bar shows the progress, if stderr is a terminal.

        Returns:
            The results. A run that failed is a row with the reason.

        Raises:
            InputError: A factor, a controller or the motion does not fit the robot, or the file is none of a study.
            UnknownNameError: There is no such robot or controller.
            ArmctlError: The robot cannot be loaded, the file cannot be written, or the executor has stopped. What was finished
                is kept, as after Ctrl-C.
        """
        if executor is not None and not callable(getattr(executor, "submit", None)):
            raise InputError(
                f"executor: expected Executor, got {shown(executor)}; for Dask pass client.get_executor(pure=False)"
            )
        flag("progress", progress)
        self._check()
        with self._store(folder) as store:
            finished = store.outcomes(self.runs, final=True)
            todo = [run for run in self.runs if run.key not in finished]
            others = 0 if finished else store.of_other_versions()
            if others:
                message = f"{self.name}: {others} runs of other versions are kept, but not used; now {versions()}"
                warnings.warn(ArmctlWarning(message), stacklevel=2)
            with progress_bar("study", len(todo) if progress else 0, "runs") as bar:

                def note(runs: Sequence[StudyRun], outcomes: Sequence[Outcome], final: bool) -> None:
                    store.add(runs, outcomes, final=final)
                    if progress:
                        bar.update(len(runs))

                if executor is None:  # the compiled tick loop does not hold Python's lock
                    with ThreadPoolExecutor(processors()) as threads:
                        execute(self.runner.outcomes, todo, threads, note)
                else:
                    execute(partial(run_chunk, json.dumps(self.setup)), todo, executor, note)
            return study_result(self, store.outcomes(self.runs))

    def result(self, folder: str | os.PathLike[str] = ".") -> StudyResult:
        """The results of the runs that are finished, without making any; not `ok` if runs are missing.

        Raises:
            InputError: The file is none of a study.
            ArmctlError: The file cannot be used.
        """
        with self._store(folder) as store:
            return study_result(self, store.outcomes(self.runs))

    def _store(self, folder: str | os.PathLike[str]) -> Store:
        instance("folder", folder, (str, os.PathLike), "give the name of a folder")
        return Store(file_path("folder", os.path.join(folder, f"{self.name}.sqlite")), versions())

    def _check(self) -> None:
        """Builds every controller, and a plant and a motion for the extreme values of each factor, before anything runs."""
        for label, spec in self.controllers.items():
            make_controller(label, spec, self.runner.arm)
        first = self.runs[0]
        for name, factor in self.factors.items():
            for value in examples(factor, (run.point[name] for run in self.runs)):
                run = first._replace(point={**first.point, name: value})
                self.runner.check_plant(run)
                if name == "speed":
                    self.runner.motion(run.point)
                if name.startswith(CONTROLLER_FACTOR):
                    for label in self.controllers:
                        self.runner.controller(run._replace(controller=label))


class Store:
    """The file of a study. Only the program that runs the study writes; each `add` is one transaction."""

    def __init__(self, path: Path, versions: str):
        self._path = path
        self._versions = versions
        with self._one_sentence():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, timeout=_BUSY_S)
            self._db.execute("pragma journal_mode = wal")  # a transaction is one sequential write; readers do not wait
            self._db.execute("pragma synchronous = normal")
            self._db.execute(
                "create table if not exists runs (key text primary key, versions text, run text, outcome text, final integer)"
            )
            self._db.commit()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exception: object) -> None:
        self._db.close()

    def add(self, runs: Sequence[StudyRun], outcomes: Iterable[Outcome], *, final: bool = True) -> None:
        """Adds finished runs. Those that are not final are made again by the next start."""
        rows = [
            (run.key, self._versions, json.dumps(run[1:]), json.dumps(outcome), int(final))
            for run, outcome in zip(runs, outcomes, strict=True)
        ]
        with self._one_sentence(), self._db:
            self._db.executemany("insert or replace into runs values (?, ?, ?, ?, ?)", rows)

    def outcomes(self, runs: Sequence[StudyRun], *, final: bool = False) -> dict[str, Outcome]:
        """The outcomes of those runs that are finished, by key; with `final`, only of those that are not made again."""
        found: dict[str, Outcome] = {}
        condition = " and final" if final else ""
        with self._one_sentence():
            for first in range(0, len(runs), _KEYS_PER_QUERY):
                keys = [run.key for run in runs[first : first + _KEYS_PER_QUERY]]
                marks = ", ".join("?" * len(keys))
                query = f"select key, outcome from runs where key in ({marks}){condition}"
                found.update((key, _outcome(text)) for key, text in self._db.execute(query, keys))
        return found

    def of_other_versions(self) -> int:
        """How many runs were made with other versions."""
        with self._one_sentence():
            return self._db.execute("select count(*) from runs where versions != ?", [self._versions]).fetchone()[0]

    @contextmanager
    def _one_sentence(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise ArmctlError(f"{self._path!s:.160}: cannot be used: {error}") from None
        except (sqlite3.DatabaseError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{self._path!s:.160}: it is not a file of a study ({error!s:.120})") from None
        except OSError as error:
            raise ArmctlError(f"{self._path!s:.160}: cannot be used: {error.strerror or error}") from None


def _outcome(text: str) -> Outcome:
    """An outcome from its JSON; ValueError if it is something else."""
    outcome = json.loads(text)
    if not isinstance(outcome, dict) or outcome.keys() != failed_outcome("").keys():
        raise ValueError("a run has no outcome")
    if not all(isinstance(outcome[name], float | None) for name in FIGURES):
        raise ValueError("a figure is not a number")
    return outcome
