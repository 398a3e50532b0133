"""The rooms up to `run` work where the folders of the wings (`lab`, `view`, `envs`, `cli`) are missing."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import armctl

PACKAGE = Path(armctl.__file__).parent
TESTS = Path(__file__).parents[1]
WINGS = ("lab", "view", "envs", "cli")
JUDGES = ("core", "model/arm", "plan/ik/test_solve_ik.py", "run/sim/test_moves.py", "run/sim/test_core_loop.py")
# Files of studies, identification, and why a loop is unstable, which the top-level package asks `lab` for.
OF_WINGS = "study or payload_at_a_tied or reason_of_a_failed_move or does_not_know_loops"
IMPORT_ALL = """
import importlib, pkgutil, armctl
names = [module.name for module in pkgutil.walk_packages(armctl.__path__, "armctl.") if not module.name.endswith("__main__")]
for name in names:
    importlib.import_module(name)
assert len(names) > 100, len(names)
assert armctl.Simulation("robot_arm_3dof", "pd-gravity").move_to([0.3, 0.1, 0.3])
"""


@pytest.fixture
def environment(tmp_path):
    """That of a process whose armctl has no wings."""
    for models in ("models", "examples/models"):
        shutil.copytree(PACKAGE.parent / models, tmp_path / models)
    shutil.copytree(PACKAGE, tmp_path / "armctl", ignore=shutil.ignore_patterns("__pycache__", *WINGS))
    return os.environ | {"PYTHONPATH": str(tmp_path)}


@pytest.mark.full
def test_every_other_module_is_imported_and_an_arm_moves(environment, tmp_path):
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.nightly
def test_their_tests_pass(environment, tmp_path):
    shutil.copytree(TESTS, tmp_path / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(TESTS.parent / "pyproject.toml", tmp_path)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "0",
        "-m",
        "not full and not nightly and not form",
        "-k",
        f"not ({OF_WINGS})",
    ]
    done = subprocess.run(
        [*command, *(f"tests/{judge}" for judge in JUDGES)], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:]
