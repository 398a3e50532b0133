"""Plots: what they say, drawn where they should be, refused where there is nothing to draw."""

from pathlib import Path

import numpy as np
import pytest
from arms import BUNDLED, arm_of
from PIL import Image

from armctl import InputError, Log, NotInstalledError, Simulation
from armctl.core.plotting import COLORS
from armctl.report.plot import four_panels, overlay, overlay_image


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    runs = []
    for controller in ("pd", "computed-torque"):
        sim = Simulation(arm_of(BUNDLED), controller)
        sim.move_to(sim.target)
        assert sim.log is not None
        runs.append(sim.log)
    return runs


def pushed() -> Log:
    """A run without a reference."""
    return Simulation(arm_of(BUNDLED)).apply_ctrl([0.1, 0.0, 0.0], 0.05)


def words(path: Path) -> str:
    """The text of an SVG; matplotlib notes it beside the outlines."""
    return path.read_text(encoding="utf-8")


def test_four_panels_name_joints_units_and_limits(logs: list[Log], tmp_path: Path):
    path = four_panels(logs[0], tmp_path / "new" / "run.svg")
    assert path is not None
    for text in (*logs[0].joint_names, "joint angle, rad", "rad/s", "N m", "tip position, m", "time, s", "dashed: reference"):
        assert f"<!-- {text}" in words(path) or text in words(path), text
    near = logs[0].tau_max <= 1.5 * np.abs(logs[0].tau).max()
    assert ("limit of" in words(path)) == near.any()


@pytest.mark.parametrize("ending", [".png", ".svg", ".pdf"])
def test_an_overlay_shows_every_run_by_name(logs: list[Log], tmp_path: Path, ending: str):
    path = overlay(logs, tmp_path / f"overlay{ending}")
    assert path is not None
    assert path.stat().st_size > 5000
    if ending == ".svg":
        assert all(log.controller in words(path) for log in logs)


def test_the_same_logs_give_the_same_picture(logs: list[Log], tmp_path: Path):
    first, second = (overlay(logs, tmp_path / f"{k}.svg") for k in range(2))
    assert first is not None
    assert second is not None
    assert first.read_bytes() == second.read_bytes()


def test_an_overlay_in_memory_is_the_picture_and_not_blank(logs: list[Log]):
    image = overlay_image(logs, ["one", "other"])
    assert image.dtype == np.uint8
    assert image.shape == (720, 720, 3)
    for color in COLORS[:2]:
        rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
        assert (np.abs(image.astype(int) - rgb).max(axis=2) < 8).sum() > 50


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda logs, d: overlay([], d / "x.png"), "expected at least one log, got none"),
        (lambda logs, d: overlay(logs, d / "x.png", labels=["one"]), "labels: expected 2, got 1"),
        (lambda logs, d: overlay(logs, d / "x.jpeg"), "expected .png, .svg or .pdf"),
        (lambda logs, d: overlay(logs, 5), "path: 5 is not the name of a file"),
        (lambda logs, d: overlay(logs[0], d / "x.png"), "expected a list of logs"),
        (lambda logs, d: overlay([3], d / "x.png"), "log: expected Log, got 3"),
        (lambda logs, d: overlay([pushed()], d / "x.png"), "one of them has no reference"),
        (lambda logs, d: four_panels("x", d / "x.png"), "log: expected Log, got 'x'"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence(logs: list[Log], tmp_path: Path, call, sentence: str):
    with pytest.raises(InputError, match=sentence):
        call(logs, tmp_path)


def test_a_window_without_a_screen_is_one_sentence(logs: list[Log]):
    with pytest.raises(NotInstalledError, match="no screen for a window here; name a file"):
        four_panels(logs[0])


def test_the_colours_are_far_apart_also_for_the_colour_blind():
    def as_seen(rgb: np.ndarray) -> np.ndarray:
        """Without green-sensitive cones, after Viénot, Brettel and Mollon (1999), in linear light."""
        to_lms = np.array([[17.8824, 43.5161, 4.1194], [3.4557, 27.1554, 3.8671], [0.02996, 0.18431, 1.4671]])
        deutan = np.array([[1.0, 0.0, 0.0], [0.494207, 0.0, 1.24827], [0.0, 0.0, 1.0]])
        return np.linalg.inv(to_lms) @ deutan @ to_lms @ rgb**2.2

    seen = [as_seen(np.array([int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)])) for c in COLORS]
    distances = [np.linalg.norm(a - b) for k, a in enumerate(seen) for b in seen[k + 1 :]]
    assert min(distances) > 0.05


def test_the_pictures_of_the_pages_are_there_and_light_enough_to_load():
    folder = Path(__file__).parents[2] / "docs" / "pictures"
    for name in ("drag.webp", "four_panels.png", "pd_against_computed_torque.png", "waypoints.png", "page.png"):
        assert (folder / name).stat().st_size < 1.5e6, name
        with Image.open(folder / name) as picture:
            assert min(picture.size) >= 400
    with Image.open(folder / "drag.webp") as film:
        assert film.n_frames > 20
