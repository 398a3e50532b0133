"""Prints the size of armctl: lines of Python and of C++, and functions with many parameters. `make lint` runs it."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
MAX_PARAMETERS = 6  # of a function that is easy to call


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """The number of parameters of a function, without `self` and `cls`."""
    arguments = function.args
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    names += [argument.arg for argument in (arguments.vararg, arguments.kwarg) if argument is not None]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def functions_with_many_parameters(files: list[Path]) -> int:
    """How many functions of Python files have more parameters than `MAX_PARAMETERS`."""
    count = 0
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and parameters(node) > MAX_PARAMETERS:
                count += 1
    return count


def lines(files: list[Path]) -> int:
    """The lines of files together."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def main() -> None:
    python = sorted((ROOT / "armctl").rglob("*.py"))
    cpp = [*(ROOT / "armctl" / "cpp").rglob("*.cpp"), *(ROOT / "armctl" / "cpp").rglob("*.hpp")]
    print(f"lines of code in armctl/: {lines(python)} of Python, {lines(cpp)} of C++")
    print(f"functions of Python with more than {MAX_PARAMETERS} parameters: {functions_with_many_parameters(python)}")


if __name__ == "__main__":
    main()
