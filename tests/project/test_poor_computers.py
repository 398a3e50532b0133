"""A program runs with little memory, without a home directory and where nothing can be written, or a sentence says why not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="limits and folders of Linux"),
]

LIMITED = "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2); sys.argv[1:2] = []; "
PROGRAM = "import sys; from armctl.cli import program; sys.exit(program())"
REACH = ["reach", "robot_arm_3dof"]


def run(code: str, *arguments: str, folder: str | Path = "/", **environment: str | None) -> subprocess.CompletedProcess[str]:
    """Runs a program in a folder; an environment variable that is None is unset."""
    merged = os.environ | {"PYTHONPATH": ":".join(sys.path)} | environment
    given = {name: value for name, value in merged.items() if value is not None}
    command = [sys.executable, "-P", "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder, env=given)


def assert_reached(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 0, done.stderr[-2000:]
    assert "tip error" in done.stdout
    assert not done.stderr


def assert_one_sentence(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 2, done.stderr[-2000:]
    assert done.stderr.startswith("armctl: ")
    assert done.stderr.count("\n") == 1


def test_two_gigabytes_of_addresses_are_enough():
    assert_reached(run(LIMITED + PROGRAM, str(2 * 10**9), *REACH))


@pytest.mark.parametrize("home", [None, "/nowhere"])
def test_no_home_directory_is_needed(home):
    assert_reached(run(PROGRAM, *REACH, HOME=home, TMPDIR="/nowhere", XDG_CACHE_HOME=None))


def test_a_folder_in_which_nothing_can_be_written_is_named_where_something_is_saved():
    assert_reached(run(PROGRAM, *REACH, folder="/proc"))
    done = run(PROGRAM, *REACH, "--out", "out", folder="/proc")
    assert_one_sentence(done)
    assert "out" in done.stderr


def test_a_folder_that_was_deleted_is_no_traceback(tmp_path):
    folder = tmp_path / "gone"
    code = f"import os; folder = {str(folder)!r}; os.mkdir(folder); os.chdir(folder); os.rmdir(folder); " + PROGRAM
    assert_reached(run(code, *REACH))
    assert_one_sentence(run(code, *REACH, "--out", "out"))
