"""Every example with Dask, JAX or PyTorch runs, in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest
from arms import MISSING
from example_outputs import APART, assert_printed

# Packages that armctl does not declare, for they are large: examples say so, and stop.
NOT_INSTALLED = ("pip install mujoco-mjx", "pip install stable-baselines3")


# Training takes minutes: the nightly job trains until the policy succeeds, others see that every line of the example runs.
FEW_STEPS = {"91_ppo_learns_to_reach": "10000"}


def run(example: Path, folder: Path, *arguments: str) -> str:
    """What an example prints in a process of its own; the test is skipped where it needs what is not installed."""
    done = subprocess.run([sys.executable, example, *arguments], cwd=folder, capture_output=True, text=True, timeout=1200)
    if done.returncode != 0 and MISSING in done.stderr:
        pytest.skip(f"{done.stderr.split('ModelError: ')[-1].split(':')[0]}: {MISSING}")
    if done.returncode != 0 and done.stderr.rstrip().endswith(NOT_INSTALLED):
        pytest.skip(done.stderr)
    if done.returncode != 0 and "mujoco_menagerie._errors.DownloadError" in done.stderr:
        pytest.skip(f"a robot of Menagerie: {MISSING}")
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.full
@pytest.mark.parametrize("example", [path for path in APART if path.stem not in FEW_STEPS], ids=lambda path: path.stem)
def test_an_example_with_another_framework_runs(example: Path, tmp_path: Path):
    assert_printed(example, run(example, tmp_path))


@pytest.mark.full
@pytest.mark.parametrize("example", [path for path in APART if path.stem in FEW_STEPS], ids=lambda path: path.stem)
def test_an_example_of_minutes_runs_with_few_steps(example: Path, tmp_path: Path):
    assert_printed(example, run(example, tmp_path, "out", FEW_STEPS[example.stem]), numbers=False)


@pytest.mark.nightly
@pytest.mark.parametrize("example", [path for path in APART if path.stem in FEW_STEPS], ids=lambda path: path.stem)
def test_an_example_of_minutes_succeeds(example: Path, tmp_path: Path):
    assert_printed(example, run(example, tmp_path))
