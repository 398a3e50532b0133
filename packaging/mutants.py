"""Seeds errors in the code, one at a time, and prints which share of them the tests find: `make mutants`.

    python packaging/mutants.py [--count 200] [--seed 0] [--since REVISION] [SUBPACKAGE ...]

Each error is one changed operator or number, or a comparison or condition that is turned round. Named constants of modules are
left alone, since most of them tune a search. The error is made in a copy of the repository under build/, and the tests of its
subpackage run there until one fails; for C++, those of all that use it. An error that no test finds is printed: a test is
missing, or it changes nothing that can be observed.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "build" / f"mutants-{os.getpid()}"
PYTEST = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0"]
TIMEOUT_S = 1200  # a test that hangs has found the error
CXX = "cpp"
# Tests of a subpackage beside tests/SUBPACKAGE: it is checked where it is used.
MORE_TESTS = {
    "control": ["tests/sim/test_compiled_loop.py"],
    "robot": ["tests/control/test_core_laws.py", "tests/motion/test_move_cartesian.py"],
}
CXX_TESTS = [f"tests/{folder}" for folder in ("robot", "control", "collision", "ik", "motion", "sim", "planning", "envs")]
DEFAULT = ["control", "robot", "ik", "motion", "collision", "design", "envs", CXX]


def both_ways(*pairs: tuple[Any, Any]) -> dict[Any, Any]:
    """A table in which each of a pair leads to the other."""
    return {one: other for pair in pairs for one, other in (pair, pair[::-1])}


COMPARISONS = both_ways((ast.Lt, ast.GtE), (ast.LtE, ast.Gt), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn))
OPERATORS = both_ways((ast.Add, ast.Sub), (ast.Mult, ast.Div)) | {ast.MatMult: ast.Mult, ast.Pow: ast.Mult}
# Replaced in code lines of C++. A unary minus and templates do not match, for operators have blanks on both sides.
CXX_PAIRS = [("+", "-"), ("*", "/"), ("<", ">="), ("<=", ">"), ("==", "!="), ("&&", "||"), ("+=", "-=")]
CXX_CHANGES = both_ways(*((f" {one} ", f" {other} ") for one, other in CXX_PAIRS))
CXX_NUMBER = re.compile(r"(?<![\w.])\d+\.\d+(e-?\d+)?")
CXX_SKIPPED = re.compile(r"^\s*(//|#|throw|template|using|namespace)|static_assert|InputError|operator")


@dataclass(frozen=True)
class Mutant:
    """A file with one error."""

    file: Path  # relative to the root
    line: int
    before: str
    after: str
    text: str


def changed(node: ast.AST) -> ast.AST | None:
    """A copy of an expression with an error; None if there is none to make."""
    new = copy.deepcopy(node)
    match new:
        case ast.Compare(ops=[operator]) if type(operator) in COMPARISONS:
            new.ops = [COMPARISONS[type(operator)]()]
        case ast.BinOp(op=operator) if type(operator) in OPERATORS:
            new.op = OPERATORS[type(operator)]()
        case ast.BoolOp(op=operator):
            new.op = ast.Or() if isinstance(operator, ast.And) else ast.And()
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            return operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value) | float(value)):
            new.value = value + 1 if isinstance(value, int) else (1.5 * value if value else 1.0)
        case ast.IfExp():
            new.body, new.orelse = new.orelse, new.body
        case _:
            return None
    return new


def expressions(node: ast.AST) -> Iterator[ast.expr]:
    """All expressions that are computed, without annotations, texts and errors that are raised."""
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
        return
    if isinstance(node, ast.expr):
        yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from expressions(child)


def python_mutants(file: Path) -> list[Mutant]:
    """All mutants of a Python file."""
    text = (WORK / file).read_text(encoding="utf-8")
    lines = text.encode().splitlines(keepends=True)
    found = []
    module = ast.parse(text)
    module.body = [statement for statement in module.body if not isinstance(statement, ast.Assign | ast.AnnAssign)]
    for node in expressions(module):
        new = changed(node)
        if new is None or node.end_lineno is None:
            continue
        start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
        end = sum(map(len, lines[: node.end_lineno - 1])) + (node.end_col_offset or 0)
        source = text.encode()
        after = f"({ast.unparse(new)})"
        mutated = source[:start] + after.encode() + source[end:]
        found.append(Mutant(file, node.lineno, source[start:end].decode(), after, mutated.decode()))
    return found


def cxx_mutants(file: Path) -> list[Mutant]:
    """All mutants of a C++ file."""
    lines = (WORK / file).read_text(encoding="utf-8").splitlines(keepends=True)
    found = []
    for number, line in enumerate(lines):
        code = line.partition("//")[0]
        if CXX_SKIPPED.search(line):
            continue
        spots = [
            (match.start(), before, after)
            for before, after in CXX_CHANGES.items()
            for match in re.finditer(re.escape(before), code)
        ]
        spots += [(match.start(), match[0], f"(1.5 * {match[0]} + 1e-3)") for match in CXX_NUMBER.finditer(code)]
        for place, before, after in spots:
            new = line[:place] + after + line[place + len(before) :]
            text = "".join([*lines[:number], new, *lines[number + 1 :]])
            found.append(Mutant(file, number + 1, line.strip(), new.strip(), text))
    return found


def files_of(subpackage: str, since: str | None) -> list[Path]:
    """The files of a subpackage, or of those only the ones that changed since a revision."""
    suffix = "[ch]pp" if subpackage == CXX else "py"
    folder = WORK / "armctl" / subpackage
    files = sorted(path.relative_to(WORK) for path in folder.rglob(f"*.{suffix}") if "bindings" not in path.parts)
    if since is None:
        return files
    command = ["git", "diff", "--name-only", since]
    names = set(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())
    return [file for file in files if str(file) in names]


def tests_of(mutant: Mutant) -> list[str]:
    """Arguments of pytest: the tests of the file first, then the others of its subpackage."""
    subpackage = mutant.file.parts[1]
    if subpackage == CXX:
        return CXX_TESTS
    folder = WORK / "tests" / subpackage
    own = [str(path.relative_to(WORK)) for path in sorted(folder.glob(f"test_*{mutant.file.stem.split('_')[0]}*.py"))]
    rest = [str(path.relative_to(WORK)) for path in sorted(folder.glob("test_*.py"))]
    return list(dict.fromkeys([*own, *rest, *MORE_TESTS.get(subpackage, [])]))


def prepare() -> None:
    """Copies the repository, with its compiled core."""
    shutil.copytree(
        ROOT, WORK, symlinks=True, ignore=shutil.ignore_patterns(".git", "build", ".venv", ".lowest", "__pycache__", "_build")
    )


def run(command: list[str]) -> tuple[bool, str]:
    """Whether a command succeeds in the copy, in time, and what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(WORK), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(command, cwd=WORK, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return False, ""
    return done.returncode == 0, done.stdout


@cache
def check_test(test: str) -> None:
    """Ends the program if a test that found an error also fails without one."""
    passes, output = run([*PYTEST, test])
    if not passes:
        raise SystemExit(f"{test} fails without an error in the code:\n{output}")


def is_found(mutant: Mutant) -> bool:
    """Whether a test, or the compiler, finds the error."""
    build = [sys.executable, "packaging/build_backend/armctl_build.py"]
    target = WORK / mutant.file
    original = target.read_text(encoding="utf-8")
    target.write_text(mutant.text, encoding="utf-8")
    try:
        is_cxx = mutant.file.suffix != ".py"
        if is_cxx and not run(build)[0]:
            return True
        passes, output = run([*PYTEST, *tests_of(mutant)])
    finally:
        target.write_text(original, encoding="utf-8")
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", output, re.MULTILINE)
    if failed and not is_cxx:
        check_test(failed[1])
    return not passes


def main() -> int:
    """Prints the share found of each subpackage, and the errors that were not found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("subpackages", nargs="*", default=DEFAULT)
    parser.add_argument("--count", type=int, default=200, help="errors in all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--since", help="only files that changed since this revision of git")
    args = parser.parse_args()
    prepare()
    try:
        tally = seed_errors(args.subpackages, args.count, args.since, random.Random(args.seed))
    finally:
        shutil.rmtree(WORK)
    print("\n| subpackage | errors | found |\n|---|---|---|")
    for subpackage, found in tally.items():
        print(f"| {subpackage} | {len(found)} | {100 * sum(found) / len(found):.0f} % |")
    return 0


def seed_errors(subpackages: list[str], count: int, since: str | None, rng: random.Random) -> dict[str, list[bool]]:
    """Whether each of some random errors was found, by subpackage."""
    tally: dict[str, list[bool]] = {}
    for k, subpackage in enumerate(sorted(subpackages, key=CXX.__eq__)):  # the last error in C++ remains compiled
        make = cxx_mutants if subpackage == CXX else python_mutants
        mutants = [mutant for file in files_of(subpackage, since) for mutant in make(file)]
        share = count * (k + 1) // len(subpackages) - count * k // len(subpackages)
        for mutant in rng.sample(mutants, min(share, len(mutants))):
            found = is_found(mutant)
            tally.setdefault(subpackage, []).append(found)
            verdict = "found" if found else "NOT FOUND"
            change = f"{mutant.before:.100}  ->  {mutant.after:.100}".replace("\n", " ")
            print(f"{verdict}: {mutant.file}:{mutant.line}: {change}", flush=True)
    return tally


if __name__ == "__main__":
    sys.exit(main())
