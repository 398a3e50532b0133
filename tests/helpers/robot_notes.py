"""Notes which tests ask for no installed robot: without robots they do the same, so they need not run again."""

import multiprocessing.process
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import mujoco_menagerie as menagerie
import pytest

NOTES_OF_PROCESSES = "ARMCTL_TEST_NOTES"
_HOOK = Path(__file__).parent / "process_hook"


class RobotNotes:
    """A plugin that appends the tests to a file that asked for no installed robot.

    A process that a test starts notes for itself whether it imports Menagerie, see `process_hook`. If it cannot, because it has
    another environment, its test counts as one that asked.
    """

    def __init__(self, file: Path):
        self._file = file
        self._asked = 0
        self._fixtures: set[tuple[str, str]] = set()  # that asked: where they are known, and their name
        self._independent: list[str] = []
        self._folder = tempfile.TemporaryDirectory()
        self._processes = Path(self._folder.name) / "notes"
        self._processes.touch()
        os.environ[NOTES_OF_PROCESSES] = str(self._processes)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(_HOOK), os.environ.get("PYTHONPATH")]))
        sys.path.insert(0, str(_HOOK))  # some tests give their own path to a process
        self._wrap(menagerie.Cache, "__init__")
        self._wrap(multiprocessing.process.BaseProcess, "start")
        self._wrap(subprocess.Popen, "__init__")

    def _wrap(self, kind: type, name: str) -> None:
        """Counts the calls of a method; those that start a process only if it cannot note anything itself."""
        method = getattr(kind, name)

        def counted(*arguments, **options):
            environment = options.get("env") or os.environ
            is_hooked = NOTES_OF_PROCESSES in environment and str(_HOOK) in environment.get("PYTHONPATH", "")
            self._asked += not (kind is subprocess.Popen and is_hooked)
            return method(*arguments, **options)

        setattr(kind, name, counted)

    def _count(self) -> int:
        return self._asked + self._processes.stat().st_size

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef) -> Iterator[None]:
        before = self._count()
        try:
            return (yield)
        finally:
            if self._count() > before and fixturedef.scope != "function":
                self._fixtures.add((fixturedef.baseid, fixturedef.argname))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        before = self._count()
        result = yield
        if self._count() == before and not self._uses_asking_fixture(item):
            self._independent.append(item.nodeid)
        return result

    def _uses_asking_fixture(self, item: pytest.Item) -> bool:
        return any(item.nodeid.startswith(base) and name in item.fixturenames for base, name in self._fixtures)

    def pytest_sessionfinish(self) -> None:
        with self._file.open("a", encoding="utf-8") as file:
            file.writelines(f"{test}\n" for test in self._independent)
        self._folder.cleanup()
