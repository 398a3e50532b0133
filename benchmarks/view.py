"""Seeing, on this machine: rendered frames a second, the real-time factor with the page open, time until the page is usable.

    python benchmarks/view.py [--robot panda] [--seconds 20] [--out benchmarks/results/view.md]

A headless Chromium, drawing in software, looks at the page meanwhile, on the same cores; the target goes round. Until the page
is usable: from the command until the page that it opens, in a browser that runs already, shows the arm and answers a click.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import markdown_table
from PIL import Image

import armctl
from armctl.render import Renderer

STARTS = 5
SOFTWARE_GL = "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"


def frames_a_second(robot: str, quality: str, frames: int) -> float:
    """How many images of 640 x 480 are drawn in a second, the arm moving."""
    arm = armctl.load(robot)
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, data)
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(arm.model, camera)
    with Renderer(arm.model, (640, 480), quality) as renderer:
        renderer.image(data, camera)
        started = time.perf_counter()
        for k in range(frames):
            data.qpos[arm.qpos_adr] = arm.home + 0.3 * np.sin(k / 10)
            mujoco.mj_kinematics(arm.model, data)
            renderer.image(data, camera)
        return frames / (time.perf_counter() - started)


def seconds_until_usable(robot: str) -> list[float]:
    """From the command until it opens the page, the panel is live, the arm is drawn, and a click is answered."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE_GL.split())
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        opening = {**os.environ, "DISPLAY": "any", "BROWSER": "echo %s"}  # what would open the page says which one
        command = [sys.executable, "-m", "armctl", "view", robot, "--port", "0"]
        started = time.perf_counter()
        times = []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=opening) as view:
            assert view.stdout is not None
            url = view.stdout.readline().strip()
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
            view.terminate()
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
        sim.follow(target, seconds=2.0)  # loads what a run needs
        tab.get_by_text("real time").wait_for(timeout=60e3)
        factors.clear()
        started = time.perf_counter()
        sim.follow(target, seconds=seconds)
        factor = seconds / (time.perf_counter() - started)
        browser.close()
    sim.viewer.close()
    return factor, min(factors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "view.md")
    args = parser.parse_args()
    usable = np.median([seconds_until_usable(args.robot) for _ in range(STARTS)], axis=0)
    factor, least = real_time(args.robot, args.seconds)
    rows = [
        ("real-time factor, page open", "at least 0.98", f"{factor:.3f} over {args.seconds:g} s; least over 2 s {least:.3f}"),
        ("frames a second, 640 x 480, fast", "at least 30", f"{frames_a_second(args.robot, 'fast', 100):.0f}"),
        ("frames a second, 640 x 480, full", "", f"{frames_a_second(args.robot, 'full', 10):.1f}"),
        (
            f"page opened, panel live, arm drawn, click answered after (medians of {STARTS} starts)",
            "at most 5 s",
            " / ".join(f"{t:.1f}" for t in usable) + " s",
        ),
    ]
    columns = (f"{args.robot}, software OpenGL, {os.cpu_count()} cores", "target", "measured")
    text = markdown_table(columns, rows) + "\n"
    print(text)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
