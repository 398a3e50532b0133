"""Every example is short, says what it shows, and runs without a screen."""

import ast
import runpy
import sys
import tempfile
from pathlib import Path

import mujoco_menagerie
import pytest
from arms import MISSING, some_of
from example_outputs import APART, EXAMPLES, assert_printed
from ros2_controller import HAS_ROS2

import armctl

LONG_EXAMPLES = {"91_ppo_learns_to_reach": 100}  # a third is the adapter to stable-baselines3
QUICK = ("01_reach", "04_pd_waypoints", "20_solve_ik", "33_sequence_and_new_target", "35_your_own_mpc")


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
    some_of([path for path in EXAMPLES if path not in APART], [path for path in EXAMPLES if path.stem in QUICK], EXAMPLES),
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
    except armctl.NotInstalledError as error:
        if HAS_ROS2 or "ROS 2" not in str(error):
            raise
        pytest.skip("ROS 2 is not installed")
    except mujoco_menagerie.DownloadError:
        pytest.skip(f"a robot of Menagerie: {MISSING}")
    assert_printed(example, capsys.readouterr().out)


def test_there_are_examples():
    assert EXAMPLES
