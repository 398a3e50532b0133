"""Seeing, on this machine: rendered frames a second, the real-time factor with the page open, time until the page is usable.

    python benchmarks/view.py [--robot panda] [--seconds 20] [--drag 60] [--out benchmarks/results/view.md]

A headless Chromium, drawing in software, looks at the page meanwhile, on the same cores; the target goes round. Until the page
is usable: from the command until the page that it opens, in a browser that runs already, shows the arm and answers a click.
Then a mouse drags the target of a new page, to and fro, while contacts are avoided; a second visitor notes when links move.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import viser
import zstandard
from markdown_table import markdown_table
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import armctl

STARTS = 5
FILM_FRAMES_A_SECOND = 30  # of an .mp4
SHORTEST_FILM_S = 3.0  # the last frame of a shorter one stays
SOFTWARE_GL = "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"

DRAG_PAGE_PX = (900, 480)
PANEL_PX = 400  # at the right of the page
FIRST_DRAG_PX = 40
DRAG_AMPLITUDE_PX = 45
DRAG_PERIOD_S = 4.0
MOUSE_INTERVAL_S = 0.02
ARROW_HEAD_PX = 10
MISSED_AFTER_MS = 4000.0
MAX_DRAGS = 5
# viser sends a visitor nothing until it has sent its camera.
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 400,
    "image_width": 600,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


class Seen(NamedTuple):
    """A position in a picture of the page, (2,) pixels, and the time of the picture, s."""

    position: np.ndarray
    time: float


class Drag(NamedTuple):
    """The time from the command until the arm is at the end of the first drag, and the gaps in the motion of a long one, s."""

    followed: float
    gaps: np.ndarray


@contextlib.contextmanager
def viewed(robot: str) -> Iterator[str]:
    """`armctl view` with an empty home folder, and the address that it opens."""
    with tempfile.TemporaryDirectory() as home:
        # What would open the page says which one.
        environment = {**os.environ, "HOME": home, "DISPLAY": "any", "BROWSER": "echo %s"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # `make demo` leaves compiled modules
        command = [sys.executable, "-m", "armctl", "view", robot, "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as view:
            assert view.stdout is not None
            try:
                yield view.stdout.readline().strip()
            finally:
                view.terminate()


class Visitor:
    """A second visitor of a page, which notes the times at which links of the arm are drawn elsewhere."""

    def __init__(self, url: str):
        self.times: list[float] = []
        self._connection = connect(
            url.replace("http", "ws"), origin=url, subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        )
        self._connection.send(msgspec.msgpack.encode(CAMERA))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        decompressor = zstandard.ZstdDecompressor()
        with contextlib.suppress(ConnectionClosed):
            for window in self._connection:
                size = int.from_bytes(window[8:16], "little")
                messages = msgspec.msgpack.decode(decompressor.decompress(window[16 : 16 + size]))["messages"]
                if any(each["type"] == "SceneNodeUpdateMessage" and each["name"].startswith("/bodies/") for each in messages):
                    self.times.append(time.perf_counter())

    def close(self) -> None:
        self._connection.close()
        self._reader.join()


def drag(robot: str, seconds: float) -> Drag:
    """A mouse drags the vertical arrow of the target in a page whose visitor has never seen it before."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE_GL.split())
        tab = browser.new_page(viewport=dict(zip(("width", "height"), DRAG_PAGE_PX, strict=True)))
        started = time.perf_counter()
        with viewed(robot) as url:
            tab.goto(url, wait_until="commit")
            tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
            tab.get_by_text("real time").wait_for(timeout=60e3)
            handle = _first_drag(tab)
            followed = time.perf_counter() - started
            visitor = Visitor(url)
            time.sleep(10.0)  # until the fine meshes are there
            begin = time.perf_counter()
            while (t := time.perf_counter() - begin) < seconds:
                # At constant speed: at the ends of a sine, the target would stand for 0.3 s within a pixel.
                shift = DRAG_AMPLITUDE_PX * (1 - 4 * abs((t / DRAG_PERIOD_S + 0.25) % 1 - 0.5))
                tab.mouse.move(handle[0], handle[1] - shift)
                time.sleep(MOUSE_INTERVAL_S)
            times = np.array([each for each in visitor.times if each >= begin + 1.0])
            visitor.close()
        browser.close()
    return Drag(followed, np.diff(times))


def _first_drag(tab: Any) -> np.ndarray:
    """Drags the head of the vertical arrow upwards until the arm is there: (2,) pixels. Tries again if the mouse missed it."""
    from playwright.sync_api import TimeoutError as MissedError

    for _ in range(MAX_DRAGS):
        first = _arrow_head(tab)
        second = _arrow_head(tab)
        # Until somebody touches it, the target moves by itself.
        velocity = (second.position - first.position) / (second.time - first.time)
        handle = second.position + (time.perf_counter() - second.time) * velocity
        tab.mouse.move(*handle)
        tab.mouse.down()
        for share in np.linspace(0.0, 1.0, 5):
            tab.mouse.move(handle[0], handle[1] - share * FIRST_DRAG_PX)
        try:
            tab.get_by_text("at the target").first.wait_for(timeout=MISSED_AFTER_MS)
        except MissedError:
            tab.mouse.up()
            tab.get_by_text("reset", exact=True).click(timeout=60e3)  # several drags would leave the reach of the arm
        else:
            return handle - np.array([0.0, FIRST_DRAG_PX])
    raise RuntimeError(f"after each of {MAX_DRAGS} drags, the arm was not at its target within {MISSED_AFTER_MS:.0f} ms")


def _arrow_head(tab: Any) -> Seen:
    """Where the head of the vertical arrow is: the topmost thing that is blue."""
    while True:
        scene = np.asarray(Image.open(io.BytesIO(tab.screenshot(timeout=60e3))).convert("RGB")).astype(int)[:, :-PANEL_PX]
        blue = (scene[..., 2] > 180) & (scene[..., 0] < 110) & (scene[..., 2] - scene[..., 1] > 50)
        if blue.any():
            rows, columns = np.nonzero(blue)
            head = rows < rows.min() + ARROW_HEAD_PX
            return Seen(np.array([columns[head].mean(), rows[head].mean()]), time.perf_counter())


def frames_a_second(robot: str, quality: str, repetitions: int) -> float:
    """How many frames of 640 x 480 `armctl.record` draws and encodes in a second: of the longer one of two films."""
    arm = armctl.load(robot)
    out_and_back = armctl.out_and_back(arm)
    fewest = math.ceil(SHORTEST_FILM_S / out_and_back.duration)
    motions = [armctl.move_sequence(arm, [out_and_back] * k) for k in (fewest, fewest + repetitions)]
    logs = [armctl.simulate(arm, "computed-torque", motion) for motion in motions]
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for log in logs:
            started = time.perf_counter()
            armctl.record(log, arm, Path(folder) / "film.mp4", quality=quality)
            seconds.append(time.perf_counter() - started)
    return float(FILM_FRAMES_A_SECOND * (logs[1].t[-1] - logs[0].t[-1]) / (seconds[1] - seconds[0]))


def seconds_until_usable(robot: str) -> list[float]:
    """From the command until it opens the page, the panel is live, the arm is drawn, and a click is answered."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE_GL.split())
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        started = time.perf_counter()
        times = []
        with viewed(robot) as url:
            times.append(time.perf_counter() - started)
            tab.goto(url, wait_until="commit")
            tab.get_by_text("real time").wait_for(timeout=60e3)
            times.append(time.perf_counter() - started)
            while not _shows_something(tab.screenshot(timeout=60e3)):
                pass
            times.append(time.perf_counter() - started)
            tab.get_by_text("pause", exact=True).click(timeout=60e3)
            tab.get_by_text("paused").first.wait_for(timeout=60e3)
            times.append(time.perf_counter() - started)
        browser.close()
    return times


def _shows_something(png: bytes) -> bool:
    """Whether the scene is more than sky and ground, whose rows have one colour each."""
    scene = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)[150:, :880]
    things = np.abs(scene - np.median(scene, axis=1, keepdims=True)).max(axis=2) > 40
    return bool(things.mean() > 0.05)


def real_time(robot: str, seconds: float) -> tuple[float, float]:
    """The real-time factor of a simulation whose page is open in a browser, and the least over two seconds."""
    from playwright.sync_api import sync_playwright

    sim = armctl.Simulation(robot, viewer=True)
    center = sim.tip
    factors = []

    def target(t: float) -> armctl.Pose:
        factors.append(sim.viewer.real_time_factor)
        angle = 2 * np.pi * t / 4
        return armctl.Pose(center.position + 0.1 * np.array([0.0, np.sin(angle), 0.5 * np.sin(2 * angle)]), quat=center.quat)

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE_GL.split())
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        tab.goto(sim.viewer.url)
        sim.follow(target, duration=2.0)  # loads what a run needs
        tab.get_by_text("real time").wait_for(timeout=60e3)
        factors.clear()
        started = time.perf_counter()
        sim.follow(target, duration=seconds)
        factor = seconds / (time.perf_counter() - started)
        browser.close()
    sim.viewer.close()
    return factor, min(factors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "view.md")
    parser.add_argument("--drag", type=float, default=60.0, help="s of dragging")
    args = parser.parse_args()
    usable = np.median([seconds_until_usable(args.robot) for _ in range(STARTS)], axis=0)
    factor, least = real_time(args.robot, args.seconds)
    rows = [
        ("real-time factor, page open", "at least 0.98", f"{factor:.3f} over {args.seconds:g} s; least over 2 s {least:.3f}"),
        ("frames a second of `armctl.record`, 640 x 480, fast", "at least 30", f"{frames_a_second(args.robot, 'fast', 3):.0f}"),
        ("frames a second of `armctl.record`, 640 x 480, full", "", f"{frames_a_second(args.robot, 'full', 1):.1f}"),
        (
            f"page opened, panel live, arm drawn, click answered after (medians of {STARTS} starts)",
            "at most 5 s",
            " / ".join(f"{t:.1f}" for t in usable) + " s",
        ),
    ]
    if args.drag > 0:
        found = drag(args.robot, args.drag)
        longest = 1e3 * found.gaps.max()
        usual = 1e3 * np.quantile(found.gaps, 0.99)
        late = int((found.gaps > 0.1).sum())
        rows.append(("the arm is at the end of the first drag after", "at most 5 s", f"{found.followed:.1f} s"))
        gaps = f"{longest:.0f} ms; {late} of {len(found.gaps)} above 100 ms; 99 % below {usual:.0f} ms"
        rows.append((f"longest gap in the motion in {args.drag:g} s of dragging", "at most 100 ms", gaps))
    columns = (f"{args.robot}, software OpenGL, {os.cpu_count()} cores", "target", "measured")
    text = markdown_table(columns, rows) + f"\nLoad average of the cores meanwhile: {os.getloadavg()[0]:.1f}.\n"
    print(text)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
