"""Long work shows a bar on a terminal, and lines elsewhere."""

import sys

import pytest

from armctl.core import progress
from armctl.core.progress import progress_bar


def run() -> None:
    with progress_bar("film", 3, "frames") as bar:
        for _ in range(3):
            bar.update()


def test_short_work_prints_nothing_if_stderr_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "DELAY_S", 0.0)
    run()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys, "stderr", None)
    run()


def test_short_work_shows_no_bar_and_long_work_does(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    run()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(progress, "DELAY_S", 0.0)
    run()
    shown = capsys.readouterr().err
    assert "film" in shown
    assert "3/3" in shown


def test_long_work_prints_plain_lines_if_stderr_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_INTERVAL_S", 0.0)
    run()
    assert capsys.readouterr().err.splitlines()[-1] == "film: 3 of 3 frames"


def fail_within_a_bar() -> None:
    with progress_bar("film", 3, "frames") as bar:
        bar.update()
        raise ValueError("broken")


def test_a_bar_ends_when_its_work_fails(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "DELAY_S", 0.0)
    with pytest.raises(ValueError, match="broken"):
        fail_within_a_bar()
    assert capsys.readouterr().err.endswith("\n")
