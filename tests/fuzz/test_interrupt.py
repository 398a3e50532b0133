"""Ctrl-C ends a command at any moment, with status 130, and leaves no traceback, no process and no half-written file."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from arms import BUNDLED

COMMANDS = {
    "reach": ["reach", BUNDLED, "--out", "FOLDER"],
    "compare": ["compare", BUNDLED, "--out", "FOLDER", "--threads", "1"],
    "compare on two threads": ["compare", BUNDLED, "--controllers", "all", "--out", "FOLDER", "--threads", "2"],
}
# The time before this line belongs to Python itself, which a signal may end without a word from us.
CODE = "import sys; from armctl.cli import program; print('ready', flush=True); sys.exit(program())"
LONGEST_RUN_S = 5.0

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


def interrupted_after(delay: float, argv: list[str], *, ignored_by_parent: bool) -> tuple[int, str]:
    """Runs a command, sends SIGINT to all of its processes after a delay, and returns its status and its stderr."""
    parent = ["sh", "-c", 'trap "" INT; exec "$0" "$@"'] if ignored_by_parent else []
    process = subprocess.Popen(
        [*parent, sys.executable, "-c", CODE, *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": ":".join(sys.path)},
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(delay)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    return process.returncode, err


@pytest.mark.parametrize("ignored_by_parent", [False, True], ids=["", "SIGINT ignored by the parent"])
@pytest.mark.parametrize("name", COMMANDS)
def test_an_interrupt_at_any_moment_leaves_no_traceback(tmp_path, fuzz_cases, name: str, ignored_by_parent: bool):
    folder = tmp_path / "run"
    argv = [word.replace("FOLDER", str(folder)) for word in COMMANDS[name]]
    for rng in fuzz_cases(2):
        # Most moments near the start, when modules are imported, and some until the end.
        delay = LONGEST_RUN_S * rng.random() ** 3
        status, err = interrupted_after(delay, argv, ignored_by_parent=ignored_by_parent)
        assert status in (0, 130), (delay, status, err)
        assert "Traceback" not in err, (delay, err)
        assert "KeyboardInterrupt" not in err, (delay, err)
        for file in folder.glob("*"):
            assert not file.name.startswith("."), "a temporary file is left"
            if file.suffix == ".json":
                json.loads(file.read_text())
            if file.suffix == ".npz":
                with np.load(file) as data:
                    assert data["t"].size
