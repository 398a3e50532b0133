"""The tour: a page of programs that run as they are printed, each beside what it gave."""

import html
from pathlib import Path

import pytest
from arms import BUNDLED, arm_of, at_hand

import armctl
from armctl.cli.main import main
from armctl.lab.tour import tour_of

STOPS = ["Reach", "Around an obstacle", "An unknown payload", "PD beside computed torque", "Margins"]


@pytest.mark.full
def test_the_page_shows_every_program_and_what_it_gave(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "tour.html"
    assert main(["tour", BUNDLED, "--out", str(path)]) == 0
    assert f"wrote {path}" in capsys.readouterr().err
    text = path.read_text(encoding="utf-8")
    found = [text.index(f"<h2>{title}</h2>") for title in STOPS]
    assert found == sorted(found)
    stops = tour_of(arm_of(BUNDLED), BUNDLED)
    assert [stop.title for stop in stops] == STOPS
    for stop in stops:
        assert f"<pre>{html.escape(stop.program)}</pre>" in text
    assert "reached within" in text
    assert text.count("computed-torque-observer") >= 2, "in the program and in the table"
    assert text.count("<svg") == 3


@pytest.mark.parametrize(
    "robot",
    [BUNDLED, pytest.param("panda", marks=[pytest.mark.full, pytest.mark.skipif(not at_hand("panda"), reason="panda")])],
)
def test_the_obstacle_is_in_the_way_and_the_motion_goes_around_it(robot: str):
    stop = next(stop for stop in tour_of(armctl.load(robot), robot) if stop.title == "Around an obstacle")
    found: dict = {}
    exec(stop.program, found)
    arm = found["arm"]
    motion = found["motion"]
    assert motion
    assert armctl.check_clearance(arm, motion)
    direct = armctl.move_j(arm, arm.home, motion(motion.duration).q)
    clearance = armctl.check_clearance(arm, direct)
    assert not clearance
    assert "box" in str(clearance)


def test_another_ending_is_refused_before_anything_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["tour", BUNDLED, "--out", str(tmp_path / "tour.pdf")]) == 2
    assert ".html" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
