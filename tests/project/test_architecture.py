"""The house: every module has a floor, imports go down, modules and functions stay short, and importing armctl is cheap."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import armctl

PACKAGE = Path(armctl.__file__).parent

MODULE_LINES = 500
FUNCTION_LINES = 50  # without its docstring

# Modules that are long for a reason. A line goes when its module is split.
LONG = {
    "armctl.ik.kernel": "numba's disk cache notices changes in a function's own file only",
}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 2 else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {module: ast.parse(path.read_text(encoding="utf-8")) for module, path in MODULES.items()}
every_module = pytest.mark.parametrize("module", MODULES)


@every_module
def test_a_module_is_short(module: str):
    lines = len(MODULES[module].read_text(encoding="utf-8").splitlines())
    if module in LONG:
        assert lines > MODULE_LINES, f"{module} is short now: take it out of LONG"
    else:
        assert lines <= MODULE_LINES, f"{module} has {lines} lines and asks to be split by meaning"


@every_module
def test_a_function_is_short(module: str):
    for node in ast.walk(TREES[module]):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        documented = isinstance(node.body[0], ast.Expr) and ast.get_docstring(node, clean=False) is not None
        docstring = (node.body[0].end_lineno or 0) - node.body[0].lineno + 1 if documented else 0
        lines = (node.end_lineno or 0) - node.lineno + 1 - docstring
        assert lines <= FUNCTION_LINES, f"{module}.{node.name} has {lines} lines and asks to be split by meaning"


@pytest.mark.parametrize("name", armctl.__all__)
def test_a_public_name_is_there_and_documented(name: str):
    value = getattr(armctl, name)
    assert value.__doc__, f"armctl.{name} has no docstring"
    assert name in dir(armctl)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No armctl attribute lode"):
        _ = armctl.lode


def loaded(code: str, modules: list[str]) -> list[str]:
    """Which of the modules a new Python has loaded after running some code."""
    code = f"import sys\n{code}\nprint(*[name for name in {modules} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_importing_armctl_loads_nothing_heavy():
    heavy = ["numpy", "mujoco", "pinocchio", "numba", "mink", "matplotlib", "ruckig", "toppra", "scipy", "viser"]
    assert loaded("import armctl", heavy) == []


def test_what_few_functions_need_waits_for_them():
    code = "import armctl\nfor name in armctl.__all__: getattr(armctl, name)"
    assert loaded(code, ["numba", "mink", "matplotlib", "viser"]) == []
