"""Every example with JAX or PyTorch runs, in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest
from arms import MISSING

from examples import APART, assert_printed

# Packages that armctl does not declare, for they are large: examples say so, and stop.
NOT_INSTALLED = ("pip install mujoco-mjx", "pip install stable-baselines3")


@pytest.mark.full
@pytest.mark.parametrize("example", APART, ids=lambda path: path.stem)
def test_an_example_with_another_framework_runs(example: Path, tmp_path: Path):
    done = subprocess.run([sys.executable, example], cwd=tmp_path, capture_output=True, text=True, timeout=1200)
    if done.returncode != 0 and MISSING in done.stderr:
        pytest.skip(f"{done.stderr.split('ModelError: ')[-1].split(':')[0]}: {MISSING}")
    if done.returncode != 0 and done.stderr.rstrip().endswith(NOT_INSTALLED):
        pytest.skip(done.stderr)
    if done.returncode != 0 and "mujoco_menagerie._errors.DownloadError" in done.stderr:
        pytest.skip(f"a robot of Menagerie: {MISSING}")
    assert done.returncode == 0, done.stderr
    assert_printed(example, done.stdout)
