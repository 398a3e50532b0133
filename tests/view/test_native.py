"""MuJoCo's own window, on a screen that nobody sees: it opens, shows the arm, follows a drag, and closes cleanly."""

import itertools
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from arms import BUNDLED
from commands import armctl_command
from PIL import ImageGrab

TOOLS = ("Xvfb", "xdotool")
pytestmark = pytest.mark.skipif(
    not all(map(shutil.which, TOOLS)), reason="no screen to try on: apt-get install -y xvfb xdotool"
)
PATIENCE = 120.0  # s: a window that is drawn in software, on a busy machine


@pytest.fixture(scope="module")
def screen() -> Iterator[dict[str, str]]:
    """The environment of a process that has a screen."""
    server = subprocess.Popen(
        ["Xvfb", "-noreset", "-displayfd", "1", "-screen", "0", "800x600x24"], stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    display = f":{server.stdout.readline().strip()}"
    yield {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"} | {"DISPLAY": display}
    server.terminate()
    server.communicate()


@pytest.fixture
def window(screen: dict[str, str]) -> Iterator[subprocess.Popen]:
    process = subprocess.Popen(
        armctl_command("view", BUNDLED, "--native"), env=screen, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    until(lambda: ordered(screen, "search", "--name", "MuJoCo") != "" and green(seen(screen)).any(), "no window shows a target")
    yield process
    process.kill()
    process.communicate()


def ordered(screen: dict[str, str], *words: str) -> str:
    """What xdotool answers."""
    return subprocess.run(["xdotool", *words], env=screen, capture_output=True, text=True).stdout.strip()


def seen(screen: dict[str, str]) -> np.ndarray:
    """What is on the screen."""
    return np.array(ImageGrab.grab(xdisplay=screen["DISPLAY"])).astype(int)


def green(image: np.ndarray) -> np.ndarray:
    """Where the target's pixels are."""
    r, g, b = np.moveaxis(image, -1, 0)
    return np.argwhere((g > 90) & (g > 1.4 * r) & (g > 1.4 * b))


def changed(one: np.ndarray, other: np.ndarray) -> int:
    """How many pixels differ."""
    return int((np.abs(one - other).max(axis=2) > 60).sum())


def at_rest(screen: dict[str, str]) -> bool:
    before = seen(screen)
    time.sleep(1.0)
    return changed(seen(screen), before) == 0


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.2)


def ended(window: subprocess.Popen) -> tuple[int, str]:
    _, err = window.communicate(timeout=PATIENCE)
    return window.returncode, err


@pytest.mark.full
def test_a_drag_moves_the_target_and_the_arm_and_ctrl_q_closes(screen: dict[str, str], window: subprocess.Popen):
    ordered(screen, "windowfocus", ordered(screen, "search", "--name", "MuJoCo").split()[0])
    time.sleep(2.0)  # the arm sets out for the target
    until(lambda: at_rest(screen), "the arm does not come to rest")
    before = seen(screen)
    y, x = green(before).mean(axis=0).astype(int)
    ordered(screen, "mousemove", str(x), str(y), "keydown", "ctrl", "mousedown", "3")
    offsets = itertools.chain(range(1, 9), itertools.cycle((7, 8)))

    def moved() -> bool:
        """Moves the mouse further. The button stays down: a drag that begins and ends between two pictures moves nothing."""
        k = next(offsets)
        ordered(screen, "mousemove", str(x + 5 * k), str(y + 3 * k))
        return bool(np.abs(green(seen(screen)).mean(axis=0) - (y, x)).max() > 10)

    until(moved, "the target has not moved")
    ordered(screen, "mouseup", "3", "keyup", "ctrl")
    until(lambda: changed(seen(screen), before) > 300, "the arm has not moved")
    ordered(screen, "mousemove", "200", "200")
    until(lambda: ordered(screen, "key", "ctrl+q") or window.poll() is not None, "the window stays open")
    assert ended(window) == (0, "")


@pytest.mark.full
def test_ctrl_c_closes_the_window_without_a_word(window: subprocess.Popen):
    window.send_signal(signal.SIGINT)
    assert ended(window) == (0, "")
