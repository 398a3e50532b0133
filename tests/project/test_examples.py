"""Every example is short, says what it shows, and runs without a screen."""

import ast
import re
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco_menagerie
import pytest
from arms import MISSING, some_of
from printed_outputs import difference

import armctl

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# JAX and PyTorch start threads, after which other tests of the process could not fork.
APART = [path for path in EXAMPLES if re.search("jax|stable_baselines3", path.read_text(encoding="utf-8"))]
LONG_EXAMPLES = {"91_ppo_learns_to_reach": 100}  # a third is the adapter to stable-baselines3
QUICK = ("01_reach", "04_pd_waypoints", "20_solve_ik", "33_sequence_and_new_target", "35_your_own_mpc")
# Packages that armctl does not declare, for they are large: examples say so, and stop.
NOT_INSTALLED = ("pip install mujoco-mjx", "pip install stable-baselines3")


# Training and rounding in single precision have other numbers on another processor: the words of these must agree, and the
# numbers that a pattern finds are within bounds.
BOUNDS = {
    "91_ppo_learns_to_reach": (r"([\d.]+)%", 95.0, 100.0),
    "94_computed_torque_in_mjx": (r"at most (\S+) mrad", 0.0, 0.01),
}


def assert_printed(example: Path, printed: str) -> None:
    """What an example prints is what the pages show of it; no page shows the output of all of them."""
    output = ROOT / "docs" / "outputs" / f"{example.stem}.txt"
    assert printed
    if output.is_file():
        changed = difference(output.read_text(encoding="utf-8"), printed, numbers=example.stem not in BOUNDS)
        assert not changed, f"{changed}\n`make outputs` writes docs/outputs again"
    if example.stem in BOUNDS:
        pattern, low, high = BOUNDS[example.stem]
        found = [float(number) for number in re.findall(pattern, printed)]
        assert found
        assert all(low <= number <= high for number in found), printed


every_example = pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)


@every_example
def test_an_example_is_short_and_begins_with_a_sentence(example: Path):
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LONG_EXAMPLES.get(example.stem, 40)
    first = (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
    assert text.startswith('"""')
    assert first.endswith(".")


@pytest.mark.parametrize(
    "example",
    some_of([path for path in EXAMPLES if path not in APART], [path for path in EXAMPLES if path.stem in QUICK]),
    ids=lambda path: path.stem,
)
@pytest.mark.filterwarnings("default")  # as outside a test
def test_an_example_runs(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """In this process, because to import everything again takes longer than most examples."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example)])
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    try:
        runpy.run_path(str(example), run_name="__main__")
    except armctl.ModelError as error:
        if MISSING not in str(error):
            raise
        pytest.skip(f"{str(error).split(':')[0]}: {MISSING}")
    except mujoco_menagerie.DownloadError:
        pytest.skip(f"a robot of Menagerie: {MISSING}")
    assert_printed(example, capsys.readouterr().out)


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


def test_there_are_examples():
    assert EXAMPLES
