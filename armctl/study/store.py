"""Store: the finished runs of a study in an SQLite file, which survives whatever ends the program."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from armctl.core.errors import ArmctlError, InputError
from armctl.study.bench import FIGURES, Outcome, Run, failed_outcome

_BUSY_S = 30.0  # how long to wait for another program that writes the same file
_KEYS_PER_QUERY = 500


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

    def add(self, runs: Sequence[Run], outcomes: Iterable[Outcome], *, final: bool = True) -> None:
        """Adds finished runs. Those that are not final are made again by the next start."""
        rows = [
            (run.key, self._versions, json.dumps(run[1:]), json.dumps(outcome), int(final))
            for run, outcome in zip(runs, outcomes, strict=True)
        ]
        with self._one_sentence(), self._db:
            self._db.executemany("insert or replace into runs values (?, ?, ?, ?, ?)", rows)

    def outcomes(self, runs: Sequence[Run], *, final: bool = False) -> dict[str, Outcome]:
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
