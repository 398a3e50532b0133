"""Seeds errors in the code, one at a time, and prints which share of them the tests find: `make mutants`.

    python packaging/mutants.py [--count 200] [--seed 0] [--seconds 40] [--since REVISION] [SUBPACKAGE ...]

Each error is one changed operator or number, or a comparison or condition that is turned round. What cannot be observed, or
only tunes a search, is left alone: texts, warnings, types, seeds, `__repr__`, caches, tolerances, thresholds of rounding,
named constants of modules, and code whose tests need a package that is not here. The error is made in a copy of the
repository under build/, and tests of `make test` run there until one fails: those of the subpackage, of which the ones that
call the changed function come first, the quick ones before the slow ones, and others that call it, for 40 s in all. Which
test calls which function is recorded once, in build/mutants.json. An error that no test finds is printed: a test is missing,
or it changes nothing that can be observed.

Errors in C++ are compiled together as far as they are expressions within a line, each behind a switch that SEEDED_ERROR turns
on and that notes when it is reached. All tests of the core run once without an error, which tells which of them reach which.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import hashlib
import importlib
import importlib.util
import itertools
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from mutations import CXX_MOST, CXX_SWITCH, Mutant, cxx_mutants, python_mutants, switched

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "build" / f"mutants-{os.getpid()}"
RECORD = ROOT / "build" / "mutants.json"
REACHED = "reached.bin"
# Imported once, before the processes of the tests are forked.
PRELOADED = ("scipy.optimize", "scipy.signal", "scipy.stats", "mujoco", "pinocchio", "matplotlib.pyplot", "mink")
TIMEOUT_S = 600.0  # a test that hangs has found the error
MEMORY_BYTES = 8 << 30  # an error that allocates without end must not take the computer's memory
CXX = "cpp"
# Tests of a subpackage such as plan/ik beside tests/SUBPACKAGE: it is checked where it is used.
MORE_TESTS = {"control": ["run/sim"], "model/arm": ["control", "plan/motion"]}
# The tests that judge the core.
CXX_TESTS = ["core", "model/arm", "model/collision", "control", "plan", "run/sim", "envs"]
DEFAULT = ["control", "model/arm", "plan/ik", "plan/motion", "model/collision", "lab", "envs", CXX]
Record = dict[str, dict[str, Any]]


def build_switched(mutants: list[Mutant]) -> list[Mutant]:
    """Builds the core once with many errors, of which SEEDED_ERROR chooses one by its number; returns those in it, by number.

    Errors that do not compile so, and of several errors in one line all but the first, are left out.
    """
    originals = {file: (WORK / file).read_text(encoding="utf-8") for file in {mutant.file for mutant in mutants}}
    lines = {file: text.splitlines(keepends=True) for file, text in originals.items()}
    chosen: list[Mutant] = [
        mutant
        for mutant in {(mutant.file, mutant.line): mutant for mutant in reversed(mutants)}.values()
        if switched(lines[mutant.file][mutant.line - 1], mutant.changed_line(), 0) is not None
    ]
    (WORK / "armctl" / CXX / "seeded_error.hpp").write_text(CXX_SWITCH, encoding="utf-8")
    while chosen:
        texts = {file: text.splitlines(keepends=True) for file, text in originals.items()}
        for number, mutant in enumerate(chosen):
            line = switched(texts[mutant.file][mutant.line - 1], mutant.changed_line(), number)
            assert line is not None
            texts[mutant.file][mutant.line - 1] = line
        for file, lines in texts.items():
            (WORK / file).write_text(f'#include "seeded_error.hpp"\n{"".join(lines)}', encoding="utf-8")
        failure = build()
        if failure is None:
            return chosen
        wrong = {(Path(name).name, int(line) - 1) for name, line in re.findall(r"([\w./]+\.[ch]pp):(\d+):\d+: error", failure)}
        remaining = [mutant for mutant in chosen if (mutant.file.name, mutant.line) not in wrong]
        chosen = remaining if len(remaining) < len(chosen) else []
    return []


def files_of(subpackage: str, since: str | None) -> list[Path]:
    """The files of a subpackage, or of those only the ones that changed since a revision."""
    suffix = "[ch]pp" if subpackage == CXX else "py"
    folder = WORK / "armctl" / subpackage
    files = sorted(path.relative_to(WORK) for path in folder.rglob(f"*.{suffix}") if "bindings" not in path.parts)
    files = [file for file in files if "jax" not in file.parts or importlib.util.find_spec("jax")]  # whose tests need it
    if since is None:
        return files
    command = ["git", "diff", "--name-only", since]
    names = set(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())
    return [file for file in files if str(file) in names]


@contextlib.contextmanager
def called_functions() -> Iterator[set[str]]:
    """Which functions of armctl are called, as far as they are in Python."""
    codes: set[CodeType] = set()
    names: set[str] = set()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        codes.add(frame.f_code)

    threading.settrace(note)
    sys.settrace(note)
    try:
        yield names
    finally:
        sys.settrace(None)
        threading.settrace(None)  # pyright: ignore[reportArgumentType]
        package = f"{WORK}/armctl/"
        inside = (code for code in codes if package in code.co_filename)
        names.update(f"{code.co_filename.removeprefix(f'{WORK}/')}:{code.co_qualname}" for code in inside)


@contextlib.contextmanager
def reached_errors() -> Iterator[set[str]]:
    """The numbers of the errors in C++ that are reached."""
    names: set[str] = set()
    with (WORK / REACHED).open("r+b", buffering=0) as flags:
        flags.write(bytes(CXX_MOST))
        yield names
        flags.seek(0)
        names.update(str(number) for number, flag in enumerate(flags.read()) if flag)


class Recorder:
    """A plugin of pytest that records what each test calls, and how long it takes."""

    def __init__(self, calls: Callable[[], contextlib.AbstractContextManager[set[str]]]) -> None:
        self.calls = calls
        self.tests: Record = {}
        self.failed: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        started = time.process_time()
        with self.calls() as names:
            passed = yield
        self.tests[item.nodeid] = {"seconds": round(time.process_time() - started, 3), "calls": names}
        return passed

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        passed = {test: row | {"calls": sorted(row["calls"])} for test, row in self.tests.items() if test not in self.failed}
        (WORK / "recorded.json").write_text(json.dumps(passed))


class Order:
    """A plugin of pytest that runs tests in an order, and leaves out those that are not in it."""

    def __init__(self, tests: list[str]) -> None:
        self.place = {test: k for k, test in enumerate(tests)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted((item for item in items if item.nodeid in self.place), key=lambda item: self.place[item.nodeid])


def forked(action: Callable[[], int], timeout: float) -> int:
    """What a function returns in a process of its own; not 0 if that ends by a signal or takes too long."""
    child = os.fork()
    if child == 0:
        code = 70
        try:
            os.setsid()
            resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
            code = action()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    end = time.monotonic() + timeout
    try:
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.05)
        return 1
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)


def run_pytest(arguments: list[str], plugin: object, number: int | None = None, timeout: float = TIMEOUT_S) -> int:
    """The exit code of pytest in the copy, with an error of the core chosen by its number."""

    def action() -> int:
        os.chdir(WORK)
        with open("output.txt", "w") as output:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        os.environ["PYTHONPATH"] = str(WORK)
        os.environ["SEEDED_ERROR"] = str(-1 if number is None else number)
        sys.path[:] = [str(WORK), *(path for path in sys.path if Path(path) not in (ROOT, ROOT / "packaging"))]
        code = int(
            pytest.main(
                ["-q", "-p", "no:cacheprovider", "-n", "0", "-m", "not full and not nightly", *arguments], plugins=[plugin]
            )
        )
        armctl = sys.modules.get("armctl")
        assert armctl is None or Path(str(armctl.__file__)).is_relative_to(WORK), "another armctl was tested"
        return code

    return forked(action, timeout)


def prepare() -> None:
    """Copies the repository, with its compiled core."""
    shutil.copytree(
        ROOT, WORK, symlinks=True, ignore=shutil.ignore_patterns(".git", "build", ".venv", ".lowest", "__pycache__", "_build")
    )
    (WORK / REACHED).write_bytes(bytes(CXX_MOST))
    os.environ["SEEDED_REACHED"] = str(WORK / REACHED)


def run_recorded(tests: list[str], calls: Callable[[], contextlib.AbstractContextManager[set[str]]]) -> Record:
    """What tests call that pass without an error."""
    code = run_pytest(tests, Recorder(calls), timeout=3600.0)
    if code:
        print(
            (WORK / "output.txt").read_text()[-4000:],
            f"\nthe tests above fail without an error; they judge nothing ({code})",
        )
    return json.loads((WORK / "recorded.json").read_text())


def read_record(subpackages: list[str]) -> Record:
    """The tests of subpackages and what they call; files of tests that are new or changed are run first."""
    folders = {*subpackages, *(folder for name in subpackages for folder in MORE_TESTS.get(name, []))} - {CXX}
    try:
        known = json.loads(RECORD.read_text())
    except FileNotFoundError:
        known = {}
    stamps = {
        str(path.relative_to(WORK)): hashlib.sha256(path.read_bytes()).hexdigest()
        for folder in sorted(folders)
        for path in sorted((WORK / "tests" / folder).glob("test_*.py"))
    }
    new = [file for file, stamp in stamps.items() if known.get(file, {}).get("stamp") != stamp]
    if new:
        print(f"running {len(new)} files of tests without an error", flush=True)
        recorded = run_recorded(new, called_functions)
        for file in new:
            known[file] = {"stamp": stamps[file], "tests": {}}
        for test, row in recorded.items():
            known[test.partition("::")[0]]["tests"][test] = row
        RECORD.write_text(json.dumps(known))
    return {test: row for file in stamps for test, row in known[file]["tests"].items()}


def tests_of(mutant: Mutant, record: Record, limit: float) -> list[str]:
    """The tests that judge a mutant in Python: those of its subpackage that call its function, others of both."""
    packages = [str(folder) for folder in mutant.file.relative_to("armctl").parents]
    folders = {f"tests/{folder}" for name in packages for folder in [name, *MORE_TESTS.get(name, [])]}
    name = f"{mutant.file}:{mutant.function}"
    ranked = []
    for test, row in record.items():
        own = test.rpartition("/")[0] in folders
        calls = name in row["calls"]
        if own or calls:
            ranked.append((not calls, not own, row["seconds"], test))
    return within([(test, seconds) for *_, seconds, test in sorted(ranked)], limit)


def tests_reaching(numbers: list[int], reached: Record, limit: float) -> list[str]:
    """The tests that reach one of some errors in C++, the quick ones first."""
    names = {str(number) for number in numbers}
    reaching = ((row["seconds"], test) for test, row in reached.items() if names.intersection(row["calls"]))
    return within([(test, seconds) for seconds, test in sorted(reaching)], limit)


def within(tests: list[tuple[str, float]], limit: float) -> list[str]:
    """The first tests, as far as their times are not more than a limit together; the first in any case."""
    spent = itertools.accumulate(seconds for _, seconds in tests)
    return [test for k, ((test, _), seconds) in enumerate(zip(tests, spent, strict=True)) if k == 0 or seconds < limit]


def is_found(mutant: Mutant, tests: list[str]) -> bool:
    """Whether one of some tests, or the compiler, finds the error."""
    target = WORK / mutant.file
    original = target.read_text(encoding="utf-8")
    target.write_text(mutant.text, encoding="utf-8")
    forget_compiled(target)
    try:
        if mutant.file.suffix != ".py" and build() is not None:
            return True
        return tests_fail(tests, None)
    finally:
        target.write_text(original, encoding="utf-8")
        forget_compiled(target)


def forget_compiled(file: Path) -> None:
    """Removes what Python has compiled: it tells a new text by its time in seconds."""
    for compiled in file.parent.glob(f"__pycache__/{file.stem}.*"):
        compiled.unlink()


def tests_fail(tests: list[str], number: int | None) -> bool:
    """Whether a test fails in the copy as it is, with an error of the core chosen by its number."""
    files = dict.fromkeys(test.partition("::")[0] for test in tests)
    return bool(tests) and run_pytest(["-x", *files], Order(tests), number) != 0


def build() -> str | None:
    """Builds the compiled core of the copy; returns what the compiler printed if it could not."""
    command = [sys.executable, "packaging/build_backend/armctl_build.py"]
    environment = {**os.environ, "PYTHONPATH": str(WORK)}
    done = subprocess.run(command, cwd=WORK, env=environment, capture_output=True, text=True)
    return None if done.returncode == 0 else done.stdout + done.stderr


def main() -> int:
    """Prints the share found of each subpackage, and the errors that were not found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("subpackages", nargs="*", default=DEFAULT)
    parser.add_argument("--count", type=int, default=200, help="errors in all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=40.0, help="of tests for one error (default: %(default)s)")
    parser.add_argument("--since", help="only files that changed since this revision of git")
    args = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the copy is removed, and no test goes on
    for module in PRELOADED:
        importlib.import_module(module)
    prepare()
    try:
        record = read_record(args.subpackages)
        tally = seed_errors(args, record)
    finally:
        shutil.rmtree(WORK)
    tally["all"] = [found for row in tally.values() for found in row]
    print("\n| subpackage | errors | found |\n|---|---|---|")
    for subpackage, found in tally.items():
        print(f"| {subpackage} | {len(found)} | {100 * sum(found) / max(len(found), 1):.0f} % |")
    return 0


def seed_errors(args: argparse.Namespace, record: Record) -> dict[str, list[bool]]:
    """Whether each of some random errors was found, by subpackage."""
    rng = random.Random(args.seed)
    tally: dict[str, list[bool]] = {}
    for k, subpackage in enumerate(sorted(args.subpackages, key=CXX.__eq__)):  # the last error in C++ remains compiled
        make = cxx_mutants if subpackage == CXX else python_mutants
        mutants = [
            mutant
            for file in files_of(subpackage, args.since)
            for mutant in make(file, (WORK / file).read_text(encoding="utf-8"))
        ]
        share = args.count * (k + 1) // len(args.subpackages) - args.count * k // len(args.subpackages)
        chosen = rng.sample(mutants, min(share, len(mutants)))
        originals = {file: (WORK / file).read_text(encoding="utf-8") for file in {mutant.file for mutant in chosen}}
        if subpackage == CXX:
            judged = judge_cxx(chosen, originals, args.seconds)
        else:
            judged = ((mutant, is_found(mutant, tests_of(mutant, record, args.seconds))) for mutant in chosen)
        verdicts = tally.setdefault(subpackage, [])
        for mutant, found in judged:
            verdicts.append(found)
            print_verdict(mutant, originals[mutant.file], found)
    return tally


def judge_cxx(mutants: list[Mutant], originals: dict[Path, str], limit: float) -> Iterator[tuple[Mutant, bool]]:
    """Whether the tests that reach each error in C++ find it; for one that is compiled alone, those that reach its file."""
    together = build_switched(mutants)
    reached = run_recorded([f"tests/{folder}" for folder in CXX_TESTS], reached_errors)
    for number, mutant in enumerate(together):
        yield mutant, tests_fail(tests_reaching([number], reached, limit), number)
    for file, text in originals.items():
        (WORK / file).write_text(text, encoding="utf-8")
    for mutant in mutants:
        if mutant not in together:
            same_file = [number for number, other in enumerate(together) if other.file == mutant.file]
            yield mutant, is_found(mutant, tests_reaching(same_file or [*range(len(together))], reached, limit))


def print_verdict(mutant: Mutant, original: str, found: bool) -> None:
    """Prints where an error was, and the error itself if it was not found."""
    print(f"{'found' if found else 'NOT FOUND'}: {mutant.file}:{mutant.line}", flush=True)
    if not found:
        change = difflib.unified_diff(original.splitlines(), mutant.text.splitlines(), lineterm="", n=0)
        print(*(f"    {line}" for line in list(change)[3:]), sep="\n", flush=True)


if __name__ == "__main__":
    sys.exit(main())
