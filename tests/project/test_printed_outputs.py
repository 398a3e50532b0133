"""Committed outputs are what their commands print; the comparison finds what a reader would."""

from pathlib import Path

import pytest
from printed_outputs import difference

from armctl.cli.main import main

ROOT = Path(__file__).parents[2]

LINES = """reached in 1.234 s, 0.5 mm from the target
largest share 97.3 % of joint 2
name      rms
--------  ---
wall      12
"""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("1.234 s", "1.251 s"),
        ("0.5 mm", "0.7 mm"),
        ("--------  ---", "-----  -"),
        ("97.3 %", "98.0 %"),
        ("97.3 %", "97.3 %  "),
    ],
)
def test_outputs_agree_within_the_tolerance(old: str, new: str):
    assert not difference(LINES, LINES.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("1.234 s", "1.30 s"),
        ("0.5 mm", "0.9 mm"),
        ("0.5 mm", "-0.5 mm"),
        ("joint 2", "joint 6"),
        ("reached", "not reached"),
        ("wall      12\n", ""),
        ("12", "nan"),
        ("12", "12 13"),
    ],
)
def test_outputs_that_differ_are_told(old: str, new: str):
    assert "committed: " in difference(LINES, LINES.replace(old, new))


def test_clock_times_and_folders_are_not_compared():
    said = "ran 12.3 times real time, wrote /tmp/one/film.png"
    assert not difference(said, "ran 7.1 times real time, wrote /home/two/film.png")


def test_the_page_shows_what_info_prints(capsys: pytest.CaptureFixture[str]):
    assert main(["info", "robot_arm_3dof"]) == 0
    committed = (ROOT / "docs" / "outputs" / "info.txt").read_text(encoding="utf-8")
    changed = difference(committed, capsys.readouterr().out)
    assert not changed, f"{changed}\n`make outputs` writes docs/outputs again"


def test_the_readme_shows_what_its_program_prints(capsys: pytest.CaptureFixture[str]):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    program, _, _ = text.partition("```python\n")[2].partition("```")
    exec(program, {})
    assert f"# {capsys.readouterr().out.strip()}\n" in program
