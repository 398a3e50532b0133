"""The form of the source: short modules, plain assignments, and an import that loads nothing heavy.

`make lint` checks the rest: the layers and cycles (import-linter) and the length of functions (ruff).
"""

import subprocess
import sys
from pathlib import Path

import pytest

import armctl

PACKAGE = Path(armctl.__file__).parent
MAX_MODULE_LINES = 500

# Modules that are long for a reason. A row goes when its module is split.
LONG_MODULES = {
    "collision/kernel.py": "numba's disk cache notices changes in a function's own file only",
    "ik/kernel.py": "numba's disk cache notices changes in a function's own file only",
}

SOURCES = {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


def test_the_package_contains_subpackages_only():
    files = {path.name for path in PACKAGE.iterdir() if path.is_file()}
    assert files == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed"}
    folders = [path for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"]
    assert all((folder / "__init__.py").is_file() for folder in folders), folders


def test_a_module_is_short():
    lines = {module: len(text.splitlines()) for module, text in SOURCES.items()}
    long = {module for module, count in lines.items() if count > MAX_MODULE_LINES}
    assert long == set(LONG_MODULES)


def test_every_public_name_is_listed_by_dir():
    assert set(armctl.__all__) <= set(dir(armctl))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No armctl attribute lode"):
        _ = armctl.lode


def loaded(code: str, modules: list[str]) -> list[str]:
    """The modules of a list that a new Python has loaded after it ran some code."""
    code = f"import sys\n{code}\nprint(*[name for name in {modules} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_importing_armctl_loads_nothing_heavy():
    heavy = ["numpy", "mujoco", "pinocchio", "numba", "mink", "matplotlib", "ruckig", "toppra", "scipy", "viser"]
    assert loaded("import armctl", heavy) == []


def test_packages_that_few_functions_need_are_loaded_by_those_functions():
    code = "import armctl\nfor name in armctl.__all__: getattr(armctl, name)"
    assert loaded(code, ["numba", "mink", "matplotlib", "viser"]) == []
